//! The runtimes that can run a model, and their common interface.

use std::path::PathBuf;

use ndarray::ArrayD;
use strum::{EnumMessage, EnumString, IntoStaticStr, VariantArray};

use super::Error;

/// The library that runs a model.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, EnumMessage, EnumString, IntoStaticStr, VariantArray,
)]
#[strum(serialize_all = "lowercase")]
pub enum RuntimeKind {
    /// Pure Rust, needs no library.
    Tract,
    /// A shared library, loaded when a model is opened.
    OnnxRuntime,
}

impl RuntimeKind {
    /// Its name.
    pub fn name(self) -> &'static str {
        self.into()
    }

    /// Whether this program was built with it.
    pub fn is_built(self) -> bool {
        match self {
            Self::Tract => cfg!(feature = "onnx"),
            Self::OnnxRuntime => cfg!(feature = "onnxruntime"),
        }
    }
}

/// How a model is run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Runtime {
    /// The library that runs it.
    pub kind: RuntimeKind,
    /// The number of threads, for a library with its own threads.
    pub threads: usize,
    /// The path of onnxruntime's shared library.
    pub library: Option<PathBuf>,
}

/// A model that is ready to run.
pub(super) trait Runner: Send + Sync {
    /// The outputs of the requested layers, each with the clips along its first axis.
    fn run(&self, input: ArrayD<f32>) -> Result<Vec<ArrayD<f32>>, Error>;
}

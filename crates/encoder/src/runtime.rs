//! The runtimes that can run a model, and their common interface.

use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;

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

/// The processor that runs a model.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Device {
    /// The processor of the machine, `cpu`.
    #[default]
    Cpu,
    /// A GPU by CUDA, `cuda:NUMBER`, from 0.
    Cuda(u16),
}

impl fmt::Display for Device {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Cpu => f.write_str("cpu"),
            Self::Cuda(number) => write!(f, "cuda:{number}"),
        }
    }
}

impl FromStr for Device {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let number = text
            .strip_prefix("cuda:")
            .and_then(|number| number.parse().ok());
        match (text, number) {
            ("cpu", _) => Ok(Self::Cpu),
            (_, Some(number)) => Ok(Self::Cuda(number)),
            _ => Err("must be cpu, or cuda:N with the number of the GPU, from 0".to_owned()),
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
    /// The processor; tract has [`Device::Cpu`] alone.
    pub device: Device,
}

/// The name of the library, and the device unless it is the CPU.
impl fmt::Display for Runtime {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.device {
            Device::Cpu => f.write_str(self.kind.name()),
            device => write!(f, "{} on {device}", self.kind.name()),
        }
    }
}

/// A model that is ready to run.
pub(super) trait Runner: Send + Sync {
    /// The outputs of the requested layers, each with the clips along its first axis.
    fn run(&self, input: ArrayD<f32>) -> Result<Vec<ArrayD<f32>>, Error>;
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: the documented forms.
    #[test]
    fn devices_are_parsed_as_they_are_written() {
        for device in [Device::Cpu, Device::Cuda(0), Device::Cuda(7)] {
            assert_eq!(device.to_string().parse(), Ok(device));
        }
        for wrong in ["", "gpu", "cuda", "cuda:", "cuda:-1", "cuda:x", "CUDA:0"] {
            assert!(wrong.parse::<Device>().is_err(), "{wrong}");
        }
    }
}

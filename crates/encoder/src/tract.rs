//! Models in tract, which is pure Rust. The execution plan is made for a batch of one clip, since a
//! plan for a dynamic batch size is 2 to 6 times slower. The clips of a batch are distributed over
//! the threads of the calling rayon pool.

use seese3_core::Cause;
use std::cell::Cell;
use std::panic::UnwindSafe;
use std::path::Path;
use std::sync::{Arc, Once};

use ndarray::{ArrayD, ArrayViewD, Axis};
use rayon::prelude::*;
use tract_onnx::prelude::{
    Datum, Framework, InferenceFact, InferenceModelExt, IntoRunnable, Tensor, TypedRunnableModel,
    tvec,
};

use super::Error;
use super::runtime::Runner;

pub(super) struct Tract {
    model: Arc<TypedRunnableModel>,
    /// The requested outputs, in order.
    names: Vec<String>,
}

impl Tract {
    pub fn open(file: &Path, names: &[String], shape: &[Option<usize>]) -> Result<Self, Error> {
        let wrong = |problem: Cause| Error::Model {
            file: file.to_owned(),
            problem,
        };

        let open = || {
            "has a dynamic input size; give --resize WIDTHxHEIGHT, which this runtime needs"
                .to_owned()
        };

        // The plan is made for one exact shape: a batch of 1, and all other axes of known size.
        let fixed: Option<Vec<usize>> = shape.iter().skip(1).copied().collect();
        let fixed = fixed.ok_or_else(|| wrong(open().into()))?;
        let shape: Vec<usize> = std::iter::once(1).chain(fixed).collect();

        let plan = || {
            // The file's shapes of inner values are left over from its export, and wrong if the
            // batch was dynamic: let tract infer them.
            tract_onnx::onnx()
                .with_ignore_value_info(true)
                .with_ignore_output_shapes(true)
                .model_for_path(file)
                .and_then(|mut model| {
                    model.select_outputs_by_name(names)?;

                    model.set_input_fact(
                        0,
                        InferenceFact::dt_shape(f32::datum_type(), shape.as_slice()),
                    )?;

                    model.into_optimized()?.into_runnable()
                })
        };

        // tract panics on some damaged models. The panic can be caught, because no shared state
        // remains.
        let model = without_panic(plan).ok_or_else(|| {
            wrong("cannot be run by tract, which panicked while planning the model".into())
        })?;
        let model = model.map_err(|error| {
            wrong(
                format!("cannot be run by tract: {error:#}; --runtime onnxruntime may run it")
                    .into(),
            )
        })?;
        Ok(Self {
            model,
            names: names.to_vec(),
        })
    }

    fn one(&self, clip: ArrayViewD<'_, f32>) -> Result<Vec<ArrayD<f32>>, Error> {
        let failed = |problem: Cause| Error::Runtime {
            runtime: "tract",
            problem,
        };

        // The clip is a view into the batch, but tract needs an owned tensor.
        let numbers: Vec<f32> = clip.iter().copied().collect();
        let input = Tensor::from_shape(clip.shape(), &numbers)
            .map_err(|error| failed(format!("{error:#}").into()))?;
        let outputs = self
            .model
            .run(tvec!(input.into()))
            .map_err(|error| failed(format!("{error:#}").into()))?;

        let array = |output: &tract_onnx::prelude::TValue| {
            let numbers = output.to_plain_array_view::<f32>();
            let numbers = numbers.map_err(|error| failed(format!("{error:#}").into()))?;
            let shape = numbers.shape().to_vec();

            ArrayD::from_shape_vec(shape, numbers.iter().copied().collect())
                .map_err(|error| failed(error.into()))
        };

        outputs.iter().map(array).collect()
    }
}

thread_local! {
    /// Whether panics of this thread are caught and not to be printed.
    static CATCHES: Cell<bool> = const { Cell::new(false) };
}

/// The result of `work`; `None` if it panicked. The panic is not printed.
fn without_panic<T>(work: impl FnOnce() -> T + UnwindSafe) -> Option<T> {
    static HOOK: Once = Once::new();
    HOOK.call_once(|| {
        let printed = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |panic| {
            if !CATCHES.get() {
                printed(panic);
            }
        }));
    });

    CATCHES.set(true);
    let result = std::panic::catch_unwind(work).ok();
    CATCHES.set(false);
    result
}

impl Runner for Tract {
    fn run(&self, input: ArrayD<f32>) -> Result<Vec<ArrayD<f32>>, Error> {
        let clips: Vec<_> = (0..input.shape()[0]).collect();
        let each: Vec<Vec<ArrayD<f32>>> = clips
            .into_par_iter()
            .map(|clip| self.one(input.slice_axis(Axis(0), ndarray::Slice::from(clip..clip + 1))))
            .collect::<Result<_, _>>()?;

        let count = self.names.len();

        // Each run gave a batch of one. The outputs are joined along the batch axis.
        let joined = |output: usize| {
            let parts: Vec<_> = each.iter().map(|outputs| outputs[output].view()).collect();
            ndarray::concatenate(Axis(0), &parts).map_err(|_| {
                let problem = format!("layer '{}' has no batch axis", self.names[output]);
                Error::Runtime {
                    runtime: "tract",
                    problem: problem.into(),
                }
            })
        };

        (0..count).map(joined).collect()
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::*;

    /// Oracle: the contract: a panic is caught and not printed, and other panics are printed as
    /// before.
    #[test]
    fn panics_are_caught_in_silence() {
        static PRINTED: AtomicUsize = AtomicUsize::new(0);
        std::panic::set_hook(Box::new(|_| {
            PRINTED.fetch_add(1, Ordering::Relaxed);
        }));

        assert_eq!(without_panic(|| 7), Some(7));
        assert_eq!(without_panic(|| -> u8 { panic!("caught") }), None);
        assert_eq!(PRINTED.load(Ordering::Relaxed), 0);
        assert!(std::panic::catch_unwind(|| panic!("printed")).is_err());
        assert_eq!(PRINTED.load(Ordering::Relaxed), 1);
    }
}

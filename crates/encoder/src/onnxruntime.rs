//! Models in onnxruntime, whose shared library is loaded when the first model is opened.

use seese3_core::Cause;
use std::path::Path;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use ndarray::{ArrayD, Axis, Slice};
use ort::environment::Environment;
use ort::ep::CUDA;
use ort::session::Session;
use ort::value::TensorRef;

use super::model_file::ModelFile;
use super::runtime::{Device, Runner, Runtime};
use super::{Error, RuntimeKind};

const NAME: &str = "onnxruntime";
/// The session option for the folder of external weight files.
const WEIGHTS_FOLDER: &str = "session.model_external_initializers_file_folder_path";
/// The session option for threads that wait by spinning: they use whole cores between runs.
const SPINNING: &str = "session.intra_op.allow_spinning";

/// The loaded library, or why it could not be loaded. It is loaded once per process.
static LOADED: OnceLock<Result<Environment, String>> = OnceLock::new();

pub(super) struct OnnxRuntime {
    session: Mutex<Session>,
    /// The requested outputs, in order.
    names: Vec<String>,
    /// Whether the model has a fixed batch size of 1.
    is_of_one: bool,
}

impl OnnxRuntime {
    pub fn open(
        file: &Path,
        model: &ModelFile,
        names: &[String],
        shape: &[Option<usize>],
        runtime: &Runtime,
    ) -> Result<Self, Error> {
        let wrong = |problem: Cause| Error::Model {
            file: file.to_owned(),
            problem,
        };

        let environment = environment(runtime.library.as_deref())?;
        let builder = Session::builder(environment).map_err(|error| failed(&error))?;
        let mut builder = builder
            .with_intra_threads(runtime.threads)
            .map_err(|error| failed(&error))?
            .with_config_entry(SPINNING, "0")
            .map_err(|error| failed(&error))?;
        if let Device::Cuda(number) = runtime.device {
            // Without this, a model runs on the CPU if the GPU cannot be used.
            let cuda = CUDA::default().with_device_id(i32::from(number));
            let registered = builder.with_execution_providers([cuda.build().error_on_failure()]);
            builder = registered.map_err(|error| no_device(runtime, &error))?;
        }

        // A model opened from memory needs this folder to find its external weights.
        let folder = file
            .parent()
            .filter(|folder| !folder.as_os_str().is_empty());
        let folder = folder.unwrap_or(Path::new(".")).to_string_lossy();
        builder = builder
            .with_config_entry(WEIGHTS_FOLDER, folder)
            .map_err(|error| failed(&error))?;

        // onnxruntime returns declared outputs only. For an inner value, the model is opened from a
        // copy in memory that declares it as an output.
        let session = if names.iter().all(|name| model.outputs.contains(name)) {
            builder.commit_from_file(file)
        } else {
            builder.commit_from_memory(&model.with_outputs(names))
        };

        let session =
            session.map_err(|error| wrong(format!("cannot be run by {NAME}: {error}").into()))?;
        let is_of_one = shape.first().copied().flatten().is_some();

        Ok(Self {
            session: Mutex::new(session),
            names: names.to_vec(),
            is_of_one,
        })
    }

    fn batch(&self, input: ndarray::ArrayViewD<'_, f32>) -> Result<Vec<ArrayD<f32>>, Error> {
        let input = input.as_standard_layout();
        let tensor = TensorRef::from_array_view(&input).map_err(|error| failed(&error))?;

        // A poisoned lock is safe to use: a run does not change the session.
        let mut session = self.session.lock().unwrap_or_else(PoisonError::into_inner);
        let outputs = session
            .run(ort::inputs![tensor])
            .map_err(|error| failed(&error))?;

        let array = |name: &String| {
            let missing = || Error::Runtime {
                runtime: NAME,
                problem: format!("gave no output '{name}'").into(),
            };
            let output = outputs.get(name).ok_or_else(missing)?;

            Ok(output
                .try_extract_array::<f32>()
                .map_err(|error| failed(&error))?
                .to_owned())
        };

        self.names.iter().map(array).collect()
    }
}

impl Runner for OnnxRuntime {
    fn run(&self, input: ArrayD<f32>) -> Result<Vec<ArrayD<f32>>, Error> {
        // The whole batch is one run, unless the model takes one clip at a time.
        if !self.is_of_one || input.shape()[0] == 1 {
            return self.batch(input.view());
        }

        // A model that was exported with a batch size of 1 is run once for each clip.
        let clips = 0..input.shape()[0];
        let each: Vec<_> = clips
            .map(|clip| self.batch(input.slice_axis(Axis(0), Slice::from(clip..clip + 1))))
            .collect::<Result<_, _>>()?;

        let joined = |output: usize| {
            let parts: Vec<_> = each
                .iter()
                .map(|outputs: &Vec<ArrayD<f32>>| outputs[output].view())
                .collect();
            ndarray::concatenate(Axis(0), &parts).map_err(|error| Error::Runtime {
                runtime: NAME,
                problem: error.to_string().into(),
            })
        };

        (0..self.names.len()).map(joined).collect()
    }
}

fn environment(library: Option<&Path>) -> Result<&'static Environment, Error> {
    let help = "`pip install onnxruntime` installs the library, onnxruntime/capi/libonnxruntime.so.*; give its \
                path with --onnxruntime FILE or ORT_DYLIB_PATH";

    let failed = |problem: Cause| Error::Runtime {
        runtime: RuntimeKind::OnnxRuntime.name(),
        problem,
    };
    let library = library
        .ok_or_else(|| failed(format!("its shared library was not given; {help}").into()))?;

    if !library.is_file() {
        return Err(failed(
            format!("{} is not a file; {help}", library.display()).into(),
        ));
    }

    let load = || {
        let builder = ort::init_from(library).map_err(|error| error.to_string())?;
        builder
            .with_name("seese3")
            .with_telemetry(false)
            // onnxruntime would write to standard error, past the program's log, and wait for it.
            // What fails is returned as an error too.
            .with_logger(Arc::new(|_, _, _, _, _| ()))
            .build()
            .map_err(|error| error.to_string())
    };

    // Later calls get the result of the first one, even if they name another library.
    LOADED.get_or_init(load).as_ref().map_err(|problem| {
        failed(format!("{} cannot be loaded: {problem}; {help}", library.display()).into())
    })
}

fn no_device<T: std::fmt::Display>(runtime: &Runtime, error: &T) -> Error {
    let library = runtime.library.as_deref().unwrap_or(Path::new(""));
    let problem = format!(
        "device {} cannot be used: {error}; it needs a library with CUDA (`pip install onnxruntime-gpu`; {} was \
         loaded), CUDA and cuDNN on the library path, and that GPU",
        runtime.device,
        library.display()
    );
    failed(&problem)
}

fn failed<T: std::fmt::Display>(error: &T) -> Error {
    Error::Runtime {
        runtime: NAME,
        problem: error.to_string().into(),
    }
}

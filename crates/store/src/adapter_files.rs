//! Serialization of adapters: weights as safetensors with golden vectors, which verify that the
//! adapter still computes the same outputs. Also checks files from another store.

use std::sync::Arc;

use nalgebra::{Matrix6, Vector6};
use ndarray::{Array2, ArrayView2};

use super::format::{AdapterBody, TrainingEntry};
use super::stored_adapter::{RoomFit, StoredAdapter};
use super::tensors::{TensorReader, TensorWriter, read_weights};
use super::{Error, error_model, manifest, relational_reader, room_fit, sha256};
use seese3_core::Cause;
use seese3_core::adapter::{
    self, Adapter, Corrector, CorrectorKind, Mixture, Network, TargetScale, TrainingRecord,
};

/// The frame of every twist: the body frame of the source camera.
pub(super) const TWIST_FRAME: &str = "body";
/// Name of the tensor with the second moment Σ of the adapter's errors, (6, 6) f64 on (v, ω).
const ERROR_COVARIANCE: &str = "error.covariance";
/// Maximum number of golden inputs stored with an adapter.
const GOLDEN_ROWS: usize = 8;
/// Tolerance of a golden output, relative to max(1, magnitude of that output).
const GOLDEN_TOLERANCE: f64 = 1e-6;

/// Names in error messages of adapter files that come from elsewhere.
pub(super) const UPLOADED_MANIFEST: &str = "the manifest";
const UPLOADED_WEIGHTS: &str = "the weights";

/// Size of an adapter's weights in bytes, as stated by its manifest.
///
/// # Errors
/// [`Error::Damaged`] if the manifest is truncated or altered, [`Error::Schema`] if a newer program
/// wrote it.
pub fn stated_weights_size(manifest: &[u8]) -> Result<u64, Error> {
    let body: AdapterBody = manifest::decode(UPLOADED_MANIFEST, manifest)?;
    Ok(body.weights.bytes)
}

/// Checks the manifest and the weights of an adapter from another store, and returns the adapter.
///
/// # Errors
/// [`Error::Damaged`] if a file is truncated or altered, if the two do not belong together, or if
/// the adapter was fitted to a room: it is valid only for that room's revision in its own store.
/// [`Error::Schema`] if a newer program wrote the manifest.
pub fn check_adapter_files(manifest: &[u8], weights: &[u8]) -> Result<StoredAdapter, Error> {
    let body: AdapterBody = manifest::decode(UPLOADED_MANIFEST, manifest)?;
    let damaged = |file: &str, problem: &str| Error::Damaged {
        file: file.to_owned(),
        problem: problem.into(),
    };

    if weights.len() as u64 != body.weights.bytes || sha256(weights) != body.weights.sha256 {
        let problem = "do not have the size and the checksum that the manifest states";
        return Err(damaged(UPLOADED_WEIGHTS, problem));
    }
    if body.fitted_to.is_some() {
        let problem =
            "is of an adapter that was fitted to a room of its own store; fit one to the room here";
        return Err(damaged(UPLOADED_MANIFEST, problem));
    }

    assembled(body, UPLOADED_MANIFEST, UPLOADED_WEIGHTS, weights)
}

/// Builds the adapter from its manifest and weights, and checks its golden vectors. `manifest` and
/// `file` name the two in errors.
pub(super) fn assembled(
    body: AdapterBody,
    manifest: &str,
    file: &str,
    bytes: &[u8],
) -> Result<StoredAdapter, Error> {
    // Motions in another frame or of another scale would be silently wrong, so check the
    // conventions before reading any tensor.
    if body.twist_frame != TWIST_FRAME || body.deviation_ddof != 0 {
        let problem = format!(
            "has twists in the frame '{}' and targets of ddof {}; this program supports only \
            '{TWIST_FRAME}' and 0",
            body.twist_frame, body.deviation_ddof
        );
        return Err(Error::Damaged {
            file: manifest.to_owned(),
            problem: problem.into(),
        });
    }

    let damaged = |problem: Cause| Error::Damaged {
        file: file.to_owned(),
        problem,
    };

    let tensors = TensorReader::new(file, bytes)?;
    let error_model = error_model::read(&tensors, file)?;

    // The tensor names follow from the number of charts and their mixing, both stored in the
    // manifest.
    let config = &body.training.config;
    let network = Mixture::from_tensors(config.charts, config.mixing, |name| {
        read_weights(&tensors, name)
    });
    let network = network.map_err(|error| error.within(file))?;

    // W predicts z-scored motions; μ and σ convert them back to meters and radians.
    let scale = TargetScale {
        mean: vector6(&tensors, "target.mean", file)?,
        deviation: vector6(&tensors, "target.deviation", file)?,
    };

    let error_covariance = match tensors.has(ERROR_COVARIANCE) {
        true => Some(matrix6(&tensors, ERROR_COVARIANCE, file)?),
        false => None,
    };

    let correctors = read_correctors(&tensors, &body.training, network.coordinate_count(), file)?;

    // Each optional part is checked as it is added.
    let adapter = Adapter::new(body.source, network, scale)
        .and_then(|adapter| adapter.with_correctors(correctors))
        .and_then(|adapter| match error_covariance {
            Some(covariance) => adapter.with_error_covariance(covariance),
            None => Ok(adapter),
        })
        .and_then(|adapter| match error_model {
            Some(error_model) => adapter.with_error_model(error_model),
            None => Ok(adapter),
        })
        .map_err(|error| damaged(error.into()))?;

    // The checksums prove that the file is intact. The golden vectors prove that this program, on
    // this machine, still computes the same function.
    check_golden(&adapter, &tensors, file)?;
    let record = TrainingRecord::from(body.training);

    // Its own golden motions are checked while it is read.
    let adapter = match &record.relational {
        Some(config) => {
            let reader = relational_reader::read(&tensors, adapter.source(), config.members, file)?;
            adapter
                .with_relational(reader)
                .map_err(|error| damaged(error.into()))?
        }
        None => adapter,
    };

    let room_fit = match body.fitted_to {
        Some(entry) => Some(room_fit::read(entry, &tensors, file)?),
        None => None,
    };

    Ok(StoredAdapter {
        room_fit,
        is_experiment: body.experiment,
        name: body.adapter,
        revision: body.revision,
        created: body.created,
        adapter: Arc::new(adapter),
        record,
    })
}

/// Reads the correctors listed in the manifest. They share the weights file; a prefix identifies
/// their tensors.
fn read_correctors(
    tensors: &TensorReader<'_>,
    training: &TrainingEntry,
    coordinate_count: usize,
    file: &str,
) -> Result<Vec<Corrector<f32>>, Error> {
    let corrector = |&kind: &CorrectorKind| {
        let read = |tensor: &str| read_weights(tensors, &corrector_tensor(kind, tensor));

        Corrector::from_tensors(kind, coordinate_count, read).map_err(|error| error.within(file))
    };

    training.correctors.iter().map(corrector).collect()
}

fn corrector_tensor(kind: CorrectorKind, tensor: &str) -> String {
    format!("corrector.{}.{tensor}", kind.name())
}

/// The PyTorch shape of a tensor; in this program every tensor is two-dimensional.
fn torch_shape(name: &str, array: &Array2<f32>) -> Vec<usize> {
    let last = name.rsplit('.').next().unwrap_or(name);
    match array.dim() {
        (1, 1) if last == "log_tau" => Vec::new(),
        (1, columns) if last.contains("bias") || is_norm(name) => vec![columns],
        (rows, columns) => vec![rows, columns],
    }
}

/// Whether a tensor is a LayerNorm's weight, which is a vector.
fn is_norm(name: &str) -> bool {
    name.ends_with("phi.1.weight") || name.contains(".norm") || name.starts_with("norm")
}

pub(super) fn adapter_file(
    name: &str,
    adapter: &Adapter,
    features: ArrayView2<'_, f32>,
    room_fit: Option<&RoomFit>,
) -> Result<Vec<u8>, Error> {
    let mut tensors = TensorWriter::default();

    // Weights keep PyTorch's names and shapes.
    for (name, array) in adapter
        .network()
        .names()
        .iter()
        .zip(adapter.network().parameters())
    {
        tensors.f32(name, &torch_shape(name, array), array.iter().copied());
    }

    for corrector in adapter.correctors() {
        for (name, array) in corrector.names().iter().zip(corrector.parameters()) {
            let shape = torch_shape(name, array);
            let name = corrector_tensor(corrector.kind(), name);
            tensors.f32(&name, &shape, array.iter().copied());
        }
    }

    tensors.f64("target.mean", &[6], adapter.scale().mean.iter().copied());

    tensors.f64(
        "target.deviation",
        &[6],
        adapter.scale().deviation.iter().copied(),
    );

    if let Some(covariance) = adapter.error_covariance() {
        tensors.f64(
            ERROR_COVARIANCE,
            &[6, 6],
            covariance.transpose().iter().copied(),
        );
    }

    if let Some(error_model) = adapter.error_model() {
        error_model::write(&mut tensors, error_model);
    }

    if let Some(room_fit) = room_fit {
        room_fit::write(&mut tensors, &room_fit.rules);
    }

    write_golden(&mut tensors, adapter, features).map_err(|error| Error::Damaged {
        file: name.to_owned(),
        problem: error.into(),
    })?;
    tensors.finish(name)
}

/// Writes golden vectors: a sample of the training features with the adapter's outputs for them.
fn write_golden(
    tensors: &mut TensorWriter,
    adapter: &Adapter,
    features: ArrayView2<'_, f32>,
) -> Result<(), adapter::Error> {
    // The golden inputs are spread evenly over the training features.
    let rows: Vec<usize> = (0..features.nrows())
        .step_by(features.nrows().div_ceil(GOLDEN_ROWS).max(1))
        .collect();
    let golden = features.select(ndarray::Axis(0), &rows);

    // The golden outputs are the current outputs: latents, motions and corrected steps.
    let latents = adapter.embed(golden.view())?;

    let twists = golden_twists(adapter, &latents);

    tensors.f32(
        "golden.features",
        &[golden.nrows(), golden.ncols()],
        golden.iter().copied(),
    );

    tensors.f64(
        "golden.latents",
        &[latents.nrows(), latents.ncols()],
        latents.iter().copied(),
    );

    tensors.f64(
        "golden.twists",
        &[twists.nrows(), 6],
        twists.iter().copied(),
    );

    if let Some(reader) = adapter.relational() {
        relational_reader::write(tensors, reader, golden.view())?;
    }

    for corrector in adapter.correctors() {
        let steps = golden_steps(adapter, corrector.kind(), &latents)?;
        let name = golden_corrector(corrector.kind());
        tensors.f64(
            &name,
            &[steps.nrows(), steps.ncols()],
            steps.iter().copied(),
        );
    }

    Ok(())
}

/// The motions from the first golden latent to each golden latent, shape (n, 6).
fn golden_twists(adapter: &Adapter, latents: &Array2<f64>) -> Array2<f64> {
    Array2::from_shape_fn((latents.nrows(), 6), |(row, column)| {
        adapter.motion(latents.row(0), latents.row(row)).to_vector()[column]
    })
}

fn golden_corrector(kind: CorrectorKind) -> String {
    format!("golden.corrector.{}", kind.name())
}

/// The corrected latent step at each golden latent, for the motion from the first golden latent to
/// it. Same shape as `latents`.
fn golden_steps(
    adapter: &Adapter,
    kind: CorrectorKind,
    latents: &Array2<f64>,
) -> Result<Array2<f64>, adapter::Error> {
    let mut steps = Array2::zeros(latents.dim());
    for (latent, mut into) in latents.outer_iter().zip(steps.outer_iter_mut()) {
        let twist = adapter.motion(latents.row(0), latent);
        into.assign(&adapter.corrected_step(kind, latent, twist)?);
    }

    Ok(steps)
}

fn check_golden(adapter: &Adapter, tensors: &TensorReader<'_>, file: &str) -> Result<(), Error> {
    let damaged = |problem: Cause| Error::Damaged {
        file: file.to_owned(),
        problem,
    };

    let features = tensors.f32("golden.features")?;

    // Without inputs, every comparison below would pass.
    if features.nrows() == 0 {
        return Err(damaged("has no golden inputs".into()));
    }

    let latents = adapter
        .embed(features.view())
        .map_err(|error| damaged(error.into()))?;
    let twists = golden_twists(adapter, &latents);

    // Recompute every output and pair it with the stored one.
    let mut checked = Vec::new();
    for corrector in adapter.correctors() {
        let kind = corrector.kind();
        let steps = golden_steps(adapter, kind, &latents).map_err(|error| damaged(error.into()))?;
        checked.push((kind.name(), steps, tensors.f64(&golden_corrector(kind))?));
    }

    checked.push(("latents", latents, tensors.f64("golden.latents")?));
    checked.push(("twists", twists, tensors.f64("golden.twists")?));

    // Summation may round differently on another machine, so outputs need not match bit for bit.
    for (what, found, stored) in checked {
        let near = |(found, stored): (&f64, &f64)| {
            // An infinite output would have an infinite tolerance, so it fails.
            stored.is_finite() && (found - stored).abs() <= GOLDEN_TOLERANCE * stored.abs().max(1.0)
        };
        if found.dim() != stored.dim() || !found.iter().zip(&stored).all(near) {
            return Err(damaged(format!(
                "its golden inputs do not give its golden {what} on this machine; publish it again"
            ).into()));
        }
    }

    Ok(())
}

fn matrix6(tensors: &TensorReader<'_>, name: &str, file: &str) -> Result<Matrix6<f64>, Error> {
    let array = tensors.f64(name)?;
    if array.dim() != (6, 6) {
        return Err(Error::Damaged {
            file: file.to_owned(),
            problem: format!("'{name}' does not have 6 by 6 numbers").into(),
        });
    }

    Ok(Matrix6::from_fn(|row, column| array[(row, column)]))
}

pub(super) fn vector6(
    tensors: &TensorReader<'_>,
    name: &str,
    file: &str,
) -> Result<Vector6<f64>, Error> {
    let array = tensors.f64(name)?;
    if array.dim() != (1, 6) {
        return Err(Error::Damaged {
            file: file.to_owned(),
            problem: format!("'{name}' does not have 6 numbers").into(),
        });
    }

    Ok(Vector6::from_fn(|row, _| array[(0, row)]))
}

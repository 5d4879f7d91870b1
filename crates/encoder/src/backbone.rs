//! Backbones compute the outputs of layers from prepared images: built in, or an ONNX model in one
//! of two runtimes.

use seese3_core::Cause;
use std::path::Path;

use ndarray::{ArrayD, Axis};

use super::model_file::ModelFile;
use super::runtime::{Runner, Runtime, RuntimeKind};
use super::{Error, Preparation};

/// What computes the outputs of layers from prepared images.
pub(super) enum Backbone {
    /// [`super::encode_builtin`].
    Builtin,
    /// The prepared image itself.
    Pixels,
    Model {
        runner: Box<dyn Runner>,
        kind: RuntimeKind,
        /// The clip axis of the model's input; `None` for a model of single images.
        clip_axis: Option<usize>,
    },
}

impl Backbone {
    pub fn runtime(&self) -> &'static str {
        match self {
            Self::Builtin | Self::Pixels => "none",
            Self::Model { kind, .. } => kind.name(),
        }
    }
}

/// A model, its identity, and the size (width, height) of its images if it is fixed.
pub(super) type Opened = (Backbone, String, Option<(usize, usize)>);

/// Opens a model after checking that its file has the layers, the clip length and the image size.
pub(super) fn open(
    file: &Path,
    preparation: &Preparation,
    names: &[String],
    window: usize,
    runtime: &Runtime,
) -> Result<Opened, Error> {
    preparation.check()?;
    let model = ModelFile::read(file)?;

    let wrong = |problem: Cause| Error::Model {
        file: file.to_owned(),
        problem,
    };

    if names.is_empty() {
        return Err(wrong("no layer was requested".into()));
    }

    // A layer may be a declared output or any other value that the graph computes.
    for (position, name) in names.iter().enumerate() {
        if !model.outputs.contains(name) && !model.inner.contains(name) {
            let known = model.outputs.join(", ");
            return Err(wrong(
                format!("has no layer '{name}'; its outputs are {known}").into(),
            ));
        }

        if names[..position].contains(name) {
            return Err(wrong(format!("layer '{name}' was requested twice").into()));
        }
    }

    let clip_axis = clip_axis(&model.input, window).map_err(|problem| wrong(problem.into()))?;

    // A room need not be a multiple of such a batch, and a server encodes batches of one image.
    if let Some(batch) = model.input[0].filter(|&batch| batch > 1) {
        return Err(wrong(format!(
            "takes batches of exactly {batch} images; export it with an example of one image, or with \
             dynamic_shapes={{\"image\": {{0: \"batch\"}}}}"
        ).into()));
    }

    // The shape of the model's input. Dynamic axes get the sizes of the prepared images and of the
    // clips, because tract needs all but the first.
    let mut shape = model.input.clone();

    if let (Some(wanted), Some(given)) = (model.image_size(), preparation.size())
        && wanted != given
    {
        let (width, height) = wanted;
        let (w, h) = given;

        return Err(wrong(
            format!("takes images of {width}x{height}, but --resize and --crop give {w}x{h}")
                .into(),
        ));
    }

    let size = preparation.size().or(model.image_size());
    if let Some((width, height)) = size {
        let rank = shape.len();
        shape[rank - 2] = Some(height);
        shape[rank - 1] = Some(width);
    }

    if let Some(axis) = clip_axis {
        shape[axis] = Some(window);
    }

    let kind = runtime.kind;
    if !kind.is_built() {
        return Err(Error::NotBuilt {
            runtime: kind.name(),
        });
    }

    let id = model.id.clone();
    let runner = runner(file, model, names, &shape, runtime)?;

    Ok((
        Backbone::Model {
            runner,
            kind,
            clip_axis,
        },
        id,
        size,
    ))
}

#[cfg_attr(
    not(feature = "onnxruntime"),
    allow(unused_variables, reason = "each runtime takes a part")
)]
fn runner(
    file: &Path,
    model: ModelFile,
    names: &[String],
    shape: &[Option<usize>],
    runtime: &Runtime,
) -> Result<Box<dyn Runner>, Error> {
    match runtime.kind {
        #[cfg(feature = "onnx")]
        RuntimeKind::Tract if runtime.device != super::Device::Cpu => Err(Error::Runtime {
            runtime: RuntimeKind::Tract.name(),
            problem: format!(
                "runs on the CPU only; for device {}, choose the runtime {}",
                runtime.device,
                RuntimeKind::OnnxRuntime.name()
            )
            .into(),
        }),
        #[cfg(feature = "onnx")]
        RuntimeKind::Tract => Ok(Box::new(super::tract::Tract::open(file, names, shape)?)),
        #[cfg(feature = "onnxruntime")]
        RuntimeKind::OnnxRuntime => Ok(Box::new(super::onnxruntime::OnnxRuntime::open(
            file, &model, names, shape, runtime,
        )?)),
        #[allow(unreachable_patterns, reason = "reached where a runtime was not built")]
        other => Err(Error::NotBuilt {
            runtime: other.name(),
        }),
    }
}

/// The clip axis of a model's input. An input (batch, 3, height, width) has none; (batch, 3, clip,
/// height, width) and (batch, clip, 3, height, width) have one.
fn clip_axis(input: &[Option<usize>], window: usize) -> Result<Option<usize>, String> {
    let colors = |axis: usize| matches!(input[axis], None | Some(3));

    // With five axes, the one of size 3 is the channels; the other one before the height is the
    // clip. `fixed` is the length of a clip, if the file states it.
    let (axis, fixed) = match input.len() {
        4 if colors(1) && window == 1 => return Ok(None),
        4 if colors(1) => {
            return Err(format!(
                "takes single images, not clips of {window}; leave out --window"
            ));
        }
        5 if input[2] == Some(3) => (1, input[1]),
        5 if input[1] == Some(3) => (2, input[2]),
        _ => {
            let shape: Vec<String> = input
                .iter()
                .map(|size| size.map_or("?".to_owned(), |n| n.to_string()))
                .collect();
            return Err(format!(
                "has an input of shape [{}]; expected [batch, 3, height, width], or five axes with a clip",
                shape.join(", ")
            ));
        }
    };

    match fixed {
        Some(length) if length != window => Err(format!(
            "takes clips of {length} images; give --window {length}"
        )),
        _ => Ok(Some(axis)),
    }
}

/// Reorders the axes of clips (batch, clip, 3, height, width) to those of the model's input.
pub(super) fn laid_out(frames: ArrayD<f32>, clip_axis: Option<usize>) -> ArrayD<f32> {
    match clip_axis {
        None => frames.index_axis_move(Axis(1), 0),
        Some(1) => frames,
        Some(_) => frames
            .permuted_axes(vec![0, 2, 1, 3, 4])
            .as_standard_layout()
            .into_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: the shapes by hand.
    #[test]
    fn a_clip_is_found_by_its_place_beside_the_colors() {
        let n = None;
        assert_eq!(clip_axis(&[n, Some(3), Some(240), Some(320)], 1), Ok(None));
        assert_eq!(clip_axis(&[n, Some(3), n, n], 1), Ok(None));
        assert_eq!(clip_axis(&[n, Some(16), Some(3), n, n], 16), Ok(Some(1)));

        assert_eq!(clip_axis(&[n, Some(3), n, n, n], 8), Ok(Some(2)));

        assert!(
            clip_axis(&[n, Some(3), n, n], 4)
                .unwrap_err()
                .contains("single images")
        );

        assert!(
            clip_axis(&[n, Some(16), Some(3), n, n], 8)
                .unwrap_err()
                .contains("--window 16")
        );

        assert!(clip_axis(&[n, Some(10)], 1).is_err());
        assert!(clip_axis(&[n, Some(1), n, n], 1).is_err(), "grey");
    }

    /// Oracle: by hand: with two images a clip, channels move before images.
    #[test]
    fn channels_and_images_change_places() {
        let frames = ArrayD::from_shape_fn(vec![1, 2, 3, 1, 1], |index| {
            (10 * index[1] + index[2]) as f32
        });
        let moved = laid_out(frames, Some(2));

        assert_eq!(moved.shape(), [1, 3, 2, 1, 1]);

        assert_eq!(
            moved.into_raw_vec_and_offset().0,
            [0.0, 10.0, 1.0, 11.0, 2.0, 12.0]
        );
    }
}

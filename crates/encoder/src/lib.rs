//! Encoders: images to features, several layers in one pass.
//!
//! - An image is decoded, resized and cropped in 8 bit, normalized, and run through a network; the
//!   output of each layer is pooled to one row.
//! - The [`FeatureSource`] of features records everything that determines them, so that the
//!   [`Encoder`] can be rebuilt from a source and the model's file alone.
//!
//! ```
//! use seese3_core::image::RgbImage;
//! use seese3_encoder::{BUILTIN_DIM, Encoder};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! // The built-in encoder needs no model file. A clip is one image here.
//! let image = RgbImage {
//!     width: 64,
//!     height: 48,
//!     bytes: vec![128; 64 * 48 * 3],
//! };
//! let features = Encoder::builtin().encode(&[vec![&image]])?;
//! assert_eq!(features.dim(), (1, BUILTIN_DIM));
//! # Ok(()) }
//! ```

mod builtin;
mod decode;
mod journal;
mod keypoints;
mod model_file;
mod pooling;
mod preparation;
mod preprocess;
mod preprocess_file;
mod runtime;
#[cfg(feature = "onnxruntime")]
mod onnxruntime;
mod recipes;
mod run;
mod thumbnail;
#[cfg(feature = "onnx")]
mod tract;
mod backbone;

pub use builtin::{BUILTIN_DIM, builtin_source, encode_builtin};
pub use decode::{
    Bounds, DecodingCost, GrayImage16, decode, decode_gray16, decoding_cost, encode_png,
    image_size, read_image, read_image_bytes,
};
pub use journal::{EncodedFrame, Journal, NumberedFrames};
pub use keypoints::KeypointOutputs;
pub use pooling::Pooling;
pub use preparation::{Filter, Preparation, Resize, normalized};
pub use preprocess::Preprocess;
pub use preprocess_file::read_preprocess_file;
pub use recipes::{EncoderRecipe, RECIPES, RunWeights, recipe};
pub use run::{Encoded, Kept, OnBadImage, Task, encode_room};
pub use runtime::{Device, Runtime, RuntimeKind};
pub use thumbnail::thumbnail;

use std::path::{Path, PathBuf};

use ndarray::{Array2, ArrayD, Axis, IxDyn};

use backbone::Backbone;
use keypoints::KeypointMaps;
use seese3_core::Cause;
use seese3_core::features::FeatureSource;
use seese3_core::image::RgbImage;
use seese3_core::keypoints::{KeypointSource, Keypoints};
use seese3_core::room::is_plain_name;

/// What can go wrong between an image file and a feature.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "each variant's message says what it is")]
pub enum Error {
    #[error("{}: {cause}", file.display())]
    Io {
        file: PathBuf,
        #[source]
        cause: std::io::Error,
    },
    #[error("{image}: {problem}")]
    BadImage {
        image: String,
        #[source]
        problem: Cause,
    },
    #[error("{what} '{given}': {problem}")]
    Option {
        what: &'static str,
        given: String,
        #[source]
        problem: Cause,
    },
    #[error("{}: {problem}", file.display())]
    Model {
        file: PathBuf,
        #[source]
        problem: Cause,
    },
    #[error("the runtime '{runtime}' failed: {problem}")]
    Runtime {
        runtime: &'static str,
        #[source]
        problem: Cause,
    },
    #[error(
        "this program was built without the runtime '{runtime}'; build it with \
         `cargo install --path . --features full` (or `cargo build --release --features full`)"
    )]
    NotBuilt { runtime: &'static str },
    #[error("layer '{layer}' gave {value} in column {column}; a feature must be finite")]
    NotFinite {
        layer: String,
        column: usize,
        value: f32,
    },
    #[error("room '{room}' has no images; import it from a recording with images")]
    NoImages { room: String },
    #[error("no image of room '{room}' can be read")]
    AllBad { room: String },
    #[error(transparent)]
    Cancelled(#[from] seese3_core::cancel::Cancelled),
}

/// A layer of a model whose output becomes a feature (A-13).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Layer {
    /// The output's name in the model.
    pub name: String,
    /// The number of the first layer, `0` or `1`, or `name` if the name has no number.
    pub base: String,
    /// Whether the encoder's final normalization layer is included: `none`, `final` or
    /// `unspecified`.
    pub norm: String,
    /// How the output is reduced to one row.
    pub pooling: Pooling,
}

/// A model and the settings with which an encoder runs it.
#[derive(Debug, Clone)]
pub struct ModelTask {
    /// The ONNX file.
    pub file: PathBuf,
    /// How images are prepared for it.
    pub preparation: Preparation,
    /// The layers whose outputs become features.
    pub layers: Vec<Layer>,
    /// The number of images in a clip; 1 for a model of single images.
    pub window: usize,
    /// The outputs from which keypoints are detected, for a model with keypoint heads.
    pub keypoints: Option<KeypointOutputs>,
    /// Whether the number of prefix tokens was given explicitly. If not, a mean or grid that would
    /// include prefix tokens is an error.
    pub is_prefix_stated: bool,
}

/// The identity of the encoder [`Encoder::pixels`].
pub const PIXELS: &str = "pixels";

/// Turns clips of images into features.
pub struct Encoder {
    id: String,
    preparation: Preparation,
    backbone: Backbone,
    layers: Vec<Layer>,
    dims: Vec<usize>,
    window: usize,
    /// The size (width, height) of prepared images, if the preparation or the model fixes it.
    size: Option<(usize, usize)>,
    keypoints: Option<KeypointOutputs>,
}

impl Encoder {
    /// The built-in, weight-free encoder.
    pub fn builtin() -> Self {
        let source = builtin_source("");
        Self {
            id: source.encoder,
            preparation: builtin::preparation(),
            backbone: Backbone::Builtin,
            layers: vec![Layer {
                name: source.layer,
                base: source.base,
                norm: source.norm,
                pooling: builtin::POOLING,
            }],
            dims: vec![BUILTIN_DIM],
            window: 1,
            size: Some((64, 48)),
            keypoints: None,
        }
    }

    /// Raw pixels, the paper's baseline: the image is resized to 320×240 and averaged over 16×12
    /// patches, each channel alone, values 0 to 1.
    pub fn pixels() -> Self {
        let pooling = Pooling::Grid {
            columns: 16,
            rows: 12,
            skip: 0,
        };

        Self {
            id: PIXELS.to_owned(),
            preparation: Preparation {
                resize: Resize::Whole {
                    width: 320,
                    height: 240,
                },
                divisor: 255.0,
                ..Preparation::default()
            },
            backbone: Backbone::Pixels,
            layers: vec![Layer {
                name: PIXELS.to_owned(),
                base: "name".to_owned(),
                norm: "none".to_owned(),
                pooling,
            }],
            dims: vec![3 * 16 * 12],
            window: 1,
            size: Some((320, 240)),
            keypoints: None,
        }
    }

    /// Opens an ONNX model and runs it once on two clips of gray images, to find wrong names and
    /// shapes before a room is encoded.
    ///
    /// # Errors
    /// [`Error::Io`] if the file cannot be read, [`Error::Option`] if the preparation's numbers are
    /// invalid, [`Error::Model`] if the file does not fit the task, [`Error::NotBuilt`] if this
    /// program lacks the runtime, [`Error::Runtime`] if the trial run fails.
    pub fn model(task: ModelTask, runtime: &Runtime) -> Result<Self, Error> {
        let ModelTask {
            file,
            preparation,
            layers,
            window,
            keypoints,
            is_prefix_stated,
        } = task;

        // Keypoint positions refer to the whole image.
        if keypoints.is_some() && (preparation.crop.is_some() || window != 1) {
            return Err(Error::Model {
                file,
                problem: "detects keypoints, so its images may not be cropped or in clips; leave out --crop \
                          and --window"
                    .into(),
            });
        }

        let names = layers.iter().map(|layer| &layer.name);
        let heads = keypoints.iter().flat_map(KeypointOutputs::names);
        let names: Vec<String> = names.chain(heads).cloned().collect();
        let (backbone, id, size) = backbone::open(&file, &preparation, &names, window, runtime)?;

        let mut encoder = Self {
            id,
            preparation,
            backbone,
            layers,
            dims: Vec::new(),
            window,
            size,
            keypoints,
        };

        // The trial run gives the rank and width of each output. If no size is fixed, it uses a
        // small image.
        let (width, height) = size.unwrap_or((64, 64));
        check_input_size(&file, width, height)?;
        let grey = RgbImage {
            width,
            height,
            bytes: vec![127; width * height * 3],
        };

        // Two clips reveal an output whose first axis is not the batch.
        let outputs = encoder.outputs(&[vec![&grey; window], vec![&grey; window]])?;

        let seen = pooling::InputSize {
            width,
            height,
            window,
        };

        for (layer, output) in encoder.layers.iter_mut().zip(&outputs) {
            let problem = |problem: Cause| Error::Model {
                file: file.clone(),
                problem,
            };

            let one = output.index_axis(Axis(0), 0);

            // A vector output is not pooled, whatever pooling was requested.
            layer.pooling = layer.pooling.for_rank(one.ndim());
            if !is_prefix_stated {
                let checked = layer.pooling.check_prefix(one.shape(), seen);
                checked
                    .map_err(|error| problem(format!("layer '{}': {error}", layer.name).into()))?;
            }

            let row = layer.pooling.pool(one, seen);
            let row =
                row.map_err(|error| problem(format!("layer '{}': {error}", layer.name).into()))?;
            encoder.dims.push(row.len());
        }

        let detected = encoder.detect(&outputs, 0);
        detected.map_err(|problem| Error::Model {
            file,
            problem: problem.into(),
        })?;

        Ok(encoder)
    }

    /// Rebuilds the encoder that made `source`. `models` are the candidates: `builtin`, `pixels`,
    /// or paths of ONNX files. Returns `None` if none of them is that encoder.
    ///
    /// # Errors
    /// As [`Encoder::model`], and [`Error::Option`] if the source's preparation or pooling cannot
    /// be parsed.
    pub fn of_source(
        source: &FeatureSource,
        models: &[String],
        runtime: &Runtime,
    ) -> Result<Option<Self>, Error> {
        Self::rebuilt(source, None, models, runtime)
    }

    /// Rebuilds the encoder of a room's keypoints and of the features of the same pass, like
    /// [`Encoder::of_source`].
    ///
    /// # Errors
    /// As [`Encoder::of_source`].
    pub fn of_keypoints(
        source: &KeypointSource,
        models: &[String],
        runtime: &Runtime,
    ) -> Result<Option<Self>, Error> {
        let outputs = KeypointOutputs {
            positions: source.positions.clone(),
            reliability: source.reliability.clone(),
            descriptors: source.descriptors.clone(),
        };
        Self::rebuilt(&source.feature, Some(outputs), models, runtime)
    }

    fn rebuilt(
        source: &FeatureSource,
        keypoints: Option<KeypointOutputs>,
        models: &[String],
        runtime: &Runtime,
    ) -> Result<Option<Self>, Error> {
        // Joined features are computed in one pass, so all parts have the same model and
        // preparation.
        let parts = source.parts();
        let first = &parts[0];
        let is_one_pass = |part: &FeatureSource| {
            part.encoder == first.encoder && part.preprocess == first.preprocess
        };
        if !parts.iter().all(is_one_pass) {
            return Ok(None);
        }

        for model in models {
            let plain = match model.as_str() {
                "builtin" => Some(Self::builtin()),
                PIXELS => Some(Self::pixels()),
                _ => None,
            };

            // The two encoders without a model have no options, so their whole sources are
            // compared.
            if let Some(encoder) = plain {
                if encoder.sources("")[0].is_like(source) {
                    return Ok(Some(encoder));
                }
                continue;
            }

            let file = Path::new(model);
            if model_file::identity(file)? != first.encoder {
                continue;
            }

            // The file is the right one; everything else about the encoder is read back from the
            // source.
            let (preparation, window) = Preparation::parse(&first.preprocess)?;

            let mut layers = Vec::with_capacity(parts.len());
            for part in parts {
                layers.push(Layer {
                    name: part.layer.clone(),
                    base: part.base.clone(),
                    norm: part.norm.clone(),
                    pooling: part.pooling.parse()?,
                });
            }

            let task = ModelTask {
                file: file.to_owned(),
                preparation,
                layers,
                window,
                keypoints,
                is_prefix_stated: true,
            };

            return Self::model(task, runtime).map(Some);
        }

        Ok(None)
    }

    /// The sources of its layers' features, in order. Each is named `PREFIX-LAYER-POOLING`, or
    /// `PREFIX-LAYER` if the output is a vector. Encoders without a model use the prefix alone.
    pub fn sources(&self, prefix: &str) -> Vec<FeatureSource> {
        let made = |(layer, &dim): (&Layer, &usize)| FeatureSource {
            name: feature_name(prefix, layer, &self.backbone),
            encoder: self.id.clone(),
            layer: layer.name.clone(),
            base: layer.base.clone(),
            norm: layer.norm.clone(),
            pooling: layer.pooling.to_string(),
            preprocess: self.preparation.describe(self.window),
            dim,
            parts: Vec::new(),
        };

        self.layers.iter().zip(&self.dims).map(made).collect()
    }

    /// The name of its runtime; `none` for the encoders without a model.
    pub fn runtime(&self) -> &'static str {
        self.backbone.runtime()
    }

    /// The encoder's identity. For a model it is the file's name without extension, and the
    /// beginning of the file's SHA-256.
    pub fn id(&self) -> &str {
        &self.id
    }

    /// The number of images in a clip.
    pub fn window(&self) -> usize {
        self.window
    }

    /// The outputs from which it detects keypoints, if it does.
    pub fn keypoint_outputs(&self) -> Option<&KeypointOutputs> {
        self.keypoints.as_ref()
    }

    /// The number of columns of each layer's feature.
    pub fn dims(&self) -> &[usize] {
        &self.dims
    }

    /// The size (width, height) at which to render images so that they need no resizing. The aspect
    /// ratio is 4:3 where the preparation leaves it open.
    pub fn render_size(&self) -> (usize, usize) {
        match self.preparation.resize {
            Resize::Whole { width, height } => (width, height),
            Resize::Shortest(edge) => (edge * 4 / 3, edge),
            Resize::None => self.preparation.crop.unwrap_or((320, 240)),
        }
    }

    /// Resizes and crops an image for this encoder, in 8 bit.
    ///
    /// # Errors
    /// [`Error::BadImage`] if it is empty, too small for the crop, or would be resized to an image
    /// over the size limit.
    pub fn prepare(&self, image: RgbImage) -> Result<RgbImage, Error> {
        self.preparation.pixels(image)
    }

    /// Features of prepared clips, shape (clips, sum of [`Encoder::dims`]): one row per clip, with
    /// the columns of all layers side by side.
    ///
    /// # Errors
    /// As [`Encoder::encode_frames`].
    pub fn encode(&self, clips: &[Vec<&RgbImage>]) -> Result<Array2<f32>, Error> {
        let frames = self.encode_frames(clips)?;
        let width = self.dims.iter().sum();
        let mut rows = Array2::zeros((clips.len(), width));
        for (mut row, frame) in rows.outer_iter_mut().zip(&frames) {
            row.assign(&ndarray::aview1(&frame.feature));
        }

        Ok(rows)
    }

    /// Features of prepared clips, and keypoints if the encoder detects them.
    ///
    /// # Errors
    /// [`Error::BadImage`] if images have different sizes or a size that the model does not take,
    /// [`Error::Runtime`] if the network fails, [`Error::NotFinite`] if a feature is not finite.
    pub fn encode_frames(&self, clips: &[Vec<&RgbImage>]) -> Result<Vec<EncodedFrame>, Error> {
        if clips.is_empty() {
            return Ok(Vec::new());
        }

        // The built-in encoder computes whole rows, so that nothing is left to pool.
        if matches!(self.backbone, Backbone::Builtin) {
            let encoded = |clip: &Vec<&RgbImage>| EncodedFrame {
                feature: encode_builtin(clip[0]),
                keypoints: None,
            };
            return Ok(clips.iter().map(encoded).collect());
        }

        let outputs = self.outputs(clips)?;
        let rows = self.pooled(clips, &outputs)?;

        let mut frames = Vec::with_capacity(clips.len());
        for (place, row) in rows.outer_iter().enumerate() {
            let keypoints = self.detect(&outputs, place);
            frames.push(EncodedFrame {
                feature: row.to_vec(),
                keypoints: keypoints.map_err(|problem| Error::Runtime {
                    runtime: self.backbone.runtime(),
                    problem: problem.into(),
                })?,
            });
        }

        Ok(frames)
    }

    /// Keypoints of the image at `place` of a batch, from the last three outputs; `None` if the
    /// encoder detects none.
    fn detect(&self, outputs: &[ArrayD<f32>], place: usize) -> Result<Option<Keypoints>, String> {
        if self.keypoints.is_none() {
            return Ok(None);
        }

        let map = |output: usize| outputs[self.layers.len() + output].index_axis(Axis(0), place);
        let maps = KeypointMaps::new(map(0), map(1), map(2))?;
        Ok(Some(maps.detect()))
    }

    /// Pooled outputs of all layers, shape (clips, sum of [`Encoder::dims`]).
    fn pooled(
        &self,
        clips: &[Vec<&RgbImage>],
        outputs: &[ArrayD<f32>],
    ) -> Result<Array2<f32>, Error> {
        let width = self.dims.iter().sum();
        let mut rows = Array2::zeros((clips.len(), width));
        let runtime = self.backbone.runtime();

        let seen = pooling::InputSize {
            width: clips[0][0].width,
            height: clips[0][0].height,
            window: self.window,
        };

        // Each layer fills its own columns of the row, which begin at `from`.
        let mut from = 0;
        for ((layer, &dim), output) in self.layers.iter().zip(&self.dims).zip(outputs) {
            for (mut row, one) in rows.outer_iter_mut().zip(output.outer_iter()) {
                let pooled = layer.pooling.pool(one, seen);
                let pooled = pooled.map_err(|error| Error::Runtime {
                    runtime,
                    problem: error.into(),
                })?;

                // The trial run gave `dim`. Another width would not fit the columns of the layer.
                if pooled.len() != dim {
                    let problem = format!(
                        "layer '{}' gave {} columns, expected {dim}",
                        layer.name,
                        pooled.len()
                    );
                    return Err(Error::Runtime {
                        runtime,
                        problem: problem.into(),
                    });
                }

                if let Some(column) = pooled.iter().position(|value| !value.is_finite()) {
                    return Err(Error::NotFinite {
                        layer: layer.name.clone(),
                        column,
                        value: pooled[column],
                    });
                }

                row.slice_mut(ndarray::s![from..from + dim])
                    .assign(&ndarray::aview1(&pooled));
            }

            from += dim;
        }

        Ok(rows)
    }

    /// The outputs of the network, one array per layer, with the clips along the first axis.
    fn outputs(&self, clips: &[Vec<&RgbImage>]) -> Result<Vec<ArrayD<f32>>, Error> {
        let width = clips[0][0].width;
        let height = clips[0][0].height;

        // The batch becomes one array, so all of its images must have one size.
        if clips
            .iter()
            .flatten()
            .any(|image| (image.width, image.height) != (width, height))
        {
            let problem =
                "images of several sizes in one batch; give a --resize that fixes the size"
                    .to_owned();
            return Err(Error::BadImage {
                image: "batch".to_owned(),
                problem: problem.into(),
            });
        }

        if let Some((wanted_width, wanted_height)) =
            self.size.filter(|&size| size != (width, height))
        {
            return Err(Error::BadImage {
                image: format!("image of {width}×{height} pixels"),
                problem: format!(
                    "the encoder takes {wanted_width}x{wanted_height}; \
                    give a --resize or --crop to that size"
                )
                .into(),
            });
        }

        let mut numbers = Vec::with_capacity(clips.len() * self.window * 3 * width * height);
        for clip in clips {
            for image in clip {
                normalized(&self.preparation, image, &mut numbers);
            }
        }

        // Axes: clip, image of the clip, channel, row, column. They are reordered below for models
        // with another order.
        let shape = IxDyn(&[clips.len(), self.window, 3, height, width]);
        let frames = ArrayD::from_shape_vec(shape, numbers).map_err(|error| Error::Runtime {
            runtime: self.runtime(),
            problem: error.into(),
        })?;

        let outputs = match &self.backbone {
            Backbone::Builtin => Vec::new(),
            // Clips of raw pixels have one image, whose axis is dropped to give maps
            // (clip, 3, H, W).
            Backbone::Pixels => vec![frames.index_axis_move(Axis(1), 0)],
            Backbone::Model {
                runner, clip_axis, ..
            } => runner.run(backbone::laid_out(frames, *clip_axis))?,
        };

        // The first axis must be the clips, because one row per clip is read along it.
        let names = self.layers.iter().map(|layer| &layer.name);
        let heads = self.keypoints.iter().flat_map(KeypointOutputs::names);
        for (name, output) in names.chain(heads).zip(&outputs) {
            if output.shape().first() != Some(&clips.len()) {
                let problem = format!(
                    "layer '{}' gave an output of shape {:?} for a batch of {}: its first axis is not the batch; \
                     choose another layer, or transpose it in the export",
                    name,
                    output.shape(),
                    clips.len()
                );

                return Err(Error::Runtime {
                    runtime: self.runtime(),
                    problem: problem.into(),
                });
            }
        }

        Ok(outputs)
    }
}

/// The name under which the features of a layer are stored. Characters that a name may not contain
/// become dashes.
fn feature_name(prefix: &str, layer: &Layer, backbone: &Backbone) -> String {
    let name = match backbone {
        Backbone::Builtin | Backbone::Pixels => prefix.to_owned(),
        Backbone::Model { .. } if layer.pooling == Pooling::Vector => {
            format!("{prefix}-{}", layer.name)
        }
        Backbone::Model { .. } => format!("{prefix}-{}-{}", layer.name, layer.pooling.short()),
    };

    // A name must begin with a letter or digit. With `a` in front, only the character itself is
    // tested.
    let plain: String = name
        .chars()
        .map(|c| {
            if is_plain_name(&format!("a{c}")) {
                c
            } else {
                '-'
            }
        })
        .collect();

    plain
        .trim_start_matches(|c: char| !c.is_ascii_alphanumeric())
        .to_owned()
}

/// The identity of an encoder that is given as `builtin`, `pixels` or the path of an ONNX file.
///
/// # Errors
/// [`Error::Io`] if the file cannot be read, [`Error::Model`] if it is not a usable ONNX model.
pub fn identity(model: &str) -> Result<String, Error> {
    match model {
        "builtin" => Ok(Encoder::builtin().id),
        PIXELS => Ok(Encoder::pixels().id),
        file => Ok(model_file::ModelFile::read(Path::new(file))?.id),
    }
}

/// The layers that a model declares as its outputs, in its order.
///
/// # Errors
/// [`Error::Io`] if the file cannot be read, [`Error::Model`] if it is not a usable ONNX model.
pub fn declared_outputs(file: &Path) -> Result<Vec<String>, Error> {
    Ok(model_file::ModelFile::read(file)?.outputs)
}

/// The size (width, height) of the images that a model takes, if its file fixes it.
///
/// # Errors
/// [`Error::Io`] if the file cannot be read, [`Error::Model`] if it is not a usable ONNX model.
pub fn declared_size(file: &Path) -> Result<Option<(usize, usize)>, Error> {
    Ok(model_file::ModelFile::read(file)?.image_size())
}

/// Reads `WIDTHxHEIGHT` or `none`.
///
/// # Errors
/// [`Error::Option`] if the text is of another form.
pub fn parse_crop(text: &str) -> Result<Option<(usize, usize)>, Error> {
    if text == "none" {
        Ok(None)
    } else {
        preparation::size("crop", text).map(Some)
    }
}

/// Reads `R,G,B`, or one number for all three.
///
/// # Errors
/// [`Error::Option`] if the text is of another form.
pub fn parse_channels(what: &'static str, text: &str) -> Result<[f32; 3], Error> {
    preparation::three(what, text)
}

/// Checks that a model's input is not larger than images may be.
fn check_input_size(file: &Path, width: usize, height: usize) -> Result<(), Error> {
    let most = Bounds::LOCAL.pixels;
    let pixels = width.checked_mul(height).map(|pixels| pixels as u64);
    if pixels.is_some_and(|pixels| pixels <= most) {
        return Ok(());
    }
    let problem = format!("takes images of {width}×{height} pixels; the limit is {most} in all");
    Err(Error::Model {
        file: file.to_owned(),
        problem: problem.into(),
    })
}

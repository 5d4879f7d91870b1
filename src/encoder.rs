//! The options that choose and configure an encoder, shared by the commands that run one.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::Args;

use super::made_by::remember_encoder_runtime;
use super::named::one_of;
use super::output::say;
use seese3_core::features::FeatureSource;
use seese3_encoder::{
    self, Device, Encoder, EncoderRecipe, Filter, KeypointOutputs, Layer, ModelTask, Pooling,
    Preparation, Preprocess, RECIPES, Resize, Runtime, RuntimeKind,
};

/// What runs ONNX models.
#[derive(Debug, Clone, Args)]
pub struct ModelRuntime {
    /// Runtime for ONNX models: tract needs no library, onnxruntime is faster
    #[arg(long, value_parser = one_of::<RuntimeKind>(), default_value = "tract", env = "SEESE3_RUNTIME")]
    runtime: RuntimeKind,
    /// Path of the onnxruntime shared library
    #[arg(long = "onnxruntime", value_name = "FILE", env = "ORT_DYLIB_PATH")]
    library: Option<PathBuf>,
    /// Processor for ONNX models: cpu, or with onnxruntime also cuda:N, the GPU of that number
    #[arg(long, value_name = "DEVICE", env = "SEESE3_DEVICE", default_value_t = Device::Cpu)]
    device: Device,
}

impl ModelRuntime {
    /// The options as the library's type.
    pub fn with_threads(&self, threads: usize) -> Runtime {
        Runtime {
            kind: self.runtime,
            threads,
            library: self.library.clone(),
            device: self.device,
        }
    }
}

/// What runs ONNX models, and on how many threads.
#[derive(Debug, Clone, Args)]
pub struct RuntimeOptions {
    #[command(flatten)]
    models: ModelRuntime,
    /// Number of threads, at most 1024; 0 takes all cores
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u16).range(..=1024))]
    threads: u16,
}

impl RuntimeOptions {
    /// The options as the library's type.
    pub fn runtime(&self) -> Runtime {
        self.models.with_threads(self.threads())
    }

    /// A pool of that many threads.
    pub fn pool(&self) -> Result<rayon::ThreadPool, rayon::ThreadPoolBuildError> {
        rayon::ThreadPoolBuilder::new()
            .num_threads(self.threads())
            .build()
    }

    /// The number of threads, with 0 resolved to the number of cores.
    pub fn threads(&self) -> usize {
        if self.threads > 0 {
            usize::from(self.threads)
        } else {
            std::thread::available_parallelism().map_or(1, usize::from)
        }
    }
}

/// How images are preprocessed, and which layers are kept and how they are pooled.
#[derive(Debug, Clone, PartialEq, Default, Args)]
pub struct EncoderOptions {
    /// Preprocessing and layer defaults of a known encoder, by a name from `seese3 encoders`; the
    /// options below override single values
    #[arg(long)]
    recipe: Option<String>,
    /// Preprocessing if there is no recipe: a JSON FILE from the model's authors
    /// (preprocessor_config.json of transformers, config.json of timm), or a family: `imagenet`
    /// (torchvision), `clip`, `half` (-1 to 1: SigLIP, Inception) or `unit` (0 to 1)
    #[arg(long, value_name = "FAMILY|FILE", value_parser = preprocessing, conflicts_with = "recipe")]
    preprocess: Option<Preprocessing>,
    /// Layers to keep, by output name, separated by commas; `all` keeps every output that the model
    /// declares, except those of keypoints
    #[arg(long, value_delimiter = ',', default_value = "all")]
    layers: Vec<String>,
    /// Pooling of a layer's output to one row: cls, mean, grid2x2, grid4x4 or any gridCOLUMNSxROWS,
    /// of clips also anchor (the mean over the anchor image); the recipe's if omitted, else mean
    #[arg(long)]
    pool: Option<String>,
    /// Number of tokens before the patch tokens (class token and registers), which pooling skips;
    /// the recipe's if omitted, else 0, which is an error if the token count contradicts it
    #[arg(long, value_name = "N")]
    prefix_tokens: Option<usize>,
    /// First layer number: 0, 1, or `name` for unnumbered layers; only recorded with the features;
    /// the recipe's if omitted, else name
    #[arg(long)]
    base: Option<String>,
    /// Whether the layers include the encoder's final norm: none or final; only recorded with the
    /// features; the recipe's if omitted, else unspecified
    #[arg(long)]
    norm: Option<String>,
    /// Images per clip, 1 to 256, centered on the encoded frame; the recipe's if omitted, else 1
    #[arg(long, value_name = "T", value_parser = clap::value_parser!(u32).range(1..=256))]
    window: Option<u32>,
    /// Resize: WIDTHxHEIGHT of the whole image, shortest:PIXELS for the shorter edge, or none; if
    /// omitted the recipe's, else the input size that the model declares, else none
    #[arg(long)]
    resize: Option<String>,
    /// Resize filter: bilinear, bicubic or lanczos3; the recipe's if omitted, else bilinear
    #[arg(long)]
    filter: Option<String>,
    /// Central crop after the resize, WIDTHxHEIGHT pixels, or none; the recipe's if omitted, else
    /// none
    #[arg(long)]
    crop: Option<String>,
    /// Normalization, first step: divisor of the pixel values 0 to 255; the recipe's if omitted,
    /// else 1
    #[arg(long)]
    divisor: Option<f32>,
    /// Normalization, second step: mean to subtract, R,G,B or one number; the recipe's if omitted,
    /// else 0
    #[arg(long, value_name = "R,G,B")]
    mean: Option<String>,
    /// Normalization, last step: standard deviation to divide by, R,G,B or one number; the recipe's
    /// if omitted, else 1
    #[arg(long, value_name = "R,G,B")]
    std: Option<String>,
}

/// Source of the preprocessing if there is no recipe.
#[derive(Debug, Clone, PartialEq)]
enum Preprocessing {
    Family(Preprocess),
    File(PathBuf),
}

fn preprocessing(text: &str) -> Result<Preprocessing, String> {
    let family: Option<Preprocess> = text.parse().ok();
    let file = || {
        let file = PathBuf::from(text);
        file.is_file().then_some(Preprocessing::File(file))
    };

    family
        .map(Preprocessing::Family)
        .or_else(file)
        .ok_or_else(|| "must be imagenet, clip, half, unit or a file".to_owned())
}

impl EncoderOptions {
    /// Opens the encoder: `builtin`, `pixels`, or the ONNX model in a file.
    pub fn open(&self, model: &str, runtime: &Runtime) -> anyhow::Result<Encoder> {
        // These two encoders are fixed. Options that they would ignore are rejected.
        match model {
            "builtin" | "pixels" if !self.is_plain() => {
                bail!(
                    "'{model}' is a fixed encoder; leave out --layers, --pool, --recipe, \
                    --resize and the other options for models"
                )
            }
            "builtin" => Ok(Encoder::builtin()),
            "pixels" => Ok(Encoder::pixels()),
            _ => {
                remember_encoder_runtime(runtime);
                self.open_file(Path::new(model), runtime)
            }
        }
    }

    fn open_file(&self, file: &Path, runtime: &Runtime) -> anyhow::Result<Encoder> {
        // An ONNX file needs a runtime that this program was built with.
        if !runtime.kind.is_built() {
            return Err(seese3_encoder::Error::NotBuilt {
                runtime: runtime.kind.name(),
            }
            .into());
        }

        if !file.is_file() {
            bail!(
                "{} is not a file; give an ONNX file, `pixels` or `builtin`",
                file.display()
            );
        }

        let recipe = self.recipe.as_deref().map(recipe_named).transpose()?;
        let preparation = self.preparation(recipe, file)?;

        // `all` selects the outputs that the file declares, in the file's order.
        let keypoints = recipe.and_then(|recipe| recipe.keypoints.clone());
        let is_head = |name: &String| {
            let heads = keypoints.as_ref().map(KeypointOutputs::names);
            heads.is_some_and(|heads| heads.contains(&name))
        };
        let names = if self.layers == ["all"] {
            let mut outputs = seese3_encoder::declared_outputs(file)?;
            outputs.retain(|name| !is_head(name));
            outputs
        } else {
            self.layers.clone()
        };

        // Options override the recipe, and the recipe overrides the defaults.
        let skip = self
            .prefix_tokens
            .unwrap_or(recipe.map_or(0, |recipe| recipe.prefix_tokens));

        let pooling: Pooling = self
            .pool
            .as_deref()
            .unwrap_or(recipe.map_or("mean", |recipe| recipe.pooling.as_str()))
            .parse()?;

        let word = |given: &Option<String>, recipe: Option<&str>, otherwise: &str| {
            given
                .clone()
                .unwrap_or_else(|| recipe.unwrap_or(otherwise).to_owned())
        };

        // `base` and `norm` are metadata; they do not change feature values.
        let layer = |name: &String| Layer {
            name: name.clone(),
            base: word(
                &self.base,
                recipe.map(|recipe| recipe.base.as_str()),
                "name",
            ),
            norm: word(
                &self.norm,
                recipe.map(|recipe| recipe.norm.as_str()),
                seese3_core::features::UNSPECIFIED,
            ),
            pooling: pooling.after(skip),
        };

        let window = self
            .window
            .map_or(recipe.map_or(1, |recipe| recipe.window), |window| {
                window as usize
            });

        let layers = names.iter().map(layer).collect();
        Ok(Encoder::model(
            ModelTask {
                file: file.to_owned(),
                preparation,
                layers,
                window,
                keypoints,
                is_prefix_stated: self.prefix_tokens.is_some() || recipe.is_some(),
            },
            runtime,
        )?)
    }

    /// Whether every option was left at its default.
    fn is_plain(&self) -> bool {
        *self
            == Self {
                layers: vec!["all".to_owned()],
                ..Self::default()
            }
    }

    fn preparation(
        &self,
        recipe: Option<&EncoderRecipe>,
        file: &Path,
    ) -> anyhow::Result<Preparation> {
        let says = self.divisor.is_some() || self.mean.is_some() || self.std.is_some();

        // There is no default normalization: a wrong one gives plausible but wrong features. A
        // recipe, a --preprocess value or explicit numbers are required.
        let chosen = match &self.preprocess {
            Some(Preprocessing::Family(family)) => {
                Some(family.preparation(seese3_encoder::declared_size(file)?)?)
            }
            Some(Preprocessing::File(config)) => {
                Some(seese3_encoder::read_preprocess_file(config)?)
            }
            None => None,
        };
        let known = recipe.map(|recipe| recipe.preparation.clone()).or(chosen);
        let mut preparation = match known {
            Some(preparation) => preparation,
            None if !says => bail!(
                "the preprocessing for {} is missing: give --recipe NAME (see `seese3 encoders`), --preprocess imagenet, \
                 clip, half, unit or its authors' JSON file, or --divisor, --mean and --std, with --resize and --crop if needed",
                file.display()
            ),
            None => {
                // Without a recipe, the whole image is resized to the input size that the model
                // declares, whatever its aspect ratio.
                let size = seese3_encoder::declared_size(file)?;
                let resize = size.map_or(Resize::None, |(width, height)| Resize::Whole {
                    width,
                    height,
                });

                Preparation {
                    resize,
                    ..Preparation::default()
                }
            }
        };

        // Each option replaces one value of the recipe and leaves the others.
        if let Some(resize) = &self.resize {
            preparation.resize = resize.parse()?;
        }
        if let Some(filter) = &self.filter {
            preparation.filter = filter.parse::<Filter>()?;
        }
        if let Some(crop) = &self.crop {
            preparation.crop = seese3_encoder::parse_crop(crop)?;
        }

        preparation.divisor = self.divisor.unwrap_or(preparation.divisor);
        if let Some(mean) = &self.mean {
            preparation.mean = seese3_encoder::parse_channels("--mean", mean)?;
        }
        if let Some(std) = &self.std {
            preparation.deviation = seese3_encoder::parse_channels("--std", std)?;
        }

        Ok(preparation)
    }
}

/// The recipe with this name; the error lists the known names.
pub fn recipe_named(name: &str) -> anyhow::Result<&'static EncoderRecipe> {
    seese3_encoder::recipe(name).with_context(|| {
        let known: Vec<&str> = RECIPES.iter().map(|recipe| recipe.name.as_str()).collect();
        format!(
            "unknown recipe '{name}'; known recipes: {}",
            known.join(", ")
        )
    })
}

/// Prefix of feature names: the given one, else the model's file name without extension.
pub fn feature_prefix(given: Option<&str>, model: &str) -> String {
    let stem = || Path::new(model).file_stem().unwrap_or_default();
    given.map_or_else(|| stem().to_string_lossy().into_owned(), str::to_owned)
}

/// Prints the names and widths of features.
pub fn say_features<'a>(sources: impl IntoIterator<Item = &'a FeatureSource>) {
    for source in sources {
        say(format_args!(
            "features '{}': {} columns",
            source.name, source.dim
        ));
    }
}

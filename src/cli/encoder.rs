//! Options that say which encoder is meant, shared by the commands that run one.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::{Args, ValueEnum};

use crate::encoder::{
    self, Encoder, Filter, Layer, ModelTask, Pooling, Preparation, Recipe, Resize, Runtime,
    RuntimeKind,
};

/// How models are run.
#[derive(Debug, Clone, Args)]
pub struct RuntimeOptions {
    /// What runs ONNX models: tract needs nothing, onnxruntime is faster
    #[arg(long, value_enum, default_value_t = RuntimeName::Tract, env = "SEESE3_RUNTIME")]
    runtime: RuntimeName,
    /// The shared library of onnxruntime
    #[arg(long = "onnxruntime", value_name = "FILE", env = "ORT_DYLIB_PATH")]
    library: Option<PathBuf>,
    /// Threads; all cores if 0
    #[arg(long, default_value_t = 0)]
    threads: usize,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum RuntimeName {
    /// Pure Rust
    Tract,
    /// The library, loaded when a model is opened
    Onnxruntime,
}

impl From<RuntimeName> for RuntimeKind {
    fn from(name: RuntimeName) -> Self {
        match name {
            RuntimeName::Tract => Self::Tract,
            RuntimeName::Onnxruntime => Self::OnnxRuntime,
        }
    }
}

impl RuntimeOptions {
    /// As the library wants it.
    pub fn runtime(&self) -> Runtime {
        Runtime {
            kind: self.runtime.into(),
            threads: self.threads(),
            library: self.library.clone(),
        }
    }

    /// How many threads are meant.
    pub fn threads(&self) -> usize {
        if self.threads > 0 {
            self.threads
        } else {
            std::thread::available_parallelism().map_or(1, usize::from)
        }
    }
}

/// How images are prepared, and which layers are kept.
#[derive(Debug, Clone, Args)]
pub struct EncoderOptions {
    /// How images are prepared for the model, by the name that `seese3 encoders` lists
    #[arg(long)]
    recipe: Option<String>,
    /// Layers to keep, separated by commas; all declared outputs if `all`
    #[arg(long, value_delimiter = ',', default_value = "all")]
    layers: Vec<String>,
    /// How a layer becomes one row: cls, mean, grid2x2, grid4x4 or any gridCOLUMNSxROWS; the
    /// recipe's, else mean
    #[arg(long)]
    pool: Option<String>,
    /// Tokens before the patches: the class token and registers; the recipe's, else 0
    #[arg(long, value_name = "N")]
    prefix_tokens: Option<usize>,
    /// What layer numbers count from: 0, 1, or name
    #[arg(long)]
    base: Option<String>,
    /// Whether the encoder's last norm is in the layers: none or final
    #[arg(long)]
    norm: Option<String>,
    /// Images a clip, around the frame that is meant
    #[arg(long, value_name = "T", value_parser = clap::value_parser!(u32).range(1..=256))]
    window: Option<u32>,
    /// WIDTHxHEIGHT of the whole image, shortest:PIXELS, or none
    #[arg(long)]
    resize: Option<String>,
    /// Of the resize: bilinear, bicubic or lanczos3
    #[arg(long)]
    filter: Option<String>,
    /// WIDTHxHEIGHT of a central crop, or none
    #[arg(long)]
    crop: Option<String>,
    /// Pixel values 0 to 255 are divided by this
    #[arg(long)]
    divisor: Option<f32>,
    /// Then this is subtracted, R,G,B
    #[arg(long, value_name = "R,G,B")]
    mean: Option<String>,
    /// Then divided by this, R,G,B
    #[arg(long, value_name = "R,G,B")]
    std: Option<String>,
}

impl EncoderOptions {
    /// Opens `builtin`, `pixels` or the model in a file.
    pub fn open(&self, model: &str, runtime: &Runtime) -> anyhow::Result<Encoder> {
        match model {
            "builtin" | "pixels" if !self.is_plain() => {
                bail!(
                    "'{model}' is one fixed encoder; leave out --layers, --pool, --recipe, --resize and their like"
                )
            }
            "builtin" => return Ok(Encoder::builtin()),
            "pixels" => return Ok(Encoder::pixels()),
            _ => {}
        }

        let file = Path::new(model);

        if !runtime.kind.is_built() {
            return Err(encoder::Error::NotBuilt {
                runtime: runtime.kind.name(),
            }
            .into());
        }

        if !file.is_file() {
            bail!("{model} is no file; give an ONNX file, `pixels` or `builtin`");
        }

        let recipe = self.recipe()?;
        let preparation = self.preparation(recipe, file)?;

        let names = if self.layers == ["all"] {
            encoder::declared_outputs(file)?
        } else {
            self.layers.clone()
        };

        let skip = self
            .prefix_tokens
            .unwrap_or(recipe.map_or(0, |recipe| recipe.prefix_tokens));

        let pooling: Pooling = self
            .pool
            .as_deref()
            .unwrap_or(recipe.map_or("mean", |recipe| recipe.pooling))
            .parse()?;

        let word = |given: &Option<String>, recipe: Option<&str>, otherwise: &str| {
            given
                .clone()
                .unwrap_or_else(|| recipe.unwrap_or(otherwise).to_owned())
        };

        let layer = |name: &String| Layer {
            name: name.clone(),
            base: word(&self.base, recipe.map(|recipe| recipe.base), "name"),
            norm: word(
                &self.norm,
                recipe.map(|recipe| recipe.norm),
                crate::features::UNSPECIFIED,
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
            },
            runtime,
        )?)
    }

    /// Whether nothing was asked for.
    fn is_plain(&self) -> bool {
        // Destructured with no `..`, so that a new option breaks the build here.
        let Self {
            recipe,
            layers,
            pool,
            prefix_tokens,
            base,
            norm,
            window,
            resize,
            filter,
            crop,
            divisor,
            mean,
            std,
        } = self;

        let words = [recipe, pool, base, norm, resize, filter, crop, mean, std];
        let numbers = [prefix_tokens.is_some(), window.is_some(), divisor.is_some()];

        layers == &["all"] && words.iter().all(|word| word.is_none()) && numbers == [false; 3]
    }

    fn recipe(&self) -> anyhow::Result<Option<&'static Recipe>> {
        let Some(name) = &self.recipe else {
            return Ok(None);
        };

        let known = || {
            encoder::RECIPES
                .iter()
                .map(|recipe| recipe.name)
                .collect::<Vec<_>>()
                .join(", ")
        };

        encoder::recipe(name)
            .map(Some)
            .with_context(|| format!("there is no recipe '{name}'; there are {}", known()))
    }

    fn preparation(&self, recipe: Option<&Recipe>, file: &Path) -> anyhow::Result<Preparation> {
        let says = self.divisor.is_some() || self.mean.is_some() || self.std.is_some();
        let mut preparation = match recipe {
            Some(recipe) => recipe.preparation.clone(),
            None if !says => bail!(
                "how are images prepared for {}? give --recipe NAME (see `seese3 encoders`), or --divisor, --mean and \
                 --std, with --resize and --crop where they are needed",
                file.display()
            ),
            None => {
                let size = encoder::declared_size(file)?;
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

        if let Some(resize) = &self.resize {
            preparation.resize = resize.parse()?;
        }
        if let Some(filter) = &self.filter {
            preparation.filter = filter.parse::<Filter>()?;
        }
        if let Some(crop) = &self.crop {
            preparation.crop = encoder::parse_crop(crop)?;
        }

        preparation.divisor = self.divisor.unwrap_or(preparation.divisor);
        if let Some(mean) = &self.mean {
            preparation.mean = encoder::parse_channels("--mean", mean)?;
        }
        if let Some(std) = &self.std {
            preparation.deviation = encoder::parse_channels("--std", std)?;
        }

        Ok(preparation)
    }
}

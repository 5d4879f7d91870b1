//! Encoder recipes: image preparation and layers of well-known encoders. The recipes themselves are
//! data, in `recipes.toml`.

use std::sync::LazyLock;

use serde::Deserialize;

use super::preparation::size;
use super::{Error, KeypointOutputs, Preparation};

/// Settings for a well-known encoder. The user provides the model.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EncoderRecipe {
    /// The value of `--recipe` that selects it.
    pub name: String,
    /// A one-line description of the model.
    pub about: String,
    /// The preparation of its images.
    pub preparation: Preparation,
    /// The number of images in a clip.
    pub window: usize,
    /// The layers that can be used, by their names in the export.
    pub layers: String,
    /// The number of the first layer, `0` or `1`, or `name` if layers have names.
    pub base: String,
    /// Whether the encoder's final normalization layer is included in the outputs: `final` or
    /// `none`.
    pub norm: String,
    /// The number of tokens before the patches.
    pub prefix_tokens: usize,
    /// The default pooling of a layer's output to one row; `--pool` overrides it.
    pub pooling: String,
    /// The outputs from which keypoints are detected, for a model with keypoint heads. They are not
    /// pooled to features.
    #[serde(default)]
    pub keypoints: Option<KeypointOutputs>,
    /// Its use in the paper.
    pub paper: String,
    /// The weights with which the export was run in this project.
    pub weights: RunWeights,
    /// What was checked, and the sources of the recipe's numbers.
    pub checked: String,
    /// Python code that exports it to an ONNX file.
    pub export: String,
}

/// The weights with which an export was run in this project.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum RunWeights {
    /// The published, trained weights.
    Trained,
    /// Random weights, of this model or of a smaller one with the same blocks.
    Random,
    /// It was not run.
    None,
}

impl RunWeights {
    /// In words, for tables.
    pub fn words(self) -> &'static str {
        match self {
            Self::Trained => "run with trained weights",
            Self::Random => "run with random weights, not with trained weights",
            Self::None => "not run",
        }
    }
}

/// All recipes.
pub static RECIPES: LazyLock<Vec<EncoderRecipe>> = LazyLock::new(|| {
    #[expect(
        clippy::expect_used,
        reason = "the text is compiled in, and a test reads it"
    )]
    parse(include_str!("recipes.toml")).expect("recipes.toml is well formed")
});

/// The recipe of that name.
pub fn recipe(name: &str) -> Option<&'static EncoderRecipe> {
    RECIPES.iter().find(|recipe| recipe.name == name)
}

fn parse(text: &str) -> Result<Vec<EncoderRecipe>, toml::de::Error> {
    #[derive(Deserialize)]
    struct File {
        recipe: Vec<EncoderRecipe>,
    }

    Ok(toml::from_str::<File>(text)?.recipe)
}

/// A preparation in the syntax of the command-line options.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct PreparationEntry {
    resize: String,
    filter: String,
    crop: Option<String>,
    divisor: f32,
    mean: [f32; 3],
    std: [f32; 3],
}

impl TryFrom<PreparationEntry> for Preparation {
    type Error = Error;

    fn try_from(entry: PreparationEntry) -> Result<Self, Error> {
        Ok(Self {
            resize: entry.resize.parse()?,
            filter: entry.filter.parse()?,
            crop: entry.crop.map(|crop| size("crop", &crop)).transpose()?,
            divisor: entry.divisor,
            mean: entry.mean,
            deviation: entry.std,
        })
    }
}

impl<'de> Deserialize<'de> for Preparation {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        PreparationEntry::deserialize(deserializer)?
            .try_into()
            .map_err(serde::de::Error::custom)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Pooling;

    /// Oracle: the requirements for opening a model. Every value of a recipe can be parsed, and the
    /// size of its images is fixed.
    #[test]
    fn every_recipe_can_be_followed() {
        for recipe in RECIPES.iter() {
            assert!(recipe.pooling.parse::<Pooling>().is_ok(), "{}", recipe.name);

            assert!(
                recipe.preparation.size().is_some() && recipe.preparation.check().is_ok(),
                "{}",
                recipe.name
            );

            assert!(
                matches!(recipe.base.as_str(), "0" | "1" | "name")
                    && matches!(recipe.norm.as_str(), "none" | "final")
            );

            let text = recipe.preparation.describe(recipe.window);
            assert_eq!(
                Preparation::parse(&text).unwrap(),
                (recipe.preparation.clone(), recipe.window)
            );
        }
    }
}

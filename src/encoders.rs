//! `seese3 encoders`: the known encoders and their preprocessing.

use clap::Args;
use serde_json::json;

use super::encoder::recipe_named;
use super::output::{JsonOutput, say};
use seese3_encoder::{EncoderRecipe, RECIPES, RuntimeKind};

/// Printed above the recipes.
const WITHOUT_RECIPE: &str = "\
Without a model:
  pixels    raw pixels at 320x240, averaged over 16x12 patches, 576 columns
  builtin   gradient orientations and color, weight-free stand-in, 528 columns

With a model: seese3 encode --encoder FILE.onnx --recipe NAME. Any ONNX image model with named outputs
works; without a recipe, give the preprocessing (--resize, --divisor, --mean, --std).
";

#[derive(Debug, Args)]
pub struct Encoders {
    /// Show only this recipe, with its script for the ONNX export
    name: Option<String>,
    #[command(flatten)]
    json: JsonOutput,
}

impl Encoders {
    pub fn run(self) -> anyhow::Result<()> {
        self.json.begin()?;

        // With a name, print that recipe with its export script; otherwise print all recipes
        // without scripts.
        let chosen: Vec<&EncoderRecipe> = match &self.name {
            Some(name) => vec![recipe_named(name)?],
            None => RECIPES.iter().collect(),
        };

        let records: Vec<_> = chosen.iter().map(|recipe| recipe_json(recipe)).collect();
        self.json.write(&json!({ "encoders": records }))?;

        if self.name.is_none() {
            say(WITHOUT_RECIPE);
        }

        for recipe in &chosen {
            say(format_args!("{}: {}", recipe.name, recipe.about));
            say(format_args!(
                "  images   {}",
                recipe.preparation.describe(recipe.window)
            ));
            say(format_args!(
                "  layers   {}; base {}, norm {}, {} prefix tokens, pool {}",
                recipe.layers, recipe.base, recipe.norm, recipe.prefix_tokens, recipe.pooling
            ));
            say(format_args!("  paper    {}", recipe.paper));
            say(format_args!("  checked  {}", recipe.checked));
            if self.name.is_some() {
                say("  export");
                for line in recipe.export.lines() {
                    say(format_args!("    {line}"));
                }
            }

            say("");
        }

        if self.name.is_none() {
            say("What was run:");
            for recipe in &chosen {
                say(format_args!(
                    "  {:<16} {}",
                    recipe.name,
                    recipe.weights.words()
                ));
            }
            say("");
        }

        // Both runtimes are cargo features, so a build may lack either.
        let built = |kind: RuntimeKind| {
            if kind.is_built() {
                "built in"
            } else {
                "not built: --features full"
            }
        };

        say(format_args!(
            "Runtimes: tract ({}), onnxruntime ({})",
            built(RuntimeKind::Tract),
            built(RuntimeKind::OnnxRuntime)
        ));

        Ok(())
    }
}

fn recipe_json(recipe: &EncoderRecipe) -> serde_json::Value {
    json!({
        "name": recipe.name,
        "about": recipe.about,
        "images": recipe.preparation.describe(recipe.window),
        "layers": recipe.layers,
        "pooling": recipe.pooling.to_string(),
        "prefix_tokens": recipe.prefix_tokens,
        "run": recipe.weights.words(),
    })
}

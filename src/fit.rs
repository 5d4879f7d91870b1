//! `seese3 fit`: fits an adapter to one room and publishes it.

use clap::Args;
use indicatif::ProgressBar;
use serde_json::json;

use seese3_core::cancel::Cancellation;
use seese3_core::training::RoomData;
use seese3_robot::fitting::{FITTING_EPOCHS, FitRun, Fitted};

use super::output::{say, say_published};
use super::progress::bar;
use super::store_option::StoreAndJson;
use seese3_store::fit_stored_room::{self, Refit};

#[derive(Debug, Args)]
pub struct Fit {
    #[command(flatten)]
    common: StoreAndJson,
    /// The room; all its frames form the map
    #[arg(long)]
    room: String,
    /// Pre-trained adapter of other rooms: it initializes the weights, and it also estimates
    /// motions where it was measured to be more accurate
    #[arg(long)]
    adapter: Option<String>,
    /// Name of the feature set; by default that of the adapter, or the room's only one
    #[arg(long)]
    features: Option<String>,
    /// Seed of the sampled pairs, the noise and, without --adapter, the initial weights, 0 to 2³² −
    /// 1
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u64).range(..=u64::from(u32::MAX)))]
    seed: u64,
    /// Name of the fitted adapter in the store; ROOM.FEATURES.fitted if omitted
    #[arg(long)]
    name: Option<String>,
}

impl Fit {
    pub async fn run(self) -> anyhow::Result<()> {
        let store = self.common.open_to_publish().await?;
        let request = fit_stored_room::Request {
            room: self.room,
            base: self.adapter,
            features: self.features,
            name: self.name,
            own_names_only: false,
            seed: self.seed,
        };
        let mut refit = Refit::prepare(&store, request).await?;

        let progress = fitting_bar(true);
        let fitted = refit.fit(FitRun {
            progress: &|_| progress.inc(1),
            cancel: &Cancellation::new(),
        })?;
        progress.finish_and_clear();

        let published = refit.publish(&store, &fitted).await?;
        say_fitted(&fitted, &refit.data());
        let what = format!("adapter '{}'", refit.name());
        say_published(&store, &what, &published);

        self.common.json.write(&json!({
            "adapter": refit.name(),
            "revision": published.revision,
            "created": published.is_new,
            "room": refit.data().room.id().as_str(),
            "train_r2": fitted.record.train.overall,
            "expected_errors": fitted.rules.expected_errors(),
        }))
    }
}

/// Prints a summary of the fit and the expected errors.
fn say_fitted(fitted: &Fitted, data: &RoomData<'_>) {
    let mapped = data.room.frame_count();
    say(format_args!(
        "room '{}' revision {}, features '{}': fitted to {mapped} frames, train R² {:.3}",
        data.room.id(),
        data.revision,
        data.features.source().name,
        fitted.record.train.overall
    ));

    say(
        "expected error of a view, by the distance of its feature from the nearest mapped feature (in standard \
         deviations of a feature column):",
    );
    for expected in fitted.rules.expected_errors() {
        say(format_args!(
            "  up to {:.3}: {:.3} m, {:.1}°",
            expected.feature_distance,
            expected.translation_m,
            expected.rotation_rad.to_degrees()
        ));
    }
}

/// A progress bar over the epochs of a fit and its folds; empty without a fit.
pub fn fitting_bar(is_fitted: bool) -> ProgressBar {
    bar(if is_fitted { FITTING_EPOCHS } else { 0 }, "fitting")
}

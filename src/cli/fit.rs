//! `seese3 fit`: fits an adapter to one room and publishes it.

use std::sync::Arc;

use anyhow::bail;
use clap::Args;
use indicatif::ProgressBar;

use seese3_core::adapter::Adapter;
use seese3_core::fitting::{FITTING_EPOCHS, Fitted, PartRule, fit};
use seese3_core::room::{FrameId, RoomId, is_plain_name};
use seese3_core::training::RoomData;

use super::progress::bar;
use super::{say, say_published};
use crate::store::{BaseAdapter, RoomFit, Store, StoredAdapter};

#[derive(Debug, Args)]
pub struct Fit {
    /// The store: a folder, or a bucket by its URL
    #[arg(long, env = "SEESE3_STORE")]
    store: String,
    /// The room, all of whose frames are its map
    #[arg(long)]
    room: String,
    /// An adapter that learned from other rooms: its weights are where the fitted one begins, and
    /// it stays a reader of motions beside it where it was measured to be better
    #[arg(long)]
    adapter: Option<String>,
    /// Name of the feature set; by default that of the adapter, or the room's only one
    #[arg(long)]
    features: Option<String>,
    /// Seed of the drawn pairs, of the noise and, without --adapter, of the initial weights
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u64).range(..=u64::from(u32::MAX)))]
    seed: u64,
    /// Name of the fitted adapter in the store; ROOM.FEATURES.fitted if omitted
    #[arg(long)]
    name: Option<String>,
}

impl Fit {
    pub async fn run(self) -> anyhow::Result<()> {
        let store = Store::open(&self.store)?;
        let base = match &self.adapter {
            Some(name) => Some(store.load_adapter(name, None).await?),
            None => None,
        };

        if let Some(base) = &base {
            check_base(base, &self.room)?;
        }

        let of_base = base
            .as_ref()
            .map(|stored| stored.adapter.source().name.clone());
        let wanted = self.features.clone().or(of_base);
        let (stored, features) = store.load_room_with(&self.room, wanted.as_deref()).await?;
        let name = self
            .name
            .clone()
            .unwrap_or_else(|| format!("{}.{}.fitted", self.room, features.source().name));
        check_name(&store, &name, stored.room.id()).await?;

        let data = RoomData {
            room: &stored.room,
            revision: stored.revision,
            features: &features,
        };

        let mapped: Vec<FrameId> = (0..stored.room.frame_count() as u32).map(FrameId).collect();
        let progress = fitting_bar(true);
        let network: Option<&Arc<Adapter>> = base.as_ref().map(|stored| &stored.adapter);
        let mut fitted = fit(&data, &mapped, network, self.seed, &|_| progress.inc(1))?;
        progress.finish_and_clear();

        // What the base has seen, the fitted adapter has seen too.
        if let Some(base) = &base {
            fitted
                .record
                .rooms
                .extend(base.record.rooms.iter().cloned());
            fitted
                .record
                .calibrated_on
                .extend(base.record.calibrated_on.iter().cloned());
        }

        let room_fit = RoomFit {
            room: stored.room.id().clone(),
            room_revision: stored.revision,
            base: base.map(|stored| BaseAdapter {
                name: stored.name,
                revision: stored.revision,
            }),
            rules: fitted.rules.clone(),
        };

        let published = store
            .publish_fitted(&name, &fitted, &room_fit, features.rows())
            .await?;

        say_fitted(&fitted, &data, mapped.len());
        say_published(&store, &name, &published);

        Ok(())
    }
}

/// Refuses a base that has seen the room: measured there, it would look better than it is.
fn check_base(base: &StoredAdapter, room: &str) -> anyhow::Result<()> {
    let has_seen = base
        .record
        .rooms
        .iter()
        .any(|(name, _)| name.as_str() == room);
    if has_seen || base.room_fit.is_some() {
        bail!(
            "adapter '{}' has seen room '{room}' or was itself fitted to a room; begin from one that learned from other \
             rooms alone, or leave out --adapter",
            base.name
        );
    }

    Ok(())
}

/// Prints what was fitted, and the rules that were measured.
fn say_fitted(fitted: &Fitted, data: &RoomData<'_>, mapped: usize) {
    say(format_args!(
        "room '{}' revision {}, features '{}': fitted to {mapped} frames, train R² {:.3}",
        data.room.id(),
        data.revision,
        data.features.source().name,
        fitted.record.train.overall
    ));

    say("measured on frames left out, by the distance of a view from the map:");
    for rule in fitted.rules.rules() {
        say(format_args!(
            "  up to {:.3}: translation {}, rotation {}",
            rule.up_to,
            part_words(rule.translation),
            part_words(rule.rotation)
        ));
    }
}

/// Refuses, before anything is fitted, a name that cannot be published or that other adapters have.
async fn check_name(store: &Store, name: &str, room: &RoomId) -> anyhow::Result<()> {
    if !is_plain_name(name) {
        bail!("--name '{name}' is not valid: letters, digits, '.', '_' and '-', at most 100");
    }

    if store
        .adapter_names()
        .await?
        .iter()
        .any(|known| known == name)
    {
        let newest = store.load_adapter(name, None).await?;
        let is_of_this_room = newest.room_fit.is_some_and(|fit| fit.room == *room);
        if !is_of_this_room {
            bail!("--name '{name}' is taken by an adapter that was not fitted to room '{room}'");
        }
    }

    Ok(())
}

/// A bar over the epochs of a fit and of its folds; without a fit it stays empty.
pub fn fitting_bar(is_fitted: bool) -> ProgressBar {
    bar(if is_fitted { FITTING_EPOCHS } else { 0 }, "fitting")
}

fn part_words(rule: PartRule) -> String {
    if rule.gain == 0.0 {
        return rule.reader.name().to_owned();
    }
    format!("{} × {:.1}", rule.reader.name(), rule.gain)
}

//! `seese3 evaluate odometry`: replays held-out frames of rooms through a tracker, and reports path
//! errors, covariance coverage and tracking status.

use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use anyhow::Context;
use clap::Args;

use seese3_core::splits::HoldOut;
use seese3_core::training::RoomData;
use seese3_lab::experiments::odometry::{
    OdometryProtocol, RoomOdometry, evaluate, relocalisation, trackers,
};
use seese3_lab::report::{
    APE_FORMULA, coverage_table, odometry_json, odometry_table, other_rooms_text,
    relocalisation_text,
};
use seese3_robot::tracking::{Replay, TrackerSettings};

use super::super::named::one_of;
use super::super::output::{JsonOutput, say, write_file};
use super::super::progress::bar;
use super::super::rooms::{data, load_rooms};
use super::say_leaks;
use seese3_data::export::{kitti_trajectory, tum_trajectory};
use seese3_store::Store;

#[derive(Debug, Args)]
pub struct Odometry {
    /// The store
    #[arg(long, env = "SEESE3_STORE")]
    store: String,
    /// The rooms: names, or patterns with *
    #[arg(long = "room", required = true)]
    rooms: Vec<String>,
    /// The adapter; it must be calibrated (`train --calibrate-on`), but in none of these rooms
    #[arg(long)]
    adapter: String,
    /// Which frames are mapped and which are replayed
    #[arg(long, value_parser = one_of::<HoldOut>(), default_value = "blocks")]
    hold_out: HoldOut,
    /// Keyframe interval, frames; derived from the adapter's training if omitted
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    keyframe_frames: Option<u32>,
    /// Dead reckoning only: no corrections from the map
    #[arg(long)]
    no_fusion: bool,
    /// Fit an adapter to each room's mapped frames, initialized from --adapter, and correct the
    /// pose by its estimates
    #[arg(long)]
    fit: bool,
    /// Write each room's paths to this folder, as TUM and KITTI files: ROOM.truth, ROOM.fused and
    /// ROOM.odom
    #[arg(long)]
    paths: Option<PathBuf>,
    /// Print a line for every room, not only the mean
    #[arg(long)]
    each: bool,
    #[command(flatten)]
    json: JsonOutput,
}

impl Odometry {
    #[expect(
        clippy::too_many_lines,
        reason = "one command, from its arguments to what it prints"
    )]
    pub async fn run(self) -> anyhow::Result<()> {
        self.json.begin()?;

        let store = Store::open(&self.store)?;
        let stored = store.load_adapter(&self.adapter, None).await?;
        let source = stored.adapter.source().name.clone();
        let rooms = load_rooms(&store, &self.rooms, Some(&source)).await?;
        say_leaks(&rooms, &stored.record);

        let adapter = stored.adapter;
        let hold_out = self.hold_out;
        let settings = self.settings(TrackerSettings::of(&adapter));
        let room_data: Vec<RoomData<'_>> = rooms.iter().map(data).collect();
        let protocol = OdometryProtocol {
            hold_out,
            settings,
            is_fitted: self.fit,
        };
        let trackers = trackers(&room_data, &adapter, &protocol)?;

        // Paths are written as each room completes; the first failure is reported at the end.
        let progress = bar(trackers.len() as u64, "tracking");
        let unwritten: Mutex<Option<anyhow::Error>> = Mutex::new(None);
        let tracked = evaluate(&trackers, hold_out, &|room, replay| {
            if let Err(error) = self.write_paths(room, replay) {
                let mut first = unwritten.lock().unwrap_or_else(PoisonError::into_inner);
                first.get_or_insert(error);
            }
            progress.inc(1);
        })?;

        progress.finish_and_clear();
        if let Some(error) = unwritten
            .into_inner()
            .unwrap_or_else(PoisonError::into_inner)
        {
            return Err(error);
        }

        // Relocalization needs at least two rooms to choose from.
        let relocalised = (trackers.len() > 1)
            .then(|| relocalisation(&trackers, hold_out))
            .transpose()?;

        say(format_args!(
            "{} {}, adapter '{}' revision {}, hold-out {}, {}",
            trackers.len(),
            if trackers.len() == 1 { "room" } else { "rooms" },
            stored.name,
            stored.revision,
            hold_out.name(),
            if self.no_fusion {
                "dead reckoning"
            } else if self.fit {
                "fused with estimates of an adapter fitted to the mapped frames"
            } else {
                "fused with the most similar mapped frames"
            },
        ));

        let table = odometry_table(&tracked).to_string();
        let shown = if self.each || tracked.len() == 1 {
            table
        } else {
            only_mean(&table)
        };
        say(shown);
        say(format_args!("\ncovariances:\n{}", coverage_table(&tracked)));

        if trackers.len() > 1 {
            say(other_rooms_text(&tracked));
        }
        if let Some(found) = &relocalised {
            say(relocalisation_text(found));
        }

        say(format_args!(
            "{APE_FORMULA}; root mean square without alignment"
        ));

        self.json
            .write(&odometry_json(&tracked, relocalised.as_ref()))?;

        Ok(())
    }

    /// The adapter's settings, overridden by the given options.
    fn settings(&self, own: TrackerSettings) -> TrackerSettings {
        TrackerSettings {
            keyframe_frames: self.keyframe_frames.unwrap_or(own.keyframe_frames),
            fuse: !self.no_fusion,
            ..own
        }
    }

    fn write_paths(&self, room: &RoomOdometry, replay: &Replay) -> anyhow::Result<()> {
        match &self.paths {
            Some(folder) => write_paths(folder, &room.room, replay),
            None => Ok(()),
        }
    }
}

fn write_paths(folder: &Path, room: &str, replay: &Replay) -> anyhow::Result<()> {
    std::fs::create_dir_all(folder)
        .with_context(|| format!("{} cannot be created", folder.display()))?;

    for (name, path) in [
        ("truth", &replay.truth),
        ("fused", &replay.map_path().path),
        ("odom", &replay.odom_path()),
    ] {
        let tum = tum_trajectory(&path.times_ns, &path.poses);
        let kitti = kitti_trajectory(&path.poses);
        write_file(&folder.join(format!("{room}.{name}.tum")), tum.as_bytes())?;
        write_file(
            &folder.join(format!("{room}.{name}.kitti")),
            kitti.as_bytes(),
        )?;
    }

    Ok(())
}

/// The header of a table and its last line, the means.
fn only_mean(table: &str) -> String {
    let lines: Vec<&str> = table.lines().collect();
    match lines.as_slice() {
        [head, .., last] => format!("{head}\n{last}"),
        _ => table.to_owned(),
    }
}

//! `seese3 evaluate odometry`: replays held-out frames of rooms through a tracker, and reports path
//! errors, covariance coverage and tracking status.

use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use anyhow::Context;
use clap::Args;
use seese3_core::splits::HoldOut;
use seese3_lab::experiments::odometry::{Relocalization, RoomOdometry, evaluate, relocalization};
use seese3_lab::experiments::replay::Replay;
use seese3_lab::experiments::tracked_room::TrackingProtocol;
use seese3_lab::report::{
    APE_FORMULA, Table, coverage_table, intervals_table, odometry_json, odometry_table,
    other_rooms_text, relocalization_text, scenarios_text,
};
use seese3_robot::pose_filter::FilterParameters;

use super::super::named::one_of;
use super::super::output::{JsonOutput, say, write_file};
use super::super::progress::bar;
use super::keypoint_views::KeypointViews;
use super::recordings::Recordings;
use crate::table_files::TableFiles;
use seese3_data::export::{kitti_trajectory, tum_trajectory};
use seese3_store::Store;

#[derive(Debug, Args)]
pub struct Odometry {
    /// The store
    #[arg(long, env = "SEESE3_STORE", default_value = crate::store_option::DEFAULT_STORE)]
    store: String,
    /// The rooms: names, or patterns with *
    #[arg(long = "room", required = true)]
    rooms: Vec<String>,
    /// The adapter; it must be calibrated (`train --calibrate-on`), but in none of these rooms.
    /// Without one, matched keypoints alone track the camera, in rooms with keypoints
    #[arg(long)]
    adapter: Option<String>,
    /// Which frames are mapped and which are replayed
    #[arg(long, value_parser = one_of::<HoldOut>(), default_value = "blocks")]
    hold_out: HoldOut,
    /// Interval of the keyframes of reported motions, frames; 30 if omitted; 1 to 10000
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    keyframe_frames: Option<u32>,
    /// Dead reckoning only: no corrections from the map
    #[arg(long)]
    no_fusion: bool,
    /// Fit an adapter to each room's mapped frames, initialized from --adapter, and correct the
    /// pose by its estimates
    #[arg(long, requires = "adapter")]
    fit: bool,
    /// Write each room's paths to this folder, as TUM and KITTI files: ROOM.truth, ROOM.fused and
    /// ROOM.odom
    #[arg(long)]
    paths: Option<PathBuf>,
    /// Parameters of the filter: a file of `fit-tracking --json`. By default those that were
    /// published with a room, if any
    #[arg(long, value_name = "FILE")]
    parameters: Option<PathBuf>,
    /// Print a line for every room, not only the mean
    #[arg(long)]
    each: bool,
    #[command(flatten)]
    views: KeypointViews,
    #[command(flatten)]
    files: TableFiles,
    #[command(flatten)]
    json: JsonOutput,
}

impl Odometry {
    pub async fn run(self) -> anyhow::Result<()> {
        self.json.begin()?;
        self.files.begin()?;
        let store = Store::open(&self.store)?;
        let given = self
            .parameters
            .as_deref()
            .map(read_parameters)
            .transpose()?;
        let adapter = self.adapter.as_deref();
        let recordings = Recordings::load(&store, &self.rooms, adapter, &self.views).await?;

        let pool = self.views.runtime.pool()?;
        let (tracked, relocalized) = pool.install(|| -> anyhow::Result<_> {
            let rooms = recordings.tracked(&|of_room| self.protocol(given.or(of_room)))?;
            let tracked = self.tracked(rooms.len(), |done| evaluate(&rooms, done))?;
            // Relocalization of features needs at least two rooms to choose from.
            let relocalized = (adapter.is_some() && rooms.len() > 1)
                .then(|| relocalization(&rooms))
                .transpose()?;
            Ok((tracked, relocalized))
        })?;

        let how = if self.no_fusion {
            "dead reckoning"
        } else if self.fit {
            "fused with estimates of an adapter fitted to the mapped frames"
        } else if adapter.is_some() {
            "fused with the most similar mapped frames"
        } else {
            "fused with located views"
        };
        self.report(&tracked, &recordings.words(), how, relocalized.as_ref())
    }

    /// Evaluates with a progress bar. Paths are written as each room completes; the first failure
    /// is reported at the end.
    fn tracked(
        &self,
        count: usize,
        evaluate: impl FnOnce(
            &(dyn Fn(&RoomOdometry, &Replay) + Sync),
        ) -> Result<Vec<RoomOdometry>, seese3_lab::experiments::Error>,
    ) -> anyhow::Result<Vec<RoomOdometry>> {
        let progress = bar(count as u64, "tracking");
        let unwritten: Mutex<Option<anyhow::Error>> = Mutex::new(None);
        let tracked = evaluate(&|room, replay| {
            if let Err(error) = self.write_paths(room, replay) {
                let mut first = unwritten.lock().unwrap_or_else(PoisonError::into_inner);
                first.get_or_insert(error);
            }
            progress.inc(1);
        })?;

        progress.finish_and_clear();
        let unwritten = unwritten.into_inner();
        match unwritten.unwrap_or_else(PoisonError::into_inner) {
            Some(error) => Err(error),
            None => Ok(tracked),
        }
    }

    fn report(
        &self,
        tracked: &[RoomOdometry],
        what: &str,
        how: &str,
        relocalized: Option<&Relocalization>,
    ) -> anyhow::Result<()> {
        say(format_args!(
            "{} {}, {what}, hold-out {}, {how}",
            tracked.len(),
            if tracked.len() == 1 { "room" } else { "rooms" },
            self.hold_out.name(),
        ));

        let mut table = odometry_table(tracked);
        if !self.each && tracked.len() > 1 {
            table = only_mean(&table);
        }
        self.files.say(&table, what)?;
        say(format_args!("\ncovariances:\n{}", coverage_table(tracked)));
        say(format_args!(
            "\nbootstrap over rooms, and over 20 blocks of time in each:\n{}",
            intervals_table(tracked)
        ));

        if let Some(text) = scenarios_text(tracked) {
            say(format_args!("\n{text}\n"));
        }
        if tracked.len() > 1 {
            say(other_rooms_text(tracked));
        }
        if let Some(found) = relocalized {
            say(relocalization_text(found));
        }

        say(format_args!(
            "{APE_FORMULA}; root mean square without alignment"
        ));
        self.json.write(&odometry_json(tracked, relocalized))
    }

    fn protocol(&self, parameters: Option<FilterParameters>) -> TrackingProtocol {
        let default = parameters.unwrap_or_default();
        TrackingProtocol {
            hold_out: self.hold_out,
            parameters: FilterParameters {
                keyframe_frames: self.keyframe_frames.unwrap_or(default.keyframe_frames),
                fuse: !self.no_fusion,
                ..default
            },
            is_fitted: self.fit,
        }
    }

    fn write_paths(&self, room: &RoomOdometry, replay: &Replay) -> anyhow::Result<()> {
        match &self.paths {
            Some(folder) => write_paths(folder, &room.room, replay),
            None => Ok(()),
        }
    }
}

/// The parameters in a file of `fit-tracking --json`.
fn read_parameters(file: &Path) -> anyhow::Result<FilterParameters> {
    #[derive(serde::Deserialize)]
    struct Fitted {
        parameters: FilterParameters,
    }
    let shown = file.display();
    let bytes = seese3_files::read(file, seese3_files::SMALL_FILE_BYTES);
    let bytes = bytes.with_context(|| format!("{shown} cannot be read"))?;
    let fitted: Fitted = serde_json::from_slice(&bytes)
        .with_context(|| format!("{shown} is no file of `seese3 fit-tracking --json`"))?;
    let checked = fitted.parameters.check();
    checked.with_context(|| format!("{shown}: parameters"))?;
    Ok(fitted.parameters)
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

/// The last row of a table, the means.
fn only_mean(table: &Table) -> Table {
    let mut means = Table::new(&table.titles().join(" | "));
    if let Some((name, cells)) = table.rows().last().and_then(|row| row.split_first()) {
        means.row(name, cells.iter().cloned());
    }
    means
}

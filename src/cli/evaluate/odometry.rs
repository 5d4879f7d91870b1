//! `seese3 evaluate odometry`: follow held-out frames of rooms, and say how far off, how sure and
//! how lost.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::Context;
use clap::{Args, ValueEnum};
use rayon::prelude::*;

use super::super::progress::bar;
use super::super::rooms::load_rooms;
use super::super::{check_writable, say, write_file, write_json};
use crate::adapter::Adapter;
use crate::cancel::Cancellation;
use crate::eval::tracking::{Begin, Course, Followed, Stretch, follow};
use crate::features::Features;
use crate::navigation::{IndexKind, Navigator};
use crate::odometry::{Map, Settings, Status, Tracker, relocalize};
use crate::report::{
    APE_FORMULA, Foreign, Relocalisation, TrackedRoom, coverage_table, foreign_text,
    kitti_trajectory, odometry_json, odometry_table, tum_trajectory,
};
use crate::store::{Store, StoredRoom};
use crate::trajectory::{Relation, RpePairs, Statistics, Trajectory, ape, rpe};

/// Between two frames of a recording without times: a camera at 30 Hz.
const PERIOD_NS: i64 = 33_333_333;
/// Of another room's frames, so many are followed as if they were of this one.
const FOREIGN_FRAMES: usize = 60;

#[derive(Debug, Args)]
pub struct Odometry {
    /// The store
    #[arg(long, env = "SEESE3_STORE")]
    store: String,
    /// The rooms: names, or patterns with *
    #[arg(long = "room", required = true)]
    rooms: Vec<String>,
    /// The adapter; its errors were measured (`train --calibrate-on`) in none of these rooms
    #[arg(long)]
    adapter: String,
    /// Which frames are mapped and which are followed
    #[arg(long, value_enum, default_value_t = CourseName::Blocks)]
    course: CourseName,
    /// Frames after which a keyframe is taken; the program's choice if nothing is given
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    keyframe_frames: Option<u32>,
    /// Dead reckoning alone
    #[arg(long)]
    no_fusion: bool,
    /// Write each room's paths here, as TUM and KITTI files: ROOM.truth, ROOM.fused and ROOM.odom
    #[arg(long)]
    paths: Option<PathBuf>,
    /// Show every room
    #[arg(long)]
    each: bool,
    /// Write all of it here as JSON
    #[arg(long)]
    json: Option<PathBuf>,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum CourseName {
    /// Every second frame is mapped, the others are followed
    Interleaved,
    /// As interleaved, and a fifth of the way is not mapped
    Blocks,
    /// The first four fifths are mapped, the last is followed
    Time,
}

impl From<CourseName> for Course {
    fn from(name: CourseName) -> Self {
        match name {
            CourseName::Interleaved => Self::Interleaved,
            CourseName::Blocks => Self::Blocks,
            CourseName::Time => Self::Time,
        }
    }
}

/// A room that is ready to be followed in.
struct Ready {
    stored: StoredRoom,
    map: Arc<Map>,
    tracker: Tracker,
}

impl Odometry {
    pub async fn run(self) -> anyhow::Result<()> {
        if let Some(path) = &self.json {
            check_writable(path)?;
        }

        let store = Store::open(&self.store)?;
        let stored = store.load_adapter(&self.adapter, None).await?;
        let source = stored.adapter.source().name.clone();
        let rooms = load_rooms(&store, &self.rooms, Some(&source)).await?;

        for (room, _) in &rooms {
            let seen = stored
                .record
                .rooms
                .iter()
                .chain(&stored.record.calibrated_on);

            if seen.clone().any(|(name, _)| name == room.room.id()) {
                say(format_args!(
                    "LEAK: the adapter has seen room '{}'",
                    room.room.id()
                ));
            }
        }

        let adapter = Arc::new(stored.adapter);
        let ready = self.ready(rooms, &adapter)?;
        let progress = bar(ready.len() as u64, "following");

        let tracked: Vec<TrackedRoom> = ready
            .par_iter()
            .map(|room| {
                let tracked = self.tracked(room, &ready);
                progress.inc(1);
                tracked
            })
            .collect::<anyhow::Result<_>>()?;

        progress.finish_and_clear();
        let relocalisation = (ready.len() > 1)
            .then(|| relocalised(self.course.into(), &ready))
            .transpose()?;

        say(format_args!(
            "{} {}, adapter '{}' revision {}, course {}, {}",
            ready.len(),
            if ready.len() == 1 { "room" } else { "rooms" },
            stored.name,
            stored.revision,
            Course::from(self.course).name(),
            if self.no_fusion {
                "dead reckoning"
            } else {
                "fused with places that look alike"
            },
        ));

        let table = odometry_table(&tracked);
        let shown = if self.each || tracked.len() == 1 {
            table
        } else {
            only_mean(&table)
        };
        say(shown.trim_end());

        say(format_args!(
            "\ncovariances:\n{}",
            coverage_table(&tracked).trim_end()
        ));

        if ready.len() > 1 {
            say(foreign_text(&tracked).trim_end());
        }
        if let Some(found) = &relocalisation {
            say(found.text());
        }

        say(format_args!(
            "{APE_FORMULA}; root mean square without alignment"
        ));

        if let Some(path) = &self.json {
            write_json(path, &odometry_json(&tracked, relocalisation.as_ref()))?;
            say(format_args!("wrote {}", path.display()));
        }

        Ok(())
    }

    fn ready(
        &self,
        rooms: Vec<(StoredRoom, Features)>,
        adapter: &Arc<Adapter>,
    ) -> anyhow::Result<Vec<Ready>> {
        let plain = Settings::of(adapter);
        let keyframe_frames = self.keyframe_frames.unwrap_or(plain.keyframe_frames);
        let settings = Settings {
            keyframe_frames,
            fuse: !self.no_fusion,
            ..plain
        };

        let ready = |(stored, features): (StoredRoom, Features)| {
            let what = format!("room '{}'", stored.room.id());
            let room = Arc::new(stored.room.clone());
            let mapped = Course::from(self.course).mapped(room.frame_count());

            let navigator = Arc::new(Navigator::new(
                room,
                &features,
                adapter.clone(),
                IndexKind::Exact,
            )?);
            let map = Arc::new(Map::new(navigator, &mapped).with_context(|| what.clone())?);

            let tracker = Tracker::new(vec![map.clone()], settings).with_context(|| what)?;
            Ok(Ready {
                stored,
                map,
                tracker,
            })
        };

        rooms.into_iter().map(ready).collect()
    }

    fn tracked(&self, room: &Ready, all: &[Ready]) -> anyhow::Result<TrackedRoom> {
        let stored = &room.stored.room;
        let course = Course::from(self.course);
        let followed = followed(room, course, Begin::Known);
        let (fused, places) = followed.map_path();

        if let Some(folder) = &self.paths {
            write_paths(folder, stored.id().as_str(), &followed, &fused)?;
        }

        let errors = |estimate: &Trajectory, reference: &Trajectory| -> anyhow::Result<[f64; 3]> {
            let of = |relation| -> anyhow::Result<f64> {
                Ok(Statistics::of(&ape(reference, estimate, relation)?).rmse)
            };

            let relative = rpe(
                reference,
                estimate,
                Relation::Translation,
                1,
                RpePairs::Consecutive,
            )?;

            Ok([
                of(Relation::Translation)?,
                of(Relation::Rotation)?,
                Statistics::of(&relative).rmse,
            ])
        };

        let odom = errors(&followed.odom_path(), &followed.truth)
            .with_context(|| format!("room '{}'", stored.id()))?;

        let fused = match places.len() {
            0 | 1 => [f64::NAN; 3],
            _ => errors(&fused, &followed.truth.select(&places))?,
        };

        let unknown = self::followed(room, course, Begin::Unknown);
        let frames = course.followed(stored.frame_count());
        let is_mapped = |at: usize| course.is_mapped_beside(frames[at], stored.frame_count());

        Ok(TrackedRoom {
            room: stored.id().to_string(),
            format: stored.provenance().format.clone(),
            frames: [
                course.mapped(stored.frame_count()).len(),
                followed.updates.len(),
            ],
            ape_m: [odom[0], fused[0]],
            ape_rad: [odom[1], fused[1]],
            rpe_m: [odom[2], fused[2]],
            places: [true, false].map(|wanted| followed.place_surprises_where(is_mapped, wanted)),
            motions: followed.motion_surprises(),
            statuses: [
                Status::Tracking,
                Status::Degraded,
                Status::Lost,
                Status::Relocalizing,
            ]
            .map(|status| followed.share(status)),
            unknown: (unknown.share(Status::Lost), unknown.frames_to_relocalise()),
            foreign: foreign(room, all, course),
        })
    }
}

fn followed(room: &Ready, course: Course, begin: Begin) -> Followed {
    let stored = &room.stored.room;
    let frames = course.followed(stored.frame_count());
    let stretch = Stretch {
        latents: room.map.navigator().latents(),
        poses: stored.poses(),
        frames: &frames,
    };

    follow(&room.tracker, &[stretch], PERIOD_NS, begin)
}

/// Frames of other rooms followed in this one, from the beginning and after the room's own last
/// frame: how many, and how many are answered LOST.
fn foreign(room: &Ready, all: &[Ready], course: Course) -> [Foreign; 2] {
    let own = &room.stored.room;
    let mut own_frames = course.followed(own.frame_count());
    let before = own_frames.split_off(own_frames.len().saturating_sub(FOREIGN_FRAMES));
    let mut found = [Foreign::default(); 2];

    for other in all
        .iter()
        .filter(|other| other.stored.room.id() != own.id())
    {
        let stored = &other.stored.room;
        let frames = Course::Interleaved.followed(stored.frame_count());
        let frames = &frames[..frames.len().min(FOREIGN_FRAMES)];
        let theirs = Stretch {
            latents: other.map.navigator().latents(),
            poses: stored.poses(),
            frames,
        };

        let ours = Stretch {
            latents: room.map.navigator().latents(),
            poses: own.poses(),
            frames: &before,
        };

        for (found, (stretches, begin)) in found.iter_mut().zip([
            (vec![theirs], Begin::Unknown),
            (vec![ours, theirs], Begin::Known),
        ]) {
            let followed = follow(&room.tracker, &stretches, PERIOD_NS, begin);
            let updates = &followed.updates[followed.updates.len() - frames.len()..];
            found.frames += updates.len();

            found.lost += updates
                .iter()
                .filter(|update| update.status == Status::Lost)
                .count();
        }
    }

    found
}

/// Single views of followed frames, every fifth, looked for in all rooms.
fn relocalised(course: Course, all: &[Ready]) -> anyhow::Result<Relocalisation> {
    let maps: Vec<Arc<Map>> = all.iter().map(|room| room.map.clone()).collect();
    let of_room = |(place, room): (usize, &Ready)| -> anyhow::Result<[usize; 3]> {
        let mut found = [0; 3];
        for frame in course
            .followed(room.stored.room.frame_count())
            .into_iter()
            .step_by(5)
        {
            let latent = room.map.navigator().latents().row(frame.row()).to_owned();
            let answer = relocalize(&maps, &[latent], 1, &Cancellation::default())?;
            let which = match (answer.ambiguous, answer.rooms[0].map == place) {
                (true, _) => 2,
                (false, true) => 0,
                (false, false) => 1,
            };

            found[which] += 1;
        }

        Ok(found)
    };

    let found: Vec<[usize; 3]> = all
        .par_iter()
        .enumerate()
        .map(of_room)
        .collect::<anyhow::Result<_>>()?;
    let sum = |at: usize| found.iter().map(|found| found[at]).sum();

    Ok(Relocalisation {
        right: sum(0),
        wrong: sum(1),
        ambiguous: sum(2),
        rooms: all.len(),
    })
}

fn write_paths(
    folder: &Path,
    room: &str,
    followed: &Followed,
    fused: &Trajectory,
) -> anyhow::Result<()> {
    std::fs::create_dir_all(folder)
        .with_context(|| format!("{} cannot be made", folder.display()))?;

    for (name, path) in [
        ("truth", &followed.truth),
        ("fused", fused),
        ("odom", &followed.odom_path()),
    ] {
        let tum = tum_trajectory(&path.times_ns, &path.poses);
        write_file(&folder.join(format!("{room}.{name}.tum")), tum.as_bytes())?;

        write_file(
            &folder.join(format!("{room}.{name}.kitti")),
            kitti_trajectory(&path.poses).as_bytes(),
        )?;
    }

    Ok(())
}

/// The head and the last line of a table.
fn only_mean(table: &str) -> String {
    let lines: Vec<&str> = table.lines().collect();
    match lines.as_slice() {
        [head, .., last] => format!("{head}\n{last}\n"),
        _ => table.to_owned(),
    }
}

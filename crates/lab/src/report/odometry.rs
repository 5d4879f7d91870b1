//! Tracking results, per room and averaged over rooms, for `seese3 evaluate odometry`.

use serde::Serialize;

use super::table::aligned;
use crate::experiments::odometry::{LostFrames, PathErrors, Relocalisation, RoomOdometry};
use seese3_core::statistics::{Rate, coverage, mean, median};
use seese3_core::tracking::MotionSurprise;

/// Groups of about equal size into which the coverage table divides motions by their length.
const STRATA: usize = 4;

/// One line per room; with several rooms also a line of means.
pub fn odometry_table(rooms: &[RoomOdometry]) -> String {
    let head = [
        "room",
        "n",
        "odom m",
        "fused m",
        "ratio",
        "odom °",
        "fused °",
        "TRACKING",
        "DEGRADED",
        "LOST",
        "unknown: LOST",
        "found after",
    ];

    let mut lines = vec![head.map(str::to_owned).to_vec()];
    for room in rooms {
        lines.push(line(
            &room.room,
            room.tracked_frames.to_string(),
            std::slice::from_ref(room),
        ));
    }

    if rooms.len() > 1 {
        lines.push(line("mean", rooms.len().to_string(), rooms));
    }

    aligned(&lines)
}

fn line(name: &str, count: String, rooms: &[RoomOdometry]) -> Vec<String> {
    // Over one room the mean is the room's own value, so that both kinds of line share this
    // function.
    let of =
        |figure: &dyn Fn(&RoomOdometry) -> f64| mean(&rooms.iter().map(figure).collect::<Vec<_>>());
    let odom = of(&|room| room.odom.ape_m);
    let fused = of(&|room| room.fused.ape_m);

    let found: Vec<f64> = rooms
        .iter()
        .filter_map(|room| room.unknown_start.frames_to_relocalise)
        .map(|frames| frames as f64)
        .collect();

    let found = match found.len() {
        0 => "never".to_owned(),
        // The median covers only the rooms in which the map pose was found; the rest are counted.
        some if some < rooms.len() => format!("{:.0} ({some} of {})", median(&found), rooms.len()),
        _ => format!("{:.0}", median(&found)),
    };

    vec![
        name.to_owned(),
        count,
        format!("{odom:.3}"),
        format!("{fused:.3}"),
        format!("{:.3}", fused / odom),
        format!("{:.2}", of(&|room| room.odom.ape_rad.to_degrees())),
        format!("{:.2}", of(&|room| room.fused.ape_rad.to_degrees())),
        format!("{:.3}", of(&|room| room.statuses.tracking)),
        format!("{:.3}", of(&|room| room.statuses.degraded)),
        format!("{:.3}", of(&|room| room.statuses.lost)),
        format!("{:.3}", of(&|room| room.unknown_start.lost)),
        found,
    ]
}

/// Nominal against measured coverage: of map poses, of motions, and of motions by their length.
pub fn coverage_table(rooms: &[RoomOdometry]) -> String {
    let head = ["errors", "n", "within 68 %", "within 95 %"];
    let mut lines = vec![head.map(str::to_owned).to_vec()];

    let mapped = concat(rooms, |room| &room.map_poses_mapped);
    let unmapped = concat(rooms, |room| &room.map_poses_unmapped);

    // Most hold-outs leave one of the two groups empty.
    for (name, surprises) in [
        ("map poses, neighbours mapped", &mapped),
        ("map poses, neighbours not mapped", &unmapped),
    ] {
        if !surprises.is_empty() {
            lines.push(coverage_line(name, surprises));
        }
    }
    lines.push(coverage_line(
        "map poses, all",
        &[mapped, unmapped].concat(),
    ));

    let mut motions: Vec<MotionSurprise> =
        rooms.iter().flat_map(|room| room.motions.clone()).collect();
    lines.push(coverage_line("motions", &squared_errors(&motions)));

    // A covariance that is right only on average shows here: short and long motions would differ.
    motions.sort_by(|a, b| a.length.total_cmp(&b.length));
    for part in motions.chunks(motions.len().div_ceil(STRATA).max(1)) {
        let shortest = part[0].length;
        let longest = part[part.len() - 1].length;
        let name = format!("motions of {shortest:.2} to {longest:.2}");
        lines.push(coverage_line(&name, &squared_errors(part)));
    }

    aligned(&lines)
}

fn coverage_line(name: &str, squared_lengths: &[f64]) -> Vec<String> {
    let found = coverage(squared_lengths);
    vec![
        name.to_owned(),
        squared_lengths.len().to_string(),
        format!("{:.3}", found.within_68),
        format!("{:.3}", found.within_95),
    ]
}

fn concat(rooms: &[RoomOdometry], of: fn(&RoomOdometry) -> &Vec<f64>) -> Vec<f64> {
    rooms.iter().flat_map(of).copied().collect()
}

fn squared_errors(motions: &[MotionSurprise]) -> Vec<f64> {
    motions.iter().map(|motion| motion.squared_error).collect()
}

/// How many frames of other rooms were answered LOST, as text with Wilson's 95 % interval.
pub fn other_rooms_text(rooms: &[RoomOdometry]) -> String {
    let from_start = other_rooms_line("from the beginning", rooms, |room| {
        room.other_rooms_from_start
    });
    let after_own = other_rooms_line("after the room's own", rooms, |room| {
        room.other_rooms_after_own
    });

    from_start + &after_own
}

fn other_rooms_line(
    when: &str,
    rooms: &[RoomOdometry],
    of: fn(&RoomOdometry) -> LostFrames,
) -> String {
    let frames = rooms.iter().map(|room| of(room).frames).sum();
    let lost = rooms.iter().map(|room| of(room).lost).sum();
    let rate = Rate::of(lost, frames);

    format!(
        "frames of other rooms answered LOST, {when}: {lost} of {frames} ({:.4} [{:.4}, {:.4}])\n",
        rate.rate, rate.low, rate.high
    )
}

/// Which room single views were taken to be in, as text.
pub fn relocalisation_text(found: &Relocalisation) -> String {
    let count = found.right + found.wrong + found.ambiguous;
    let share = |n: usize| n as f64 / count.max(1) as f64;

    format!(
        "single views among {} rooms: {:.4} right, {:.4} wrong, {:.4} ambiguous, of {count}",
        found.rooms,
        share(found.right),
        share(found.wrong),
        share(found.ambiguous)
    )
}

/// The file of `seese3 evaluate odometry --json`.
#[derive(Debug, Serialize)]
pub struct OdometryJson {
    rooms: Vec<RoomJson>,
    /// Shares of map poses inside the 68 % and the 95 % ellipsoid, over all rooms.
    coverage_places: [f64; 2],
    coverage_motions: [f64; 2],
    relocalisation: Option<RelocalisationJson>,
    ape_formula: &'static str,
    rpe_formula: &'static str,
    alignment: &'static str,
}

#[derive(Debug, Serialize)]
struct RoomJson {
    room: String,
    format: String,
    mapped: usize,
    followed: usize,
    ape_translation_rmse_m: OdomAndFused,
    ape_rotation_rmse_rad: OdomAndFused,
    rpe_translation_rmse_m: OdomAndFused,
    coverage_places: [f64; 2],
    coverage_motions: [f64; 2],
    tracking: f64,
    degraded: f64,
    lost: f64,
    relocalizing: f64,
    lost_without_initial_pose: f64,
    frames_to_relocalise: Option<usize>,
    /// Frames of other rooms: as the beginning of a stream, then after the room's own.
    foreign: [LostFramesJson; 2],
}

#[derive(Debug, Serialize)]
struct OdomAndFused {
    odom: f64,
    fused: f64,
}

#[derive(Debug, Serialize)]
struct LostFramesJson {
    frames: usize,
    lost: usize,
}

#[derive(Debug, Serialize)]
struct RelocalisationJson {
    rooms: usize,
    right: usize,
    wrong: usize,
    ambiguous: usize,
}

/// The record of tracking: the results of every room, the coverage over all rooms, relocalisation,
/// and the formulas.
pub fn odometry_json(
    rooms: &[RoomOdometry],
    relocalisation: Option<&Relocalisation>,
) -> OdometryJson {
    let map_poses = [
        concat(rooms, |room| &room.map_poses_mapped),
        concat(rooms, |room| &room.map_poses_unmapped),
    ]
    .concat();
    let motions: Vec<MotionSurprise> = rooms.iter().flat_map(|room| room.motions.clone()).collect();

    OdometryJson {
        rooms: rooms.iter().map(room_json).collect(),
        coverage_places: shares(&map_poses),
        coverage_motions: shares(&squared_errors(&motions)),
        relocalisation: relocalisation.map(|found| RelocalisationJson {
            rooms: found.rooms,
            right: found.right,
            wrong: found.wrong,
            ambiguous: found.ambiguous,
        }),
        ape_formula: super::APE_FORMULA,
        rpe_formula: super::RPE_FORMULA,
        alignment: "none",
    }
}

fn room_json(room: &RoomOdometry) -> RoomJson {
    let both = |of: fn(&PathErrors) -> f64| OdomAndFused {
        odom: of(&room.odom),
        fused: of(&room.fused),
    };
    let lost_frames = |found: LostFrames| LostFramesJson {
        frames: found.frames,
        lost: found.lost,
    };
    let map_poses = [&room.map_poses_mapped[..], &room.map_poses_unmapped].concat();

    RoomJson {
        room: room.room.clone(),
        format: room.format.clone(),
        mapped: room.mapped_frames,
        followed: room.tracked_frames,
        ape_translation_rmse_m: both(|errors| errors.ape_m),
        ape_rotation_rmse_rad: both(|errors| errors.ape_rad),
        rpe_translation_rmse_m: both(|errors| errors.rpe_m),
        coverage_places: shares(&map_poses),
        coverage_motions: shares(&squared_errors(&room.motions)),
        tracking: room.statuses.tracking,
        degraded: room.statuses.degraded,
        lost: room.statuses.lost,
        relocalizing: room.statuses.relocalizing,
        lost_without_initial_pose: room.unknown_start.lost,
        frames_to_relocalise: room.unknown_start.frames_to_relocalise,
        foreign: [
            lost_frames(room.other_rooms_from_start),
            lost_frames(room.other_rooms_after_own),
        ],
    }
}

fn shares(squared_lengths: &[f64]) -> [f64; 2] {
    let found = coverage(squared_lengths);
    [found.within_68, found.within_95]
}

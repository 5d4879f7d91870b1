//! Tracking results, per room and averaged over rooms, for `seese3 evaluate odometry`.

use serde::Serialize;

use super::table::aligned;
use crate::experiments::odometry::{LostFrames, PathErrors, Relocalisation, RoomOdometry};
use crate::experiments::tracking_scores::{AnswerErrors, TrackingScores, VelocityErrors};
use seese3_core::statistics::{Rate, coverage, mean, median, root_mean_square};
use seese3_robot::tracking::MotionSurprise;

/// Number of groups of about equal size by which the coverage table splits motions by length.
const STRATA: usize = 4;

/// One line per room, and a line of means if there are several rooms.
pub fn odometry_table(rooms: &[RoomOdometry]) -> String {
    let head = [
        "room",
        "n",
        "fused m",
        "odom m",
        "nearest frame m",
        "standing still m",
        "fused °",
        "nearest frame °",
        "TRACKING",
        "DEGRADED",
        "LOST",
        "TRACKING wrong",
        "velocity error m/s",
        "zero-velocity error m/s",
        "unknown start: LOST",
        "relocalized after",
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
    // The mean over one room is the room's own value, so both kinds of line share this function.
    let of =
        |figure: &dyn Fn(&RoomOdometry) -> f64| mean(&rooms.iter().map(figure).collect::<Vec<_>>());
    let scores = || rooms.iter().map(|room| &room.scores);
    let ape = AnswerErrors::mean(scores().map(|scores| &scores.ape));
    let turn = AnswerErrors::mean(scores().map(|scores| &scores.turn));
    let velocity = VelocityErrors::mean(scores().map(|scores| &scores.velocity));

    let found: Vec<f64> = rooms
        .iter()
        .filter_map(|room| room.unknown_start.frames_to_relocalise)
        .map(|frames| frames as f64)
        .collect();

    let found = match found.len() {
        0 => "never".to_owned(),
        // The median covers only the rooms in which the tracker relocalized; their number follows.
        some if some < rooms.len() => format!("{:.0} ({some} of {})", median(&found), rooms.len()),
        _ => format!("{:.0}", median(&found)),
    };

    vec![
        name.to_owned(),
        count,
        format!("{:.3}", ape.fused),
        format!("{:.3}", ape.odom),
        format!("{:.3}", ape.nearest_frame),
        format!("{:.3}", ape.standing_still),
        format!("{:.2}", turn.fused.to_degrees()),
        format!("{:.2}", turn.nearest_frame.to_degrees()),
        format!("{:.3}", of(&|room| room.statuses.tracking)),
        format!("{:.3}", of(&|room| room.statuses.degraded)),
        format!("{:.3}", of(&|room| room.statuses.lost)),
        format!("{:.3}", wrong_share(&scores_of(rooms))),
        format!("{:.3}", velocity.error_m_s),
        format!("{:.3}", velocity.zero_m_s),
        format!("{:.3}", of(&|room| room.unknown_start.lost)),
        found,
    ]
}

fn scores_of(rooms: &[RoomOdometry]) -> Vec<&TrackingScores> {
    rooms.iter().map(|room| &room.scores).collect()
}

/// Fraction of TRACKING frames with an error above 0.5 m or 15°, over all rooms.
pub(super) fn wrong_share(rooms: &[&TrackingScores]) -> f64 {
    let sum =
        |of: fn(&TrackingScores) -> usize| -> usize { rooms.iter().map(|scores| of(scores)).sum() };
    sum(|scores| scores.tracking_wrong) as f64 / sum(|scores| scores.tracking) as f64
}

/// Measured coverage of the 68 % and 95 % ellipsoids: for map poses, for odometry, for motions, and
/// for motions by length.
pub fn coverage_table(rooms: &[RoomOdometry]) -> String {
    let head = ["errors", "n", "within 68 %", "within 95 %"];
    let mut lines = vec![head.map(str::to_owned).to_vec()];

    let mapped = concat(rooms, |room| &room.map_poses_mapped);
    let unmapped = concat(rooms, |room| &room.map_poses_unmapped);

    // Most hold-outs leave one of the two groups empty.
    for (name, surprises) in [
        ("map poses, neighbors mapped", &mapped),
        ("map poses, neighbors not mapped", &unmapped),
    ] {
        if !surprises.is_empty() {
            lines.push(coverage_line(name, surprises));
        }
    }
    lines.push(coverage_line(
        "map poses, all",
        &[mapped, unmapped].concat(),
    ));

    let tracking = concat(rooms, |room| &room.scores.tracking_surprises);
    lines.push(coverage_line("map poses while TRACKING", &tracking));
    let odom = concat(rooms, |room| &room.scores.odom_surprises);
    lines.push(coverage_line("odom", &odom));

    let mut motions: Vec<MotionSurprise> =
        rooms.iter().flat_map(|room| room.motions.clone()).collect();
    lines.push(coverage_line("motions", &squared_errors(&motions)));

    // Detects a covariance that is right only on average: short and long motions would differ.
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

/// Fraction of frames of other rooms reported LOST, as text with Wilson's 95 % interval.
pub fn other_rooms_text(rooms: &[RoomOdometry]) -> String {
    let from_start = other_rooms_line("at the start of a stream", rooms, |room| {
        room.other_rooms_from_start
    });
    let after_own = other_rooms_line("after the room's own frames", rooms, |room| {
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
        "frames of other rooms reported LOST, {when}: {lost} of {frames} ({:.4} [{:.4}, {:.4}])\n",
        rate.rate, rate.low, rate.high
    )
}

/// Results of relocalizing single views, as text.
pub fn relocalisation_text(found: &Relocalisation) -> String {
    let count = found.right + found.wrong + found.ambiguous;
    let share = |n: usize| n as f64 / count.max(1) as f64;

    let covered = coverage(&found.pose_surprises);
    format!(
        "single views among {} rooms: {:.4} right, {:.4} wrong, {:.4} ambiguous, of {count}; with their own room \
         left out, {:.4} are not ambiguous; poses in the right room: RMSE {:.3} m (nearest frame {:.3} m), \
         {:.3} and {:.3} within the 68 and 95 % ellipsoids",
        found.rooms,
        share(found.right),
        share(found.wrong),
        share(found.ambiguous),
        share(found.named_without_own),
        root_mean_square(&found.pose_errors_m),
        root_mean_square(&found.nearest_errors_m),
        covered.within_68,
        covered.within_95,
    )
}

/// The file of `seese3 evaluate odometry --json`.
#[derive(Debug, Serialize)]
pub struct OdometryJson {
    rooms: Vec<RoomJson>,
    /// Errors are means over rooms; fractions are over the frames of all rooms.
    #[serde(flatten)]
    all: ScoresJson,
    /// Fractions of map poses inside the 68 % and the 95 % ellipsoid, over all rooms.
    coverage_places: [f64; 2],
    coverage_motions: [f64; 2],
    relocalisation: Option<RelocalisationJson>,
    ape_formula: &'static str,
    rpe_formula: &'static str,
    alignment: &'static str,
}

/// Errors of a tracker and of its baselines on the same frames.
#[derive(Debug, Serialize)]
pub(super) struct ScoresJson {
    ape_m: AnswersJson,
    ape_rad: AnswersJson,
    /// Fractions of TRACKING map poses inside the 68 % and the 95 % ellipsoid; null without any.
    coverage: CoverageJson,
    coverage_odom: CoverageJson,
    /// Fraction of TRACKING frames with an error above 0.5 m or 15°.
    tracking_wrong: Option<f64>,
    velocity: VelocityJson,
}

#[derive(Debug, Serialize)]
struct AnswersJson {
    fused: Option<f64>,
    odom: Option<f64>,
    nearest_frame: Option<f64>,
    standing_still: Option<f64>,
}

#[derive(Debug, Serialize)]
struct CoverageJson {
    #[serde(rename = "68")]
    within_68: Option<f64>,
    #[serde(rename = "95")]
    within_95: Option<f64>,
}

#[derive(Debug, Serialize)]
struct VelocityJson {
    error_m_s: Option<f64>,
    zero_m_s: Option<f64>,
}

#[derive(Debug, Serialize)]
struct RoomJson {
    room: String,
    #[serde(flatten)]
    scores: ScoresJson,
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
    /// Frames of other rooms: first at the start of a stream, then after the room's own frames.
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
    /// Number of views that are not ambiguous when their own room is left out.
    named_without_own: usize,
    /// Root-mean-square errors of the views located in the right room, metres; null without any.
    pose_m: Option<f64>,
    nearest_frame_m: Option<f64>,
    coverage: CoverageJson,
}

/// Builds the JSON record of tracking: results per room, coverage over all rooms, relocalization,
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
        all: scores_json(&scores_of(rooms)),
        coverage_places: shares(&map_poses),
        coverage_motions: shares(&squared_errors(&motions)),
        relocalisation: relocalisation.map(|found| RelocalisationJson {
            rooms: found.rooms,
            right: found.right,
            wrong: found.wrong,
            ambiguous: found.ambiguous,
            named_without_own: found.named_without_own,
            pose_m: known(root_mean_square(&found.pose_errors_m)),
            nearest_frame_m: known(root_mean_square(&found.nearest_errors_m)),
            coverage: coverage_json(&found.pose_surprises),
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
        scores: scores_json(&[&room.scores]),
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

/// Scores over several rooms: errors are means over rooms, fractions are over all frames.
pub(super) fn scores_json(rooms: &[&TrackingScores]) -> ScoresJson {
    let scores = || rooms.iter().copied();
    let answers = |errors: AnswerErrors| AnswersJson {
        fused: known(errors.fused),
        odom: known(errors.odom),
        nearest_frame: known(errors.nearest_frame),
        standing_still: known(errors.standing_still),
    };
    let covered = |of: fn(&TrackingScores) -> &Vec<f64>| {
        let surprises: Vec<f64> = scores().flat_map(of).copied().collect();
        coverage_json(&surprises)
    };
    let velocity = VelocityErrors::mean(scores().map(|scores| &scores.velocity));

    ScoresJson {
        ape_m: answers(AnswerErrors::mean(scores().map(|scores| &scores.ape))),
        ape_rad: answers(AnswerErrors::mean(scores().map(|scores| &scores.turn))),
        coverage: covered(|scores| &scores.tracking_surprises),
        coverage_odom: covered(|scores| &scores.odom_surprises),
        tracking_wrong: known(wrong_share(rooms)),
        velocity: VelocityJson {
            error_m_s: known(velocity.error_m_s),
            zero_m_s: known(velocity.zero_m_s),
        },
    }
}

/// `None` for a value that is not finite, because JSON has no NaN.
fn known(value: f64) -> Option<f64> {
    value.is_finite().then_some(value)
}

fn coverage_json(squared_lengths: &[f64]) -> CoverageJson {
    let [within_68, within_95] = shares(squared_lengths).map(known);
    CoverageJson {
        within_68,
        within_95,
    }
}

fn shares(squared_lengths: &[f64]) -> [f64; 2] {
    let found = coverage(squared_lengths);
    [found.within_68, found.within_95]
}

//! Tracking results, per room and averaged over rooms, for `seese3 evaluate odometry`.

use serde::Serialize;

use super::table::Column::{self, Number, Text};
use super::table::{Table, fixed};
use crate::experiments::mapless::MaplessDrift;
use crate::experiments::odometry::{MapPoseErrors, Relocalization, RoomOdometry, squared_errors};
use crate::experiments::odometry_scenarios::{DarkErrors, Scenarios};
use crate::experiments::replay::MotionSurprise;
use crate::experiments::tracking_intervals::TrackingIntervals;
use crate::experiments::tracking_scores::{StatusShares, TrackingScores};
use crate::json;
use seese3_core::statistics::{Rate, coverage, mean, median, root_mean_square};

/// Number of groups of about equal size by which the coverage table splits motions by length.
const STRATA: usize = 4;

/// One line per room, and a line of means if there are several rooms.
pub fn odometry_table(rooms: &[RoomOdometry]) -> Table {
    let each = rooms.iter().map(|room| {
        let count = room.tracked_frames.to_string();
        Line::of(&room.room, count, std::slice::from_ref(room))
    });
    let mean = (rooms.len() > 1).then(|| Line::of("mean", rooms.len().to_string(), rooms));
    let lines: Vec<Line> = each.chain(mean).collect();

    let columns: [Column<Line>; 18] = [
        Text("room", |line| line.name.clone()),
        Text("n", |line| line.count.clone()),
        Number("fused m", 3, |line| line.scores.ape.fused),
        Number("odom m", 3, |line| line.scores.ape.odom),
        Number("nearest frame m", 3, |line| line.scores.ape.nearest_frame),
        Number("standing still m", 3, |line| line.scores.ape.standing_still),
        Number("fused °", 2, |line| line.scores.turn.fused.to_degrees()),
        Number("nearest frame °", 2, |line| {
            line.scores.turn.nearest_frame.to_degrees()
        }),
        Number("TRACKING", 3, |line| line.statuses.tracking),
        Number("DEGRADED", 3, |line| line.statuses.degraded),
        Number("LOST", 3, |line| line.statuses.lost),
        Number("TRACKING wrong", 3, |line| {
            line.scores.tracking_wrong.into()
        }),
        Number("velocity error m/s", 3, |line| {
            line.scores.velocity.error_m_s
        }),
        Number("zero-velocity error m/s", 3, |line| {
            line.scores.velocity.zero_m_s
        }),
        Number("odom drift %", 1, |line| line.scores.drift.percent),
        Number("odom drift °/m", 2, |line| line.scores.drift.deg_per_m),
        Number("unknown start: LOST", 3, |line| line.unknown_start_lost),
        Text("relocalized after", |line| line.relocalized_after.clone()),
    ];

    Table::of(&lines, &columns)
}

/// A room, or the means over several rooms.
struct Line {
    name: String,
    count: String,
    scores: TrackingScores,
    statuses: StatusShares,
    unknown_start_lost: f64,
    relocalized_after: String,
}

impl Line {
    /// The mean over one room is the room's own value.
    fn of(name: &str, count: String, rooms: &[RoomOdometry]) -> Self {
        let over = |of: fn(&RoomOdometry) -> f64| mean(&rooms.iter().map(of).collect::<Vec<_>>());
        let found: Vec<f64> = rooms
            .iter()
            .filter_map(|room| room.unknown_start.frames_to_relocalize)
            .map(|frames| frames as f64)
            .collect();

        Self {
            name: name.to_owned(),
            count,
            scores: scores_of(rooms),
            statuses: StatusShares {
                tracking: over(|room| room.statuses.tracking),
                degraded: over(|room| room.statuses.degraded),
                lost: over(|room| room.statuses.lost),
                relocalizing: over(|room| room.statuses.relocalizing),
            },
            unknown_start_lost: over(|room| room.unknown_start.lost),
            relocalized_after: match found.len() {
                0 => "never".to_owned(),
                // The median covers only the rooms in which the tracker relocalized.
                some if some < rooms.len() => {
                    format!("{:.0} ({some} of {})", median(&found), rooms.len())
                }
                _ => format!("{:.0}", median(&found)),
            },
        }
    }
}

fn scores_of(rooms: &[RoomOdometry]) -> TrackingScores {
    TrackingScores::together(rooms.iter().map(|room| &room.scores))
}

/// Measured coverage of the 68 % and 95 % ellipsoids: for map poses, for odometry, for motions, and
/// for motions by length.
pub fn coverage_table(rooms: &[RoomOdometry]) -> Table {
    let mut table = Table::new("errors | n | within 68 % | within 95 %");
    let mut add = |name: &str, squared_lengths: &[f64]| {
        let count = std::iter::once(squared_lengths.len().to_string());
        table.row(name, count.chain(fixed(json::covered(squared_lengths), 3)));
    };

    // Most hold-outs leave one of the two groups empty.
    let map_poses = map_poses(rooms);
    for (name, surprises) in [
        ("map poses, neighbors mapped", &map_poses.mapped),
        ("map poses, neighbors not mapped", &map_poses.unmapped),
    ] {
        if !surprises.is_empty() {
            add(name, surprises);
        }
    }
    add("map poses, all", &map_poses.all());

    let scores = scores_of(rooms);
    add("map poses while TRACKING", &scores.tracking_surprises);
    add("odom", &scores.odom_surprises);

    let mut motions = motions(rooms);
    add("motions", &squared_errors(&motions));

    // Detects a covariance that is right only on average: short and long motions would differ.
    motions.sort_by(|a, b| a.length.total_cmp(&b.length));
    for part in motions.chunks(motions.len().div_ceil(STRATA).max(1)) {
        let shortest = part[0].length;
        let longest = part[part.len() - 1].length;
        let name = format!("motions of {shortest:.2} to {longest:.2}");
        add(&name, &squared_errors(part));
    }

    table
}

/// 95 % intervals of the scores, over rooms and blocks of time; empty without frames.
pub fn intervals_table(rooms: &[RoomOdometry]) -> Table {
    let mut table = Table::new("95 % interval | from | to");
    let Some(found) = intervals(rooms) else {
        return table;
    };
    for (name, interval) in [
        ("fused m", found.fused_m),
        ("nearest frame m", found.nearest_frame_m),
        ("fused − nearest frame m", found.fused_minus_nearest_m),
        ("TRACKING", found.tracking),
        ("TRACKING wrong", found.tracking_wrong),
        ("within 68 % while TRACKING", found.coverage_68),
        ("within 95 % while TRACKING", found.coverage_95),
        ("velocity error / of reporting 0", found.velocity_ratio),
    ] {
        table.row(name.to_owned(), fixed(interval, 3));
    }
    table
}

fn intervals(rooms: &[RoomOdometry]) -> Option<TrackingIntervals> {
    let blocks: Vec<_> = rooms.iter().map(|room| &room.blocks[..]).collect();
    TrackingIntervals::of(&blocks)
}

fn map_poses(rooms: &[RoomOdometry]) -> MapPoseErrors {
    let all = |of: fn(&MapPoseErrors) -> &Vec<f64>| {
        let rooms = rooms.iter().map(|room| &room.map_poses);
        rooms.flat_map(of).copied().collect()
    };

    MapPoseErrors {
        mapped: all(|errors| &errors.mapped),
        unmapped: all(|errors| &errors.unmapped),
    }
}

fn motions(rooms: &[RoomOdometry]) -> Vec<MotionSurprise> {
    rooms.iter().flat_map(|room| room.motions.clone()).collect()
}

fn scenarios(rooms: &[RoomOdometry]) -> Option<Scenarios> {
    Scenarios::together(rooms.iter().map(|room| &room.scenarios))
}

/// Position errors of parts without a map, kidnaps and wheels, over all rooms; `None` for streams
/// of an adapter.
pub fn scenarios_text(rooms: &[RoomOdometry]) -> Option<String> {
    let Scenarios {
        gaps,
        dark,
        mapless,
        kidnaps,
        wheels,
        inertial,
        depths,
    } = scenarios(rooms)?;
    let mut table = Table::new(
        "no view matched for | n | fused m (median) | with depths | standing still m | constant velocity m | within 68 % | within 95 %",
    );
    for gap in gaps.iter().filter(|gap| !gap.fused.is_empty()) {
        let errors = [
            &gap.fused,
            &gap.depths,
            &gap.standing_still,
            &gap.constant_velocity,
        ];
        let medians = errors.map(|errors| median_or_nan(errors));
        let cells = std::iter::once(gap.fused.len().to_string())
            .chain(fixed(medians, 3))
            .chain(fixed(json::covered(&gap.surprises), 3));
        table.row(format!("{} s", gap.seconds), cells);
    }

    let dark_table = dark_table(&dark);
    let mapless_table = mapless_table(&mapless);
    let wheels = format!(
        "simulated wheels (2 % length, 1°/m): fused RMSE {:.3} m, wheels alone {:.3} m, TRACKING {:.3}, velocity \
         error {:.3} m/s",
        wheels.fused,
        wheels.alone.unwrap_or(f64::NAN),
        wheels.tracking,
        wheels.velocity.error_m_s
    );
    let inertial = format!(
        "simulated inertial sensor: fused RMSE {:.3} m, TRACKING {:.3}",
        inertial.fused, inertial.tracking
    );
    let depths = depths.map_or_else(String::new, |depths| {
        format!(
            "\nsimulated depths: fused RMSE {:.3} m, TRACKING {:.3}",
            depths.fused, depths.tracking
        )
    });
    let kidnaps = if kidnaps.n == 0 {
        "kidnaps: the streams are too short".to_owned()
    } else {
        let found = &kidnaps.recovered_after;
        let after = if found.is_empty() {
            "never".to_owned()
        } else {
            format!("after {:.0} frames (median)", median(found))
        };
        format!(
            "kidnaps: {} by {:.2} m (median); TRACKING at the right place {after} in {} of {}; wrong {} of {} TRACKING frames",
            kidnaps.n,
            median(&kidnaps.distances_m),
            found.len(),
            kidnaps.n,
            kidnaps.wrong,
            kidnaps.tracking,
        )
    };
    Some(format!(
        "{table}\n{dark_table}\n{mapless_table}\n{kidnaps}\n{wheels}\n{inertial}{depths}"
    ))
}

fn median_or_nan(values: &[f64]) -> f64 {
    if values.is_empty() {
        f64::NAN
    } else {
        median(values)
    }
}

fn dark_table(dark: &[DarkErrors]) -> Table {
    let mut table = Table::new(
        "no image for | n | fused m (median) | with wheels | with inertial sensor | standing still m | of inertial within 68 % | within 95 %",
    );
    for dark in dark.iter().filter(|dark| !dark.alone.is_empty()) {
        let errors = [
            &dark.alone,
            &dark.wheels,
            &dark.inertial,
            &dark.standing_still,
        ];
        let medians = errors.map(|errors| median(errors));
        let cells = std::iter::once(dark.alone.len().to_string())
            .chain(fixed(medians, 3))
            .chain(fixed(json::covered(&dark.inertial_surprises), 3));
        table.row(format!("{} s", dark.seconds), cells);
    }
    table
}

fn mapless_table(mapless: &MaplessDrift) -> Table {
    let mut table = Table::new("odometry without a map | drift % | drift °/m");
    for (name, drift) in [
        ("images", &mapless.images),
        (
            "images, true length of the first part",
            &mapless.images_true_length,
        ),
        ("images and depths", &mapless.depths),
        ("images and wheels", &mapless.wheels),
        ("wheels alone", &mapless.wheels_alone),
        (
            "pairs of views, true lengths",
            &mapless.two_view_true_lengths,
        ),
    ] {
        table.row(name.to_owned(), fixed([drift.percent, drift.deg_per_m], 2));
    }
    table
}

/// Fraction of frames of other rooms reported LOST, as text with its 95 % interval over rooms.
pub fn other_rooms_text(rooms: &[RoomOdometry]) -> String {
    let line = |place: usize, when: &str| {
        let counted = rooms.iter().map(|room| room.other_rooms[place]);
        let counts: Vec<_> = counted.map(|room| (room.lost, room.frames)).collect();
        let rate = Rate::of_blocks(&counts);

        format!(
            "frames of other rooms reported LOST, {when}: {} of {} ({:.4} [{:.4}, {:.4}])",
            rate.successes(),
            rate.n,
            rate.rate,
            rate.low,
            rate.high
        )
    };

    let from_start = line(0, "at the start of a stream");
    format!("{from_start}\n{}", line(1, "after the room's own frames"))
}

/// Results of relocalizing single views, as text.
pub fn relocalization_text(found: &Relocalization) -> String {
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
pub struct OdometryJson<'a> {
    rooms: &'a [RoomOdometry],
    #[serde(flatten)]
    all: TrackingScores,
    intervals_95: Option<TrackingIntervals>,
    #[serde(flatten)]
    statuses: StatusShares,
    #[serde(flatten)]
    scenarios: Option<Scenarios>,
    /// Fractions of map poses inside the 68 % and the 95 % ellipsoid, over all rooms.
    coverage_places: MapPoseErrors,
    coverage_motions: [f64; 2],
    relocalization: Option<&'a Relocalization>,
    ape_formula: &'static str,
    rpe_formula: &'static str,
    alignment: &'static str,
}

/// Builds the JSON record of tracking: results per room, coverage over all rooms, relocalization,
/// and the formulas.
pub fn odometry_json<'a>(
    rooms: &'a [RoomOdometry],
    relocalization: Option<&'a Relocalization>,
) -> OdometryJson<'a> {
    OdometryJson {
        rooms,
        all: scores_of(rooms),
        intervals_95: intervals(rooms),
        statuses: Line::of("mean", String::new(), rooms).statuses,
        scenarios: scenarios(rooms),
        coverage_places: map_poses(rooms),
        coverage_motions: json::covered(&squared_errors(&motions(rooms))),
        relocalization,
        ape_formula: super::APE_FORMULA,
        rpe_formula: super::RPE_FORMULA,
        alignment: "none",
    }
}

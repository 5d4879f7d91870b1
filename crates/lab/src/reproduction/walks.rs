//! Section: walks of several steps, by the size of the motion, over many pairs.

use std::sync::Arc;

use serde::Serialize;

use seese3_core::adapter::Reading;
use seese3_core::eval::{Protocol, RetrievedPair};
use seese3_core::geometry::body_twist;
use seese3_core::navigation::{HIT_THRESHOLDS, Mode, NavigatorKind, RetrievalMetric, StepKind};
use seese3_core::splits::Split;
use seese3_core::statistics::{RoomMean, bootstrap_mean, mean, median};
use seese3_core::training::RoomData;

use super::adapters::Adapters;
use super::claims::{Case, Claim, encoders_and_control};
use super::cross::HOMOGENEOUS;
use super::plans::steady_adapter;
use super::{Error, Found, Reproduction};
use crate::experiments::cross_room::{RoomOutcome, outcomes};
use crate::report::Column::{self, Number, Text};
use crate::report::{Section, Table, room_mean_text};

/// Number of equal steps of a walk, as in the paper.
const STEPS: u32 = 4;
/// Upper ends of the classes of motions by ‖ΔP‖, meters and radians together.
const SIZES: [f64; 3] = [0.3, 0.6, 1.0];
/// Modes of a walk that are compared; the paper's first.
const MODES: [Mode; 2] = [Mode::OpenLoop, Mode::Snap];

/// The ends of the walks of one size: a row of the table and of the record.
#[derive(Debug, Serialize)]
pub struct WalkEndRecord {
    features: String,
    mode: &'static str,
    /// ‖ΔP‖ of the motions: lower end of the class, and its upper end if there is one.
    least: f64,
    most: Option<f64>,
    rooms: usize,
    pairs: usize,
    /// Share of walks that end within 0.1 of the target.
    hit: RoomMean,
    /// The same of standing still, mean over rooms.
    still_hit: f64,
    /// The mean distance ‖ΔP_target − ΔP_end‖.
    error: RoomMean,
    /// The same of standing still.
    still_error: f64,
    /// Median over rooms of the median distance, meters and degrees.
    meters: f64,
    degrees: f64,
}

/// The end of a walk in a room.
struct End {
    /// ‖ΔP‖ of the motion.
    size: f64,
    error: f64,
    meters: f64,
    radians: f64,
}

/// The ends of all walks of one mode, by room.
struct Walks {
    features: String,
    mode: Mode,
    rooms: Vec<Vec<End>>,
}

/// Builds the section with the ends of walks in all held-out rooms.
pub fn section(
    given: &Reproduction<'_>,
    adapters: &Adapters,
) -> Result<Found<Vec<WalkEndRecord>>, Error> {
    let mut walks = Vec::new();
    for set in &given.sets {
        for mode in MODES {
            walks.push(walked(given, adapters, &set.features, &set.test, mode)?);
        }
    }

    let record: Vec<WalkEndRecord> = walks.iter().flat_map(Walks::records).collect();
    let columns: [Column<WalkEndRecord>; 12] = [
        Text("features", |row| row.features.clone()),
        Text("mode", |row| row.mode.to_owned()),
        Text("size of the motion", |row| {
            class_words(row.least, row.most.unwrap_or(f64::INFINITY))
        }),
        Text("rooms", |row| row.rooms.to_string()),
        Text("pairs", |row| row.pairs.to_string()),
        Text("Hit@0.1 [95 %]", |row| room_mean_text(&row.hit)),
        Number("Identity", 3, |row| row.still_hit),
        Text("end error [95 %]", |row| room_mean_text(&row.error)),
        Number("of Identity", 3, |row| row.still_error),
        Number("end, m", 2, |row| row.meters),
        Number("end, °", 1, |row| row.degrees),
        Text("end error / of Identity", |row| {
            format!("{:.2}", row.error.mean / row.still_error)
        }),
    ];
    let mut section = Section::new("Walks of four steps in held-out rooms, by size of the motion");
    section.table(Table::of(&record, &columns));
    section.text(format!(
        "Adapters of preset steady on all training rooms. Every pair of every held-out room at strides {:?}, \
         {STEPS} equal steps by {HOMOGENEOUS}, all frames are candidates. The size of a motion is ‖ΔP‖, the end error \
         ‖ΔP − ΔP of the last frame‖, meters and radians together; Identity stays at the source, and its error is the size. Means over rooms with 95 % \
         intervals; meters and degrees are medians. Open loop is the paper's mode and ends where one step ends (A-22); snap \
         takes each step from the frame that the last one retrieved.",
        given.options.strides
    ));
    let encoders: Vec<&str> = encoders_and_control(&given.sets)
        .0
        .iter()
        .map(|set| set.features.as_str())
        .collect();
    walks.retain(|walks| encoders.contains(&walks.features.as_str()));
    Ok(Found {
        section,
        record,
        claims: claims_of(&walks).into(),
    })
}

fn walked(
    given: &Reproduction<'_>,
    adapters: &Adapters,
    features: &str,
    rooms: &[RoomData<'_>],
    mode: Mode,
) -> Result<Walks, Error> {
    let set = given.sets.iter().find(|set| set.features == features);
    let plan = set.map(steady_adapter).unwrap_or_default();
    let trained = adapters
        .reproduced(&plan, features)
        .ok_or_else(|| Error::Input("the steady adapter was not trained".to_owned()))?;
    let adapter = Arc::new(trained.adapter.clone());

    let step = StepKind::InversePoincare(Reading::Homogeneous);
    let mut by_room: Vec<Vec<End>> = rooms.iter().map(|_| Vec::new()).collect();
    for &stride in &given.options.strides {
        let protocol = Protocol {
            split: Split::Whole,
            thresholds: vec![HIT_THRESHOLDS[0]],
            navigators: vec![NavigatorKind::Step(step, RetrievalMetric::Full)],
            steps: STEPS,
            mode,
            ..Protocol::paper(stride)
        };
        let walked = outcomes(&adapter, &trained.record, rooms, &protocol, &|| ());
        for ((outcome, data), ends) in walked.into_iter().zip(rooms).zip(&mut by_room) {
            // A room that is too short for the stride has no walks of it.
            if let Ok(outcome) = outcome {
                ends.extend(ends_of(&outcome, data));
            }
        }
    }
    Ok(Walks {
        features: features.to_owned(),
        mode,
        rooms: by_room,
    })
}

fn ends_of(outcome: &RoomOutcome, data: &RoomData<'_>) -> Vec<End> {
    let poses = data.room.poses();
    let end = |walk: &RetrievedPair| {
        let [source, target] =
            [walk.pair.source, walk.pair.target].map(|frame| &poses[frame.row()]);
        End {
            size: body_twist(source, target).to_vector().norm(),
            error: walk.twist_error,
            meters: walk.pose_error.translation_m,
            radians: walk.pose_error.rotation_rad,
        }
    };
    let rows = outcome.rows.iter();
    rows.flat_map(|row| &row.retrieval.pairs).map(end).collect()
}

/// The classes of motions by size: lower and upper ends.
fn classes() -> impl Iterator<Item = (f64, f64)> {
    let ends = SIZES.into_iter().chain([f64::INFINITY]);
    std::iter::once(0.0).chain(SIZES).zip(ends)
}

fn class_words(least: f64, most: f64) -> String {
    if most.is_finite() {
        format!("{least} to {most}")
    } else {
        format!("{least} and more")
    }
}

impl Walks {
    /// A value of each room's walks of a class; NaN for a room without such walks.
    fn by_room(&self, (least, most): (f64, f64), of: &dyn Fn(&[&End]) -> f64) -> Vec<f64> {
        let room = |ends: &Vec<End>| {
            let is_inside = |end: &&End| (least..most).contains(&end.size);
            let inside: Vec<&End> = ends.iter().filter(is_inside).collect();
            if inside.is_empty() {
                f64::NAN
            } else {
                of(&inside)
            }
        };
        self.rooms.iter().map(room).collect()
    }

    fn records(&self) -> Vec<WalkEndRecord> {
        let record = |class: (f64, f64)| {
            let values = |of: &dyn Fn(&[&End]) -> f64| self.by_room(class, of);
            let counts = values(&|ends| ends.len() as f64);
            let known: Vec<f64> = counts.into_iter().filter(|count| !count.is_nan()).collect();
            let middle = |of: fn(&End) -> f64| {
                let medians = values(&|ends| median(&each(ends, of)));
                let known: Vec<f64> = medians.into_iter().filter(|x| !x.is_nan()).collect();
                median(&known)
            };
            let over_rooms = |of: fn(&End) -> f64| {
                let mut means = values(&|ends| mean(&each(ends, of)));
                means.retain(|mean| !mean.is_nan());
                bootstrap_mean(&means, 0)
            };
            WalkEndRecord {
                features: self.features.clone(),
                mode: self.mode.name(),
                least: class.0,
                most: Some(class.1).filter(|most| most.is_finite()),
                rooms: known.len(),
                pairs: known.iter().sum::<f64>() as usize,
                hit: over_rooms(|end| is_hit(end.error)),
                still_hit: over_rooms(|end| is_hit(end.size)).mean,
                error: over_rooms(|end| end.error),
                still_error: over_rooms(|end| end.size).mean,
                meters: middle(|end| end.meters),
                degrees: middle(|end| end.radians).to_degrees(),
            }
        };
        let records = classes().map(record);
        records.filter(|record| record.rooms > 0).collect()
    }
}

/// 1 for an error within the smallest threshold of the paper, else 0.
fn is_hit(error: f64) -> f64 {
    f64::from(u8::from(error < HIT_THRESHOLDS[0]))
}

fn each(ends: &[&End], of: fn(&End) -> f64) -> Vec<f64> {
    ends.iter().map(|end| of(end)).collect()
}

/// The claims on walks in an open loop, the paper's mode.
fn claims_of(walks: &[Walks]) -> [Claim; 2] {
    let open = || walks.iter().filter(|walks| walks.mode == Mode::OpenLoop);
    let error =
        |walks: &Walks, class| walks.by_room(class, &|ends| mean(&each(ends, |end| end.error)));

    let mut nearer = Vec::new();
    let mut grows = Vec::new();
    for walks in open() {
        let is_known = |class: &(f64, f64)| error(walks, *class).iter().any(|x| !x.is_nan());
        let all: Vec<(f64, f64)> = classes().filter(is_known).collect();
        for &(least, most) in &all {
            let gain = walks.by_room((least, most), &|ends| {
                mean(&each(ends, |end| end.size - end.error))
            });
            let case = format!("{}, size {}", walks.features, class_words(least, most));
            nearer.push(Case::of_rooms(case, &gain));
        }
        for pair in all.windows(2) {
            let case = format!(
                "{}, size from {} over size below",
                walks.features, pair[1].0
            );
            let [smaller, larger] = [error(walks, pair[0]), error(walks, pair[1])];
            grows.push(Case::of_difference(case, &larger, &smaller));
        }
    }

    [
        Claim::new(
            "a walk of four steps in an open loop ends nearer to its target than it began, in held-out rooms",
            "‖ΔP‖ minus the end error",
            nearer,
        ),
        Claim::new(
            "the end error of such walks grows with the motion",
            "end error of larger motions minus that of the next smaller ones",
            grows,
        ),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn end(size: f64, error: f64) -> End {
        End {
            size,
            error,
            meters: error,
            radians: 0.0,
        }
    }

    /// Oracle: by hand. Room a has walks of sizes 0.2 and 0.4, room b of 0.2 alone.
    #[test]
    fn walks_are_averaged_by_room_and_size() {
        let walks = Walks {
            features: "f".to_owned(),
            mode: Mode::OpenLoop,
            rooms: vec![
                vec![end(0.2, 0.05), end(0.2, 0.15), end(0.4, 0.3)],
                vec![end(0.2, 0.3)],
            ],
        };
        let records = walks.records();
        let [small, middle] = [&records[0], &records[1]];
        assert_eq!((small.rooms, small.pairs), (2, 3));
        assert!((small.error.mean - 0.2).abs() < 1e-12, "{small:?}");
        assert!((small.hit.mean - 0.25).abs() < 1e-12, "{small:?}");
        assert!((small.still_error - 0.2).abs() < 1e-12, "{small:?}");
        assert_eq!(small.still_hit, 0.0);
        assert_eq!((middle.rooms, middle.pairs, middle.most), (1, 1, Some(0.6)));
        assert_eq!(records.len(), 2, "no walk is larger");

        let [nearer, grows] = claims_of(&[walks]);
        // 0.1 in room a and −0.1 in room b.
        assert!(nearer.cases[0].mean.unwrap().mean.abs() < 1e-12);
        // Only room a has both sizes: 0.3 − 0.1.
        let first = grows.cases[0].mean.unwrap();
        assert_eq!(first.rooms, 1);
        assert!((first.mean - 0.2).abs() < 1e-12);
    }
}

//! What happens to robots: parts without a map or without images, kidnaps, wheels and inertial
//! sensors. Each scenario replays tracked frames of a room, beside simple baselines on the same
//! frames.

use serde::Serialize;

use super::mapless::MaplessDrift;
use super::player::{PlayedView, Player, Reader, Sensed, Sight};
use super::simulated_sensors::{depths, has_depths, inertial, wheels};
use super::tracking_scores::{VelocityErrors, is_wrong};
use crate::json;
use seese3_core::geometry::{Pose, PoseError, Twist, body_twist, exp};
use seese3_core::statistics::{median, root_mean_square};
use seese3_robot::tracking::{PoseWithCovariance, Status};

/// Lengths of the parts without a map, seconds.
pub const GAPS_S: [f64; 3] = [1.0, 2.0, 5.0];
/// Time between the starts of these parts, seconds.
const GAP_EVERY_S: f64 = 1.0;
/// Time over which the true velocity at the start of a part is measured, seconds.
const VELOCITY_S: f64 = 0.1;
/// Number of kidnaps per stream, and the frames before and after each.
const KIDNAPS: usize = 3;
const KIDNAP_FRAMES: usize = 45;
/// Smallest distance of a kidnap, meters.
const LEAST_KIDNAP_M: f64 = 0.3;

/// Results of all scenarios in one room.
#[derive(Debug, Clone, Serialize)]
pub struct Scenarios {
    /// Parts without a map, one per length.
    pub gaps: Vec<GapErrors>,
    /// Cameras that were carried to another place.
    pub kidnaps: Kidnaps,
    /// Parts without images, one per length.
    pub dark: Vec<DarkErrors>,
    /// Odometry without a map.
    pub mapless: MaplessDrift,
    /// Streams with simulated wheels.
    pub wheels: SensorErrors,
    /// Streams with a simulated inertial sensor.
    pub inertial: SensorErrors,
    /// Streams with simulated depths; `None` without keypoints.
    pub depths: Option<SensorErrors>,
}

/// Position errors of the map pose at the end of a part without images, meters. In JSON, medians.
#[derive(Debug, Clone, Default, Serialize)]
pub struct DarkErrors {
    /// Length of the part, seconds.
    pub seconds: f64,
    /// Without another sensor.
    #[serde(rename = "alone_m", serialize_with = "as_median")]
    pub alone: Vec<f64>,
    /// With simulated wheels.
    #[serde(rename = "wheels_m", serialize_with = "as_median")]
    pub wheels: Vec<f64>,
    /// With a simulated inertial sensor.
    #[serde(rename = "inertial_m", serialize_with = "as_median")]
    pub inertial: Vec<f64>,
    /// Of the last map pose before the part.
    #[serde(rename = "standing_still_m", serialize_with = "as_median")]
    pub standing_still: Vec<f64>,
    /// Squared Mahalanobis lengths of the errors with an inertial sensor.
    #[serde(rename = "inertial_coverage", serialize_with = "json::coverages")]
    pub inertial_surprises: Vec<f64>,
}

/// A simulation of the sensors of a stream, with a seed.
type Simulation = fn(&[PlayedView<'_>], u64) -> Vec<Sensed>;

/// Position errors at the end of a part without a map, meters.
#[derive(Debug, Clone, Default, Serialize)]
pub struct GapErrors {
    /// Length of the part, seconds.
    pub seconds: f64,
    /// Errors of the map pose; in JSON, their median.
    #[serde(rename = "fused_m", serialize_with = "as_median")]
    pub fused: Vec<f64>,
    /// The same with simulated depths.
    #[serde(rename = "depths_m", serialize_with = "as_median")]
    pub depths: Vec<f64>,
    /// Errors of the last map pose before the part.
    #[serde(rename = "standing_still_m", serialize_with = "as_median")]
    pub standing_still: Vec<f64>,
    /// Errors of that pose, moved with the true velocity at the start.
    #[serde(rename = "constant_velocity_m", serialize_with = "as_median")]
    pub constant_velocity: Vec<f64>,
    /// Squared Mahalanobis lengths of the errors of the map pose.
    #[serde(rename = "coverage", serialize_with = "json::coverages")]
    pub surprises: Vec<f64>,
}

/// Cameras that were carried to another place of the same room.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Kidnaps {
    /// Number of kidnaps.
    pub n: usize,
    /// Distances, meters.
    #[serde(rename = "distance_m", serialize_with = "as_median")]
    pub distances_m: Vec<f64>,
    /// Number of TRACKING frames after the kidnaps.
    pub tracking: usize,
    /// Wrong poses among the TRACKING frames.
    pub wrong: usize,
    /// Frames until TRACKING at the right place, of those that got there; in JSON, their median.
    #[serde(rename = "frames_to_recover", serialize_with = "as_median")]
    pub recovered_after: Vec<f64>,
}

/// Root-mean-square errors of streams with a simulated sensor.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SensorErrors {
    /// Position error of the map pose, with the sensor, meters.
    pub fused: f64,
    /// The same of the sensor alone, from the true first pose, if it measures poses.
    pub alone: Option<f64>,
    /// Fraction of TRACKING frames.
    pub tracking: f64,
    /// Velocity errors, with the sensor.
    pub velocity: VelocityErrors,
}

fn as_median<S: serde::Serializer>(values: &[f64], to: S) -> Result<S::Ok, S::Error> {
    let found = (!values.is_empty()).then(|| median(values));
    found.serialize(to)
}

impl Scenarios {
    /// Runs all scenarios on the streams of a room. `player` starts a stream with this pose.
    pub(super) fn of<'a>(
        streams: &[&[PlayedView<'a>]],
        player: &dyn Fn(Option<Pose>) -> Player<'a>,
    ) -> Self {
        let mut gaps = GAPS_S.map(|seconds| GapErrors {
            seconds,
            ..GapErrors::default()
        });
        let mut dark = GAPS_S.map(|seconds| DarkErrors {
            seconds,
            ..DarkErrors::default()
        });
        let mut kidnaps = Kidnaps::default();
        let depths = simulated_depths(streams, &player(None));

        for (views, depths) in streams.iter().zip(&depths) {
            add_dark(&mut dark, views, player);
            add_gaps(&mut gaps, views, player, depths);
            kidnaps.add(views, &|| player(None));
        }

        Self {
            gaps: gaps.to_vec(),
            kidnaps,
            dark: dark.to_vec(),
            mapless: MaplessDrift::of(streams, player, &depths),
            wheels: with_sensors(streams, player, &simulated(streams, wheels)),
            inertial: with_sensors(streams, player, &simulated(streams, inertial)),
            depths: has_depths(streams, &depths).then(|| with_sensors(streams, player, &depths)),
        }
    }

    /// The results of several rooms together.
    pub fn together<'a>(rooms: impl Iterator<Item = &'a Self> + Clone) -> Option<Self> {
        let first = rooms.clone().next()?;
        let mut together = first.clone();
        for room in rooms.clone().skip(1) {
            for (gap, other) in together.gaps.iter_mut().zip(&room.gaps) {
                gap.fused.extend(&other.fused);
                gap.depths.extend(&other.depths);
                gap.standing_still.extend(&other.standing_still);
                gap.constant_velocity.extend(&other.constant_velocity);
                gap.surprises.extend(&other.surprises);
            }
            for (dark, other) in together.dark.iter_mut().zip(&room.dark) {
                dark.alone.extend(&other.alone);
                dark.wheels.extend(&other.wheels);
                dark.inertial.extend(&other.inertial);
                dark.standing_still.extend(&other.standing_still);
                dark.inertial_surprises.extend(&other.inertial_surprises);
            }
            let kidnaps = &mut together.kidnaps;
            kidnaps.n += room.kidnaps.n;
            kidnaps.tracking += room.kidnaps.tracking;
            kidnaps.wrong += room.kidnaps.wrong;
            kidnaps.distances_m.extend(&room.kidnaps.distances_m);
            let recovered = &room.kidnaps.recovered_after;
            kidnaps.recovered_after.extend(recovered);
        }

        let count = rooms.clone().count() as f64;
        let mean = |errors: &[SensorErrors]| {
            let of =
                |value: fn(&SensorErrors) -> f64| errors.iter().map(value).sum::<f64>() / count;
            SensorErrors {
                fused: of(|errors| errors.fused),
                alone: errors[0]
                    .alone
                    .map(|_| of(|errors| errors.alone.unwrap_or(0.0))),
                tracking: of(|errors| errors.tracking),
                velocity: VelocityErrors::mean(errors.iter().map(|errors| &errors.velocity)),
            }
        };
        together.mapless = MaplessDrift::mean(rooms.clone().map(|room| &room.mapless));

        let wheels: Vec<SensorErrors> = rooms.clone().map(|room| room.wheels).collect();
        let inertial: Vec<SensorErrors> = rooms.clone().map(|room| room.inertial).collect();
        let depths: Option<Vec<SensorErrors>> = rooms.map(|room| room.depths).collect();

        together.wheels = mean(&wheels);
        together.inertial = mean(&inertial);
        together.depths = depths.map(|depths| mean(&depths));
        Some(together)
    }
}

/// What a simulated sensor says at each view of some streams.
fn simulated(streams: &[&[PlayedView<'_>]], simulation: Simulation) -> Vec<Vec<Sensed>> {
    let numbered = streams.iter().enumerate();
    numbered
        .map(|(number, views)| simulation(views, number as u64))
        .collect()
}

/// Simulated depths; empty for streams without keypoints.
fn simulated_depths(streams: &[&[PlayedView<'_>]], player: &Player<'_>) -> Vec<Vec<Sensed>> {
    let numbered = streams.iter().enumerate();
    numbered
        .map(|(number, views)| match &player.reader {
            Reader::Keypoints { map, .. } => depths(views, &map.map().camera, number as u64),
            Reader::Retrieval { .. } => Vec::new(),
        })
        .collect()
}

fn first_pose(views: &[PlayedView<'_>]) -> Option<Pose> {
    views.first().map(|view| view.truth)
}

fn seconds_between(from: &PlayedView<'_>, to: &PlayedView<'_>) -> f64 {
    (to.time_ns - from.time_ns) as f64 * 1e-9
}

/// The end of a part without a map or without images.
struct PartEnd<'a, 'v> {
    /// Which of [`GAPS_S`] it lasts.
    length: usize,
    /// Row of the last view before the part, and the map pose there.
    row: usize,
    start: PoseWithCovariance,
    view: &'a PlayedView<'v>,
    /// The map pose; without one, the last that is known.
    fused: PoseWithCovariance,
}

impl PartEnd<'_, '_> {
    fn error_m(&self, pose: &Pose) -> f64 {
        PoseError::between(pose, &self.view.truth).translation_m
    }
}

/// Plays a stream, and from each second on a part without a map or without images.
fn part_ends<'a, 'v>(
    views: &'a [PlayedView<'v>],
    mut player: Player<'_>,
    sight: Sight,
    sensed: &[Sensed],
) -> Vec<PartEnd<'a, 'v>> {
    let mut found = Vec::new();
    let mut next_s = GAP_EVERY_S;
    for (row, view) in views.iter().enumerate() {
        let update = player.step(view, Sight::Mapped, &sensed[row]);
        let seconds = seconds_between(&views[0], view);
        let is_due = seconds >= next_s;
        let pose = update.and_then(|update| update.map_pose);
        let Some(start) = pose.filter(|_| is_due) else {
            continue;
        };

        next_s = (seconds / GAP_EVERY_S).floor() * GAP_EVERY_S + GAP_EVERY_S;
        let mut branch = player.clone();
        let mut lengths = GAPS_S.into_iter().enumerate().peekable();
        for (later, sensed) in views.iter().zip(sensed).skip(row + 1) {
            let update = branch.step(later, sight, sensed);
            let fused = update.and_then(|update| update.map_pose);
            let seconds = seconds_between(view, later);
            while let Some((length, _)) = lengths.next_if(|(_, length_s)| seconds >= *length_s) {
                found.push(PartEnd {
                    length,
                    row,
                    start,
                    view: later,
                    fused: fused.unwrap_or(start),
                });
            }
            if lengths.peek().is_none() {
                break;
            }
        }
    }
    found
}

/// Adds the errors at the ends of parts in which no view is matched with the map: by images alone,
/// and with `depths` if there are any.
fn add_gaps<'a>(
    gaps: &mut [GapErrors],
    views: &[PlayedView<'a>],
    player: &dyn Fn(Option<Pose>) -> Player<'a>,
    depths: &[Sensed],
) {
    let none = vec![Sensed::default(); views.len()];
    for end in part_ends(views, player(first_pose(views)), Sight::Unmapped, &none) {
        let start = &views[end.row];
        let before = views[..end.row].iter().rev();
        let mut before = before.filter(|other| seconds_between(other, start) >= VELOCITY_S);
        let velocity = before.next().map_or(Twist::default(), |other| {
            let seconds = seconds_between(other, start);
            body_twist(&other.truth, &start.truth).scaled(seconds.recip())
        });
        let moved = exp(&velocity.scaled(seconds_between(start, end.view)));

        let gap = &mut gaps[end.length];
        gap.fused.push(end.error_m(&end.fused.pose));
        gap.standing_still.push(end.error_m(&end.start.pose));
        let by_velocity = end.start.pose * moved;
        gap.constant_velocity.push(end.error_m(&by_velocity));
        gap.surprises
            .extend(end.fused.squared_error(&end.view.truth));
    }

    if depths.len() == views.len() {
        for end in part_ends(views, player(first_pose(views)), Sight::Unmapped, depths) {
            gaps[end.length].depths.push(end.error_m(&end.fused.pose));
        }
    }
}

/// Adds the errors at the ends of parts without images: without another sensor, and with each.
fn add_dark<'a>(
    dark: &mut [DarkErrors],
    views: &[PlayedView<'a>],
    player: &dyn Fn(Option<Pose>) -> Player<'a>,
) {
    let ends_with =
        |sensed: Vec<Sensed>| part_ends(views, player(first_pose(views)), Sight::Dark, &sensed);
    for end in ends_with(vec![Sensed::default(); views.len()]) {
        let errors = &mut dark[end.length];
        errors.alone.push(end.error_m(&end.fused.pose));
        errors.standing_still.push(end.error_m(&end.start.pose));
    }
    for end in ends_with(wheels(views, 0)) {
        dark[end.length].wheels.push(end.error_m(&end.fused.pose));
    }
    for end in ends_with(inertial(views, 0)) {
        let errors = &mut dark[end.length];
        errors.inertial.push(end.error_m(&end.fused.pose));
        let surprise = end.fused.squared_error(&end.view.truth);
        errors.inertial_surprises.extend(surprise);
    }
}

impl Kidnaps {
    /// Plays some frames, then frames of another part of the same stream.
    fn add<'a>(&mut self, views: &[PlayedView<'a>], player: &dyn Fn() -> Player<'a>) {
        let count = views.len();
        if count < 4 * KIDNAP_FRAMES {
            return;
        }
        for number in 0..KIDNAPS {
            let from = number * (count - KIDNAP_FRAMES) / KIDNAPS;
            let to = (from + count / 2) % (count - KIDNAP_FRAMES);
            let before = &views[from..from + KIDNAP_FRAMES];
            let after = &views[to..to + KIDNAP_FRAMES];
            let last = &before[KIDNAP_FRAMES - 1];

            let distance = PoseError::between(&last.truth, &after[0].truth).translation_m;
            if distance < LEAST_KIDNAP_M {
                continue;
            }

            let mut player = player();
            for view in before {
                player.step(view, Sight::Mapped, &Sensed::default());
            }

            self.n += 1;
            self.distances_m.push(distance);

            let period_ns = (last.time_ns - before[0].time_ns) / (KIDNAP_FRAMES as i64 - 1);
            let shift_ns = last.time_ns + period_ns - after[0].time_ns;
            let mut recovered_after = None;

            for (place, view) in after.iter().enumerate() {
                let view = PlayedView {
                    time_ns: view.time_ns + shift_ns,
                    sequence: last.sequence + 1 + place as u64,
                    ..*view
                };
                let Some(update) = player.step(&view, Sight::Mapped, &Sensed::default()) else {
                    continue;
                };

                let tracked = update
                    .map_pose
                    .filter(|_| update.status == Status::Tracking);
                if let Some(pose) = tracked {
                    let is_wrong = is_wrong(&pose.pose, &view.truth);
                    self.tracking += 1;
                    self.wrong += usize::from(is_wrong);
                    if !is_wrong {
                        recovered_after.get_or_insert(place + 1);
                    }
                }
            }

            let recovered = recovered_after.map(|frames| frames as f64);
            self.recovered_after.extend(recovered);
        }
    }
}

/// Streams with simulated sensors.
fn with_sensors<'a>(
    streams: &[&[PlayedView<'a>]],
    player: &dyn Fn(Option<Pose>) -> Player<'a>,
    sensed: &[Vec<Sensed>],
) -> SensorErrors {
    let (mut fused, mut alone) = (Vec::new(), Vec::new());
    let mut velocities = Vec::new();
    let mut tracking = 0;
    let mut count = 0;
    for (views, sensed) in streams.iter().zip(sensed) {
        let Some(first) = first_pose(views) else {
            continue;
        };
        let mut player = player(Some(first));
        let mut last: Option<&PlayedView<'a>> = None;
        for (view, sensed) in views.iter().zip(sensed) {
            count += 1;
            let before = last.replace(view);
            let error_m = |pose: &Pose| PoseError::between(pose, &view.truth).translation_m;
            alone.extend(
                sensed
                    .measured
                    .map(|measured| error_m(&(first * measured.pose))),
            );

            let update = player.step(view, Sight::Mapped, sensed);
            let Some(update) = update else { continue };
            tracking += usize::from(update.status == Status::Tracking);
            fused.extend(update.map_pose.map(|pose| error_m(&pose.pose)));

            if let (Some(before), Some(reported)) = (before, update.velocity) {
                let seconds = (view.time_ns - before.time_ns) as f64 * 1e-9;
                let motion = body_twist(&before.truth, &view.truth);
                velocities.push((reported.linear, motion.linear / seconds));
            }
        }
    }

    SensorErrors {
        fused: root_mean_square(&fused),
        alone: (!alone.is_empty()).then(|| root_mean_square(&alone)),
        tracking: tracking as f64 / count as f64,
        velocity: VelocityErrors::of(&velocities),
    }
}

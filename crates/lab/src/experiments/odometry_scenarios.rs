//! What happens to robots: parts without a map or without images, kidnaps, wheels and inertial
//! sensors. Each scenario replays tracked frames of a room, beside simple baselines on the same frames.

use serde::Serialize;

use super::mapless::MaplessDrift;
use super::player::{PlayedView, Player, Sensed, Sight};
use super::simulated_sensors::{inertial, wheels};
use super::tracking_scores::is_wrong;
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
    /// Number of TRACKING frames after the kidnaps, and of wrong poses among them.
    pub tracking: usize,
    /// Wrong poses among the TRACKING frames.
    pub wrong: usize,
    /// Frames until TRACKING at the right place, of those that got there; in JSON, their median.
    #[serde(rename = "frames_to_recover", serialize_with = "as_median")]
    pub recovered_after: Vec<f64>,
}

/// Root-mean-square position errors of streams with a simulated sensor, meters.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SensorErrors {
    /// The map pose, with the sensor.
    pub fused: f64,
    /// The sensor alone, from the true first pose, if it measures poses.
    pub alone: Option<f64>,
    /// Fraction of TRACKING frames.
    pub tracking: f64,
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
        for views in streams {
            add_dark(&mut dark, views, player);
            add_gaps(&mut gaps, views, player(first_pose(views)));
            kidnaps.add(views, &|| player(None));
        }
        Self {
            gaps: gaps.to_vec(),
            kidnaps,
            dark: dark.to_vec(),
            mapless: MaplessDrift::of(streams, player),
            wheels: with_sensors(streams, player, wheels),
            inertial: with_sensors(streams, player, inertial),
        }
    }

    /// The results of several rooms together.
    pub fn together<'a>(rooms: impl Iterator<Item = &'a Self> + Clone) -> Option<Self> {
        let first = rooms.clone().next()?;
        let mut together = first.clone();
        for room in rooms.clone().skip(1) {
            for (gap, other) in together.gaps.iter_mut().zip(&room.gaps) {
                gap.fused.extend(&other.fused);
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
            }
        };
        together.mapless = MaplessDrift::mean(rooms.clone().map(|room| &room.mapless));
        let wheels: Vec<SensorErrors> = rooms.clone().map(|room| room.wheels).collect();
        let inertial: Vec<SensorErrors> = rooms.map(|room| room.inertial).collect();
        together.wheels = mean(&wheels);
        together.inertial = mean(&inertial);
        Some(together)
    }
}

fn first_pose(views: &[PlayedView<'_>]) -> Option<Pose> {
    views.first().map(|view| view.truth)
}

fn seconds_between(from: &PlayedView<'_>, to: &PlayedView<'_>) -> f64 {
    (to.time_ns - from.time_ns) as f64 * 1e-9
}

/// Adds the errors at the ends of parts in which no view is matched with the map.
fn add_gaps(gaps: &mut [GapErrors], views: &[PlayedView<'_>], mut player: Player<'_>) {
    let mut next_s = GAP_EVERY_S;
    for (row, view) in views.iter().enumerate() {
        let update = player.step(view, Sight::Mapped, &Sensed::default());
        let is_due = seconds_between(&views[0], view) >= next_s;
        let pose = update.and_then(|update| update.map_pose);
        let Some(pose) = pose.filter(|_| is_due) else {
            continue;
        };

        next_s += GAP_EVERY_S;
        let before = views[..row].iter().rev();
        let mut before = before.filter(|other| seconds_between(other, view) >= VELOCITY_S);
        let velocity = before.next().map_or(Twist::default(), |other| {
            let seconds = seconds_between(other, view);
            body_twist(&other.truth, &view.truth).scaled(seconds.recip())
        });

        let mut branch = player.clone();
        let mut ends = gaps.iter_mut().peekable();
        for later in &views[row + 1..] {
            let update = branch.step(later, Sight::Unmapped, &Sensed::default());
            let seconds = seconds_between(view, later);
            let Some(gap) = ends.next_if(|gap| seconds >= gap.seconds) else {
                if ends.peek().is_none() {
                    break;
                }
                continue;
            };

            let error_m = |pose: &Pose| PoseError::between(pose, &later.truth).translation_m;
            gap.standing_still.push(error_m(&pose.pose));
            let moved = pose.pose * exp(&velocity.scaled(seconds));
            gap.constant_velocity.push(error_m(&moved));
            // Without a pose, the last one is the best that is known.
            let fused = update.and_then(|update| update.map_pose);
            let fused: PoseWithCovariance = fused.unwrap_or(pose);
            gap.fused.push(error_m(&fused.pose));
            gap.surprises.extend(fused.squared_error(&later.truth));
        }
    }
}

/// Adds the errors at the ends of parts without images: without another sensor, and with each.
fn add_dark<'a>(
    dark: &mut [DarkErrors],
    views: &[PlayedView<'a>],
    player: &dyn Fn(Option<Pose>) -> Player<'a>,
) {
    let none: Simulation = |views, _| vec![Sensed::default(); views.len()];
    for (number, simulated) in [none, wheels, inertial].into_iter().enumerate() {
        let sensed = simulated(views, 0);
        let mut player = player(first_pose(views));
        let mut next_s = GAP_EVERY_S;
        for (row, view) in views.iter().enumerate() {
            let update = player.step(view, Sight::Mapped, &sensed[row]);
            let is_due = seconds_between(&views[0], view) >= next_s;
            let pose = update.and_then(|update| update.map_pose);
            let Some(pose) = pose.filter(|_| is_due) else {
                continue;
            };

            next_s += GAP_EVERY_S;
            let mut branch = player.clone();
            let mut ends = dark.iter_mut().peekable();
            for (later, sensed) in views.iter().zip(&sensed).skip(row + 1) {
                let update = branch.step(later, Sight::Dark, sensed);
                let seconds = seconds_between(view, later);
                let Some(end) = ends.next_if(|end| seconds >= end.seconds) else {
                    continue;
                };
                let error_m = |pose: &Pose| PoseError::between(pose, &later.truth).translation_m;
                let fused = update.and_then(|update| update.map_pose).unwrap_or(pose);
                let of_sensor = [&mut end.alone, &mut end.wheels, &mut end.inertial];
                of_sensor[number].push(error_m(&fused.pose));
                if number == 0 {
                    end.standing_still.push(error_m(&pose.pose));
                }
                if number == 2 {
                    let surprise = fused.squared_error(&later.truth);
                    end.inertial_surprises.extend(surprise);
                }
                if ends.peek().is_none() {
                    break;
                }
            }
        }
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
    simulated: Simulation,
) -> SensorErrors {
    let (mut fused, mut alone) = (Vec::new(), Vec::new());
    let mut tracking = 0;
    let mut count = 0;
    for (number, views) in streams.iter().enumerate() {
        let Some(first) = first_pose(views) else {
            continue;
        };
        let sensed = simulated(views, number as u64);
        let mut player = player(Some(first));
        for (view, sensed) in views.iter().zip(&sensed) {
            count += 1;
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
        }
    }
    SensorErrors {
        fused: root_mean_square(&fused),
        alone: (!alone.is_empty()).then(|| root_mean_square(&alone)),
        tracking: tracking as f64 / count as f64,
    }
}

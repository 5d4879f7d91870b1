//! Walks: a motion in several steps, as an image strip and as a plan view.

use std::sync::Arc;

use serde::Serialize;
use strum::{Display, IntoStaticStr, VariantArray};

use seese3_core::adapter::{Adapter, Reading};
use seese3_core::cancel::Cancellation;
use seese3_core::geometry::{PoseError, Twist, body_twist, exp};
use seese3_core::navigation::{
    FitOn, IndexKind, Limits, Method, Mode, Navigator, Query, RequestedMotion, RetrievalMetric,
    Source, SourceAt, StepKind,
};
use seese3_core::room::FrameId;
use seese3_core::splits::{Pair, Split};
use seese3_core::training::RoomData;

use super::super::{Error, Reproduction};
use super::plane::Plane;
use super::strip::strip;
use crate::report::{Figure, PathPlot, Section};

/// Number of equal steps of a walk, as in the paper.
const STEPS: u32 = 4;
/// Stride of a walk, frames: longer than any training pair of preset steady.
const FAR: u32 = 50;

/// Length of a walk, as a quantile of the translations of a room's pairs.
#[derive(Debug, Clone, Copy, Display, IntoStaticStr, VariantArray)]
#[strum(serialize_all = "kebab-case")]
pub enum Length {
    Short,
    Middle,
    Long,
}

impl Length {
    fn share(self) -> f64 {
        match self {
            Self::Short => 0.1,
            Self::Middle => 0.5,
            Self::Long => 0.9,
        }
    }
}

/// JSON record of a walk.
#[derive(Debug, Serialize)]
pub struct WalkRecord {
    room: String,
    /// The length class of the pair.
    length: &'static str,
    frames: Vec<u32>,
    meters_off: f64,
    degrees_off: f64,
    /// Distance from source to target, the error of not moving; the angle follows.
    meters: f64,
    degrees: f64,
}

/// Walks a room's pair of the given length, and adds its strip and its plan view to the section.
pub fn add(
    section: &mut Section,
    given: &Reproduction<'_>,
    data: &RoomData<'_>,
    adapter: &Arc<Adapter>,
    length: Length,
) -> Result<WalkRecord, Error> {
    let room = Arc::new(data.room.clone());
    let navigator = Navigator::new(room, data.features, adapter.clone(), IndexKind::Exact)?;
    let pair = chosen(data, length)?;
    let frames = walked(&navigator, pair)?;

    let poses = data.room.poses();
    let between = |a: u32, b: u32| PoseError::between(&poses[a as usize], &poses[b as usize]);
    let last = frames[frames.len() - 1];
    let off = between(last, pair.target.0);
    let still = between(pair.source.0, pair.target.0);

    let shown: Vec<u32> = frames.iter().copied().chain([pair.target.0]).collect();
    let name = format!("walk-{}-{length}", data.room.id());
    let caption = format!(
        "Room {}, a {} motion ({:.2} m and {:.0}°): source, {STEPS} steps in an open loop, target; the last step is {:.2} m \
         and {:.0}° from it",
        data.room.id(),
        length,
        still.translation_m,
        still.rotation_rad.to_degrees(),
        off.translation_m,
        off.rotation_rad.to_degrees()
    );
    section.picture(
        format!("{name}.png"),
        strip(given.images, data, &shown)?,
        caption,
    );

    let plan = Figure::from(&plan(data, pair, &frames, length)).svg()?;
    section.picture(
        format!("{name}.svg"),
        plan,
        "The same in the plane of the path",
    );

    Ok(WalkRecord {
        room: data.room.id().to_string(),
        length: length.into(),
        frames: shown,
        meters_off: off.translation_m,
        degrees_off: off.rotation_rad.to_degrees(),
        meters: still.translation_m,
        degrees: still.rotation_rad.to_degrees(),
    })
}

/// The pair at the length's quantile of translation, among all pairs [`FAR`] frames apart.
fn chosen(data: &RoomData<'_>, length: Length) -> Result<Pair, Error> {
    let mut pairs = Split::Whole.test_pairs(data.room.timeline(), FAR)?;
    let poses = data.room.poses();
    let meters = |pair: &Pair| {
        let [source, target] = [pair.source, pair.target].map(|frame| &poses[frame.row()]);
        PoseError::between(source, target).translation_m
    };
    pairs.sort_by(|a, b| meters(a).total_cmp(&meters(b)));

    let place = (length.share() * (pairs.len() - 1) as f64).round() as usize;
    Ok(pairs[place])
}

/// The source frame and the retrieved frame of each step.
fn walked(navigator: &Navigator, pair: Pair) -> Result<Vec<u32>, Error> {
    let query = Query {
        source: SourceAt {
            source: Source::Frame(pair.source),
            pose: None,
        },
        motion: RequestedMotion::TargetFrame(pair.target),
        steps: STEPS,
        mode: Mode::OpenLoop,
        method: Method::Latent(
            StepKind::InversePoincare(Reading::Homogeneous),
            RetrievalMetric::Full,
        ),
        // Used only by refits; inverse Poincaré ignores this field.
        fit_on: FitOn {
            split: Split::Time,
            stride: FAR,
        },
        top_k: 1,
        exclude_source: None,
    };

    let answer = navigator.answer(&query, Limits::default(), &Cancellation::default())?;
    let steps = answer
        .steps
        .iter()
        .map(|step| step.frames[0].neighbor.frame.0);
    Ok([pair.source.0].into_iter().chain(steps).collect())
}

/// The walk in the principal plane of the recording.
fn plan(data: &RoomData<'_>, pair: Pair, frames: &[u32], length: Length) -> PathPlot {
    let plane = Plane::of(data.room.poses());
    let poses = data.room.poses();
    let place = |frame: FrameId| plane.place(&poses[frame.row()]);

    let source = &poses[pair.source.row()];
    let motion = body_twist(source, &poses[pair.target.row()]);
    let requested = (1..=STEPS).map(|step| {
        let share = f64::from(step) / f64::from(STEPS);
        let part = Twist {
            linear: motion.linear * share,
            angular: motion.angular * share,
        };
        plane.place(&(source * exp(&part)))
    });

    PathPlot {
        title: format!("{}: a {} motion, {STEPS} steps", data.room.id(), length),
        map: poses
            .iter()
            .map(|pose| {
                let [x, y, _] = plane.place(pose);
                [x, y]
            })
            .collect(),
        source: place(pair.source),
        target: place(pair.target),
        requested: requested.collect(),
        retrieved: frames[1..]
            .iter()
            .map(|&frame| place(FrameId(frame)))
            .collect(),
    }
}

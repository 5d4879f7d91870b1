//! The paper's alternatives to the adapter: other models from two features to a motion (Sec. A.5).
//!
//! - A: M = ψ(z₂) ψ(z₁)⁻¹ with ψ: d → SE(3), trained on the motion in the world frame.
//! - B: the same ψ, trained on absolute poses.
//! - C: M = head(φ(z₂) − φ(z₁)), a pose, trained on the motion in the body frame.
//! - D: W φ(z₂ − z₁), trained on z-scored twists.
//!
//! All are scored by the twist in the body frame of the first camera. The service does not
//! use them.

mod difference_input;
mod geodesic_head;
mod pose_head;
mod world_pose;

pub use difference_input::DifferenceInput;
pub use geodesic_head::GeodesicHead;
pub use world_pose::{AbsolutePose, UnanchoredMotion, WorldPose};

use nalgebra::Vector6;
use ndarray::ArrayView2;
use strum::{IntoStaticStr, VariantArray};

use seese3_core::adapter::building_blocks::{Seeded, fit};
use seese3_core::adapter::{EpochProgress, Objective, Samples, TargetScale, TrainConfig, Widths};
use seese3_core::cancel::Cancellation;
use seese3_core::geometry::{Pose, Twist, log};
use seese3_core::motion_scores::ReadMotions;
use seese3_core::splits::Pair;
use seese3_core::training::{
    self, RoomData, TrainingPlan, check_rooms, motions, predictions, test_pairs,
};

/// A model that predicts a motion from two features.
#[derive(Debug, Clone, Copy, PartialEq, Eq, IntoStaticStr, VariantArray)]
#[strum(serialize_all = "kebab-case")]
pub enum Formulation {
    /// The adapter: W(φ(z₂) − φ(z₁)).
    Poincare,
    /// A: ψ(z₂) ψ(z₁)⁻¹, trained on motions in the world frame.
    #[strum(serialize = "a-unanchored")]
    Unanchored,
    /// B: the same ψ, trained on absolute poses.
    #[strum(serialize = "b-absolute")]
    Absolute,
    /// C: a pose head on φ(z₂) − φ(z₁).
    #[strum(serialize = "c-se3-mlp")]
    GeodesicHead,
    /// D: W φ(z₂ − z₁).
    #[strum(serialize = "d-difference-input")]
    DifferenceInput,
}

/// Trains one formulation on all rooms together and predicts the motions of each room's test pairs.
///
/// # Errors
/// As [`training::train_adapter`]; [`training::Error::NotPlain`] for a setting that only the
/// adapter supports.
///
/// Source: SeeSE3, Sec. A.5.
pub fn train_formulation(
    formulation: Formulation,
    room_data: &[RoomData<'_>],
    plan: &TrainingPlan,
    progress: &mut dyn FnMut(EpochProgress),
) -> Result<Vec<ReadMotions>, training::Error> {
    if formulation == Formulation::Poincare {
        // Settings that only the adapter supports would favor it in the comparison, so the other
        // formulations reject them below.
        return read_by_adapter(room_data, plan, progress).map(|(read, _)| read);
    }

    plan.check()?;
    check_rooms(room_data)?;
    let plain = TrainConfig::default();

    let TrainConfig {
        standardize,
        charts,
        loss,
        ..
    } = plan.config;

    if (standardize, charts, loss) != (plain.standardize, plain.charts, plain.loss) {
        return Err(training::Error::NotPlain);
    }

    let tests = test_pairs(room_data, plan)?;
    let samples = training::samples(room_data, plan)?;

    let TrainConfig {
        hidden,
        latent,
        seed,
        ..
    } = plan.config;
    let widths = Widths {
        feature: samples.feature_dim(),
        hidden,
        latent,
    };

    // One seeded stream draws the initial weights and then the order of the pairs, as PyTorch does
    // after `torch.manual_seed`.
    let mut random = Seeded::new(seed);
    let config = &plan.config_for(samples.pair_count());

    let mut run = Run {
        room_data,
        plan,
        tests: &tests,
        samples: &samples,
        config,
    };

    // The formulations differ only in their network and in how its output becomes a motion.
    Ok(match formulation {
        Formulation::Unanchored => {
            let start = UnanchoredMotion(WorldPose::random(widths, &mut random));
            run.read(start, &mut random, progress, |network, ends| {
                network.0.motion(ends)
            })?
        }
        Formulation::Absolute => {
            let start = AbsolutePose(WorldPose::random(widths, &mut random));
            run.read(start, &mut random, progress, |network, ends| {
                network.0.motion(ends)
            })?
        }
        Formulation::GeodesicHead => {
            let start = GeodesicHead::random(widths, &mut random);
            run.read(start, &mut random, progress, |network, ends| {
                network.motions(ends.features)
            })?
        }

        // The adapter has already returned above; it is listed only to complete the match.
        Formulation::Poincare | Formulation::DifferenceInput => {
            let start = DifferenceInput::random(widths, &mut random);
            let scale = samples.scale();

            run.read(start, &mut random, progress, |network, ends| {
                network.motions(ends.features, scale)
            })?
        }
    })
}

/// Trains an adapter on all rooms together. Returns the predicted motions of each room's test pairs
/// and the number of optimizer steps.
///
/// # Errors
/// As [`training::train_adapter`].
pub fn read_by_adapter(
    room_data: &[RoomData<'_>],
    plan: &TrainingPlan,
    progress: &mut dyn FnMut(EpochProgress),
) -> Result<(Vec<ReadMotions>, u64), training::Error> {
    let (adapter, record) = training::train_adapter(room_data, plan, progress)?;

    let read = |(data, pairs): (&RoomData<'_>, &Vec<Pair>)| {
        let truth = motions(data.room.poses(), pairs);
        let read = predictions(&adapter, data.features.rows(), pairs)?;
        Ok(ReadMotions::new(truth, read, &mean_motion(data, plan)?))
    };
    let tests = test_pairs(room_data, plan)?;
    let read = room_data.iter().zip(&tests).map(read);

    Ok((
        read.collect::<Result<_, training::Error>>()?,
        record.optimizer_steps(),
    ))
}

/// The mean motion of a room's training pairs at the test stride. An adapter's own μ can differ: it
/// may come from other strides, and is zero for an adapter trained through zero.
fn mean_motion(data: &RoomData<'_>, plan: &TrainingPlan) -> Result<Vector6<f64>, training::Error> {
    let training = plan.split.train_pairs(data.room.timeline(), plan.stride)?;
    Ok(TargetScale::of(&motions(data.room.poses(), &training)).mean)
}

/// Inputs of a formulation: the two ends of each pair.
pub struct Ends<'a> {
    /// Features of the sources and of the targets, each (n, d).
    pub features: [ArrayView2<'a, f32>; 2],
    /// `world_from_camera` of the sources.
    pub sources: &'a [Pose],
}

struct Run<'a> {
    room_data: &'a [RoomData<'a>],
    plan: &'a TrainingPlan,
    tests: &'a [Vec<Pair>],
    samples: &'a Samples<f32>,
    config: &'a TrainConfig,
}

impl Run<'_> {
    fn read<N: Objective<f32, Data = Samples<f32>>>(
        &mut self,
        start: N,
        random: &mut Seeded,
        progress: &mut dyn FnMut(EpochProgress),
        predict: impl Fn(&N, Ends<'_>) -> Vec<Twist>,
    ) -> Result<Vec<ReadMotions>, training::Error> {
        let network = fit(
            self.samples,
            start,
            self.config,
            random,
            &Cancellation::default(),
            progress,
        )?;
        let read = |(data, pairs): (&RoomData<'_>, &Vec<Pair>)| {
            let rows = |end: fn(&Pair) -> usize| {
                let rows: Vec<usize> = pairs.iter().map(end).collect();
                data.features.rows().select(ndarray::Axis(0), &rows)
            };
            let sources = rows(|pair| pair.source.row());

            let targets = rows(|pair| pair.target.row());

            let poses: Vec<Pose> = pairs
                .iter()
                .map(|pair| data.room.poses()[pair.source.row()])
                .collect();
            let ends = Ends {
                features: [sources.view(), targets.view()],
                sources: &poses,
            };

            let truth = motions(data.room.poses(), pairs);
            let mean = mean_motion(data, self.plan)?;
            Ok(ReadMotions::new(truth, predict(&network, ends), &mean))
        };

        self.room_data.iter().zip(self.tests).map(read).collect()
    }
}

/// Converts a motion M in the world frame, P₂ = M P₁, to a twist in the body frame of the first
/// camera: log(P₁⁻¹ M P₁).
fn body_motion(world: &Pose, source: &Pose) -> Twist {
    log(&(source.inv_mul(world) * source))
}

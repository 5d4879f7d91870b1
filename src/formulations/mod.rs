//! The paper's alternatives to the adapter: other ways from two features to a motion (sec. 2.5).
//!
//! - A: M = ψ(z₂) ψ(z₁)⁻¹ with ψ: d → SE(3), trained on the motion in the world frame.
//! - B: the same ψ, trained on absolute poses.
//! - C: M = head(φ(z₂) − φ(z₁)), a pose, trained on the motion in the body frame.
//! - D: W φ(z₂ − z₁), trained on z-scored twists.
//!
//! All are scored by the twist in the body frame of the first camera. They are compared, not
//! served.

mod difference_input;
mod geodesic_head;
mod pose_head;
mod world_pose;

pub use difference_input::DifferenceInput;
pub use geodesic_head::GeodesicHead;
pub use world_pose::{AbsolutePose, UnanchoredMotion, WorldPose};

use ndarray::ArrayView2;

use crate::adapter::{EpochProgress, Objective, Samples, Seeded, TrainConfig, Widths, fit};
use crate::geometry::{Pose, Twist, log};
use crate::pairs::Pair;
use crate::scores::MotionScores;
use crate::training::{self, Lesson, Recipe, check_lessons, motions, test_pairs};

/// A way from two features to a motion.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Formulation {
    /// The adapter: W(φ(z₂) − φ(z₁)).
    Poincare,
    /// A.
    Unanchored,
    /// B.
    Absolute,
    /// C.
    GeodesicHead,
    /// D.
    DifferenceInput,
}

impl Formulation {
    /// The adapter, then the paper's four.
    pub const ALL: [Self; 5] = [
        Self::Poincare,
        Self::Unanchored,
        Self::Absolute,
        Self::GeodesicHead,
        Self::DifferenceInput,
    ];

    /// Its name in tables and on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Poincare => "poincare",
            Self::Unanchored => "a-unanchored",
            Self::Absolute => "b-absolute",
            Self::GeodesicHead => "c-se3-mlp",
            Self::DifferenceInput => "d-difference-input",
        }
    }
}

/// Trains a formulation on rooms together and scores it on each room's test pairs.
///
/// # Errors
/// As [`training::learn`].
///
/// Source: SeeSE3, sec. 2.5.
pub fn learn(
    formulation: Formulation,
    lessons: &[Lesson<'_>],
    recipe: &Recipe,
    progress: &mut dyn FnMut(EpochProgress),
) -> Result<Vec<MotionScores>, training::Error> {
    if formulation == Formulation::Poincare {
        // Under what only the adapter knows, it would not be compared but favoured: the others
        // refuse it.
        return Ok(training::learn(lessons, recipe, progress)?.1.room_tests);
    }

    recipe.check()?;
    check_lessons(lessons)?;
    let plain = TrainConfig::default();

    let TrainConfig {
        standardise,
        charts,
        loss,
        ..
    } = recipe.config;

    if (standardise, charts, loss) != (plain.standardise, plain.charts, plain.loss) {
        return Err(training::Error::NotPlain);
    }

    let tests = test_pairs(lessons, recipe)?;
    let samples = training::samples(lessons, recipe)?;

    let TrainConfig {
        hidden,
        latent,
        seed,
        ..
    } = recipe.config;
    let widths = Widths {
        feature: samples.feature_dim(),
        hidden,
        latent,
    };

    let mut random = Seeded::new(seed);
    let config = &recipe.config;

    let mut run = Run {
        lessons,
        tests: &tests,
        samples: &samples,
        config,
    };

    Ok(match formulation {
        Formulation::Unanchored => {
            let start = UnanchoredMotion(WorldPose::random(widths, &mut random));
            run.scores(start, &mut random, progress, |network, ends| {
                network.0.motion(ends)
            })?
        }
        Formulation::Absolute => {
            let start = AbsolutePose(WorldPose::random(widths, &mut random));
            run.scores(start, &mut random, progress, |network, ends| {
                network.0.motion(ends)
            })?
        }
        Formulation::GeodesicHead => {
            let start = GeodesicHead::random(widths, &mut random);
            run.scores(start, &mut random, progress, |network, ends| {
                network.motions(ends.features)
            })?
        }
        Formulation::Poincare | Formulation::DifferenceInput => {
            let start = DifferenceInput::random(widths, &mut random);
            let scale = samples.scale();

            run.scores(start, &mut random, progress, |network, ends| {
                network.motions(ends.features, scale)
            })?
        }
    })
}

/// The ends of pairs: what was seen there, and from where.
pub struct Ends<'a> {
    /// Of the sources and of the targets, each (n, d).
    pub features: [ArrayView2<'a, f32>; 2],
    /// `world_from_camera` of the sources.
    pub sources: &'a [Pose],
}

struct Run<'a> {
    lessons: &'a [Lesson<'a>],
    tests: &'a [Vec<Pair>],
    samples: &'a Samples<f32>,
    config: &'a TrainConfig,
}

impl Run<'_> {
    fn scores<N: Objective<f32, Data = Samples<f32>>>(
        &mut self,
        start: N,
        random: &mut Seeded,
        progress: &mut dyn FnMut(EpochProgress),
        predict: impl Fn(&N, Ends<'_>) -> Vec<Twist>,
    ) -> Result<Vec<MotionScores>, training::Error> {
        let network = fit(self.samples, start, self.config, random, progress)?;
        let score = |(lesson, pairs): (&Lesson<'_>, &Vec<Pair>)| {
            let rows = |end: fn(&Pair) -> usize| {
                let rows: Vec<usize> = pairs.iter().map(end).collect();
                lesson.features.rows().select(ndarray::Axis(0), &rows)
            };
            let sources = rows(|pair| pair.source.row());

            let targets = rows(|pair| pair.target.row());

            let poses: Vec<Pose> = pairs
                .iter()
                .map(|pair| lesson.room.poses()[pair.source.row()])
                .collect();
            let ends = Ends {
                features: [sources.view(), targets.view()],
                sources: &poses,
            };

            MotionScores::of(
                &motions(lesson.room.poses(), pairs),
                &predict(&network, ends),
            )
        };

        Ok(self.lessons.iter().zip(self.tests).map(score).collect())
    }
}

/// The motion in the body frame of the first camera, of one in the world frame, M with P₂ = M P₁.
fn body_motion(world: &Pose, source: &Pose) -> Twist {
    log(&(source.inv_mul(world) * source))
}

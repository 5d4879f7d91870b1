//! From the features and poses of rooms to an adapter and its scores.

mod calibration;
mod errors;

pub use calibration::{balancing_factor, calibrate, imbalance};
pub use errors::error_covariance;

use ndarray::{Array2, ArrayView2, s};

use crate::adapter::{
    self, Adapter, CorrectorKind, EpochProgress, MAX_CHARTS, Mixing, PairPlan, Preset, Samples,
    TrainConfig, TrainingRecord, train, train_corrector,
};
use crate::features::Features;
use crate::geometry::{Pose, Twist, body_twist};
use crate::pairs::{self, Pair, Split};
use crate::room::{Room, RoomId};
use crate::scores::{MotionScores, constant_r2, mean_of_known};

/// Why nothing was learned.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum Error {
    #[error(transparent)]
    Pairs(#[from] pairs::Error),
    #[error("room '{room}': {problem}")]
    RoomPairs { room: RoomId, problem: pairs::Error },
    #[error(transparent)]
    Adapter(#[from] adapter::Error),
    #[error("room '{room}' has {frame_count} frames, features '{features}' have {rows} rows")]
    FeatureRows {
        room: RoomId,
        frame_count: usize,
        features: String,
        rows: usize,
    },
    #[error("features '{features}' of rooms '{first}' and '{room}' were not made alike")]
    UnlikeFeatures {
        features: String,
        first: RoomId,
        room: RoomId,
    },
    #[error(
        "room '{room}' was learned from: errors there are not those in rooms never seen; name others"
    )]
    LearnedFrom { room: RoomId },
    #[error(
        "alternatives are compared with one chart, mean squared error and features as they are; take a paper preset"
    )]
    NotPlain,
    #[error("{given} rooms are too few to measure in; at least {least} are needed")]
    FewRooms { least: usize, given: usize },
    #[error("no room was given to learn from")]
    NoRoom,
    #[error("{what} must be {least} to {most}, got {given}")]
    Setting {
        what: &'static str,
        least: usize,
        most: usize,
        given: usize,
    },
    #[error("{what} must be finite and {bound}, got {given}")]
    Rate {
        what: &'static str,
        bound: &'static str,
        given: f64,
    },
}

/// The most passes over the pairs.
pub const MAX_EPOCHS: usize = 100_000;
/// The most columns of a chart's latent.
pub const MAX_LATENT_DIM: usize = 4_096;
/// Passes of a corrector over the pairs: the paper does not say.
pub const CORRECTOR_EPOCHS: usize = 200;

/// What decides the numbers of a training run, besides its rooms.
#[derive(Debug, Clone, PartialEq)]
pub struct Recipe {
    /// The protocol that the settings began from.
    pub preset: Preset,
    /// How frames are kept apart.
    pub split: Split,
    /// Frames from source to target in the test pairs.
    pub stride: u32,
    /// Which training pairs are taken.
    pub pairs: PairPlan,
    /// The optimiser's settings and the seed of weights, order and drawn pairs.
    pub config: TrainConfig,
    /// Trained after the adapter for [`CORRECTOR_EPOCHS`] epochs, by mean squared error on its
    /// latents, with the same rate, decay, batch and seed.
    pub correctors: Vec<CorrectorKind>,
}

impl Recipe {
    /// A preset as it stands in the paper.
    pub fn of(preset: Preset, split: Split, stride: u32, seed: u64) -> Self {
        let pairs = preset.plan(stride);
        let config = preset.config(seed);

        Self {
            preset,
            split,
            stride,
            pairs,
            config,
            correctors: Vec::new(),
        }
    }

    /// Refuses settings that are out of range.
    ///
    /// # Errors
    /// [`Error::Setting`], [`Error::Rate`] or [`Error::Adapter`].
    pub fn check(&self) -> Result<(), Error> {
        let TrainConfig {
            epochs,
            batch,
            learning_rate,
            weight_decay,
            clip_norm,
            hidden,
            latent,
            charts,
            ..
        } = self.config;

        for (what, given, least, most) in [
            ("epochs", epochs, 1, MAX_EPOCHS),
            ("batch", batch, 1, 1 << 20),
            ("hidden columns", hidden, 1, MAX_LATENT_DIM),
            ("geo_dim", latent, 6, MAX_LATENT_DIM),
            ("charts", charts, 1, MAX_CHARTS),
        ] {
            if !(least..=most).contains(&given) {
                return Err(Error::Setting {
                    what,
                    least,
                    most,
                    given,
                });
            }
        }

        let twice = |(at, kind): (usize, &CorrectorKind)| self.correctors[..at].contains(kind);
        if let Some((_, kind)) = self
            .correctors
            .iter()
            .enumerate()
            .find(|&given| twice(given))
        {
            return Err(Error::Adapter(adapter::Error::CorrectorTwice {
                name: kind.name(),
            }));
        }

        let noise = self.config.noise;
        let average = self.config.average;
        if self.config.standardise && charts > 1 && self.config.mixing == Mixing::Gate {
            return Err(Error::Adapter(adapter::Error::GatedStandardised));
        }

        let positive = |value: f64| value.is_finite() && value > 0.0;
        for (what, bound, given, fits) in [
            (
                "the learning rate",
                "positive",
                learning_rate,
                positive(learning_rate),
            ),
            (
                "the clipping norm",
                "positive",
                clip_norm,
                positive(clip_norm),
            ),
            (
                "the noise",
                "not negative",
                noise,
                noise == 0.0 || positive(noise),
            ),
            (
                "the decay of the average",
                "at least 0 and under 1",
                average,
                (0.0..1.0).contains(&average),
            ),
            (
                "the weight decay",
                "not negative",
                weight_decay,
                weight_decay == 0.0 || positive(weight_decay),
            ),
        ] {
            if !fits {
                return Err(Error::Rate { what, bound, given });
            }
        }

        Ok(())
    }
}

/// A room as it lies in the store.
#[derive(Debug, Clone, Copy)]
pub struct Lesson<'a> {
    /// Where the frames were.
    pub room: &'a Room,
    /// The room's revision.
    pub revision: u64,
    /// What was seen, row by frame.
    pub features: &'a Features,
}

/// Trains an adapter on rooms together and scores it on each room's test pairs.
///
/// # Errors
/// [`Error`], when a room is too short, features do not fit, a setting is out of range, or training
/// fails.
///
/// Source: SeeSE3, M4 (sec. 2.4); cross-room training sec. 2.7.
pub fn learn(
    lessons: &[Lesson<'_>],
    recipe: &Recipe,
    progress: &mut dyn FnMut(EpochProgress),
) -> Result<(Adapter, TrainingRecord), Error> {
    recipe.check()?;
    check_lessons(lessons)?;
    let tests = test_pairs(lessons, recipe)?;
    let samples = samples(lessons, recipe)?;
    let network = train(&samples, &recipe.config, progress)?;
    let adapter = Adapter::new(
        lessons[0].features.source().clone(),
        network,
        samples.scale().clone(),
    )?;

    let mut correctors = Vec::with_capacity(recipe.correctors.len());

    let config = TrainConfig {
        epochs: CORRECTOR_EPOCHS,
        ..recipe.config.clone()
    };

    for &kind in &recipe.correctors {
        correctors.push(train_corrector(
            kind,
            &adapter,
            &samples,
            &config,
            &mut |_| (),
        )?);
    }

    let adapter = adapter.with_correctors(correctors)?;
    let mut room_tests = Vec::with_capacity(lessons.len());
    let mut train_mean_r2 = Vec::with_capacity(lessons.len());
    for (lesson, pairs) in lessons.iter().zip(&tests) {
        let truth = motions(lesson.room.poses(), pairs);
        room_tests.push(MotionScores::of(
            &truth,
            &predictions(&adapter, lesson.features.rows(), pairs)?,
        ));

        train_mean_r2.push(constant_r2(&truth, &samples.scale().mean));
    }

    let record = TrainingRecord {
        preset: recipe.preset.name().to_owned(),
        split: recipe.split,
        stride: recipe.stride,
        pairs: recipe.pairs.clone(),
        rooms: lessons
            .iter()
            .map(|lesson| (lesson.room.id().clone(), lesson.revision))
            .collect(),
        calibrated_on: Vec::new(),
        config: recipe.config.clone(),
        pair_count: samples.pair_count(),
        test: MotionScores::mean(&room_tests),
        room_tests,
        train: train_scores(&adapter, &samples)?,
        train_mean_r2: mean_of_known(&train_mean_r2),
    };

    Ok((adapter, record))
}

/// The training pairs of rooms under a recipe, their features one below the other.
///
/// # Errors
/// As [`learn`].
pub fn samples(lessons: &[Lesson<'_>], recipe: &Recipe) -> Result<Samples<f32>, Error> {
    let timelines: Vec<_> = lessons
        .iter()
        .map(|lesson| lesson.room.timeline())
        .collect();
    let drawn = recipe
        .pairs
        .pairs(recipe.split, &timelines, recipe.config.seed)?;

    let mut first_rows = Vec::with_capacity(lessons.len());
    let mut count = 0;
    for lesson in lessons {
        first_rows.push(count);
        count += lesson.room.frame_count();
    }

    let columns = lessons
        .first()
        .map_or(0, |lesson| lesson.features.source().dim);
    let mut features = Array2::zeros((count, columns));

    let mut poses = Vec::with_capacity(count);
    for (lesson, &first) in lessons.iter().zip(&first_rows) {
        features
            .slice_mut(s![first..first + lesson.room.frame_count(), ..])
            .assign(&lesson.features.rows());
        poses.extend_from_slice(lesson.room.poses());
    }

    let rows = |(room, pair): (usize, Pair)| {
        [pair.source, pair.target].map(|frame| first_rows[room] + frame.row())
    };
    let samples = Samples::new(
        features.view(),
        poses,
        drawn.into_iter().map(rows).collect(),
    )?;

    Ok(if recipe.config.through_zero {
        samples.through_zero()?
    } else {
        samples
    })
}

/// Refuses a room that was learned from.
pub fn check_unseen<'a>(
    lesson: &Lesson<'_>,
    learned: impl IntoIterator<Item = &'a RoomId>,
) -> Result<(), Error> {
    match learned.into_iter().any(|room| room == lesson.room.id()) {
        true => Err(Error::LearnedFrom {
            room: lesson.room.id().clone(),
        }),
        false => Ok(()),
    }
}

/// The test pairs of each room; none under [`Split::Whole`], which sets none apart.
pub(crate) fn test_pairs(lessons: &[Lesson<'_>], recipe: &Recipe) -> Result<Vec<Vec<Pair>>, Error> {
    let of = |lesson: &Lesson<'_>| {
        if recipe.split == Split::Whole {
            return Ok(Vec::new());
        }

        let pairs = recipe
            .split
            .test_pairs(lesson.room.timeline(), recipe.stride);

        pairs.map_err(|problem| match lessons.len() {
            1 => Error::Pairs(problem),
            _ => Error::RoomPairs {
                room: lesson.room.id().clone(),
                problem,
            },
        })
    };

    lessons.iter().map(of).collect()
}

pub(crate) fn check_lessons(lessons: &[Lesson<'_>]) -> Result<(), Error> {
    let first = lessons.first().ok_or(Error::NoRoom)?;
    for lesson in lessons {
        let frame_count = lesson.room.frame_count();
        let rows = lesson.features.rows().nrows();
        let features = lesson.features.source().name.clone();
        if rows != frame_count {
            return Err(Error::FeatureRows {
                room: lesson.room.id().clone(),
                frame_count,
                features,
                rows,
            });
        }

        let source = first.features.source();
        let own = lesson.features.source();
        if !own.is_like(source) || own.dim != source.dim {
            let first = first.room.id().clone();
            let room = lesson.room.id().clone();

            return Err(Error::UnlikeFeatures {
                features,
                first,
                room,
            });
        }
    }

    Ok(())
}

/// The true motions of pairs, each in its source's body frame.
pub fn motions(poses: &[Pose], pairs: &[Pair]) -> Vec<Twist> {
    pairs
        .iter()
        .map(|pair| body_twist(&poses[pair.source.row()], &poses[pair.target.row()]))
        .collect()
}

/// The motions that an adapter sees between the features at the ends of pairs.
///
/// # Errors
/// As [`Adapter::embed`].
pub fn predictions(
    adapter: &Adapter,
    rows: ArrayView2<'_, f32>,
    pairs: &[Pair],
) -> Result<Vec<Twist>, adapter::Error> {
    let latents = adapter.embed(rows)?;
    let motion = |pair: &Pair| {
        adapter.motion(
            latents.row(pair.source.row()),
            latents.row(pair.target.row()),
        )
    };

    Ok(pairs.iter().map(motion).collect())
}

fn train_scores(adapter: &Adapter, samples: &Samples<f32>) -> Result<MotionScores, Error> {
    let latents = adapter.embed(samples.features())?;
    let motion = |pair: usize| {
        let [from, to] = samples.pair(pair);
        adapter.motion(latents.row(from), latents.row(to))
    };
    let predicted: Vec<Twist> = (0..samples.pair_count()).map(motion).collect();

    Ok(MotionScores::of(samples.twists(), &predicted))
}

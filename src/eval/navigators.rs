//! The paper's navigation table: one row a navigator, all on the same pairs and candidates.

use std::sync::Arc;

use ndarray::{Array1, Array2, Axis};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::retrieval::twist_error;
use super::{Error, LatentScores, RetrievalScores, check_thresholds, default_thresholds, exact_index};
use crate::adapter::{Adapter, Reading};
use crate::cancel::Cancellation;
use crate::geometry::{Pose, Twist, body_twist};
use crate::index::{Exclusion, Index};
use crate::navigation::Navigator;
use crate::pairs::{Pair, Split};
use crate::ridge::{Intercept, Ridge};
use crate::room::FrameId;

/// Penalty of the refit, scikit-learn's default.
const REFIT_ALPHA: f64 = 1.0;

/// One way to choose the next frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NavigatorKind {
    /// ĝ = g: stay. It retrieves the source itself, also where another frame looks exactly the same, so that its
    /// Hit@ε is P(‖ΔP‖ < ε), whatever the encoder; with the source excluded, the frame that looks most like it.
    Identity,
    /// A candidate drawn at random.
    Random,
    /// The candidate whose pose is nearest to the target: what retrieval could reach at best.
    Oracle,
    /// ĝ = g + W⁺ΔP.
    InversePoincare(Reading),
    /// ĝ = g + B ΔP with B fitted by ridge on the room's training pairs, φ frozen (A-24: raw twists, no intercept).
    RidgeRefit,
    /// As [`NavigatorKind::RidgeRefit`], fitted on the very pairs it is scored on: the likely protocol of the paper,
    /// and a leak.
    RidgeRefitInSample,
}

impl NavigatorKind {
    /// Every navigator, in the order of the table.
    pub const ALL: [Self; 8] = [
        Self::Identity,
        Self::Random,
        Self::Oracle,
        Self::InversePoincare(Reading::Affine),
        Self::InversePoincare(Reading::Homogeneous),
        Self::InversePoincare(Reading::Literal),
        Self::RidgeRefit,
        Self::RidgeRefitInSample,
    ];

    /// Its name in tables, JSON and on the wire.
    pub fn name(self) -> &'static str {
        match self {
            Self::Identity => "identity",
            Self::Random => "random",
            Self::Oracle => "oracle",
            Self::InversePoincare(Reading::Affine) => "inverse-poincare-affine",
            Self::InversePoincare(Reading::Homogeneous) => "inverse-poincare-homogeneous",
            Self::InversePoincare(Reading::Literal) => "inverse-poincare-literal",
            Self::RidgeRefit => "ridge-refit",
            Self::RidgeRefitInSample => "ridge-refit-in-sample",
        }
    }

    /// The navigator with this [`NavigatorKind::name`].
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|kind| kind.name() == name)
    }
}

/// Everything that decides the numbers of a report, besides the room and the adapter.
#[derive(Debug, Clone, PartialEq)]
pub struct Protocol {
    /// How frames are kept apart.
    pub split: Split,
    /// Frames from source to target.
    pub stride: u32,
    /// Whether the source frame may not be retrieved, and how many rows to each side of it.
    pub exclude_source: Option<u32>,
    /// ε of Hit@ε.
    pub thresholds: Vec<f64>,
    /// Of the random navigator.
    pub seed: u64,
    /// Rows of the table.
    pub navigators: Vec<NavigatorKind>,
}

impl Protocol {
    /// The paper's protocol at a stride: time split, source included, ε of 0.1, 0.2, 0.3 and 0.5.
    pub fn paper(stride: u32) -> Self {
        Self {
            split: Split::Time,
            stride,
            exclude_source: None,
            thresholds: default_thresholds(),
            seed: 0,
            navigators: NavigatorKind::ALL.to_vec(),
        }
    }
}

/// One navigator's scores.
#[derive(Debug, Clone, PartialEq)]
pub struct Row {
    /// [`NavigatorKind::name`], or what a client calls its own.
    pub name: String,
    /// Pairs scored.
    pub n: usize,
    /// How near its latents are; none when only frames were given.
    pub latent: Option<LatentScores>,
    /// How near its frames are.
    pub retrieval: RetrievalScores,
}

/// A finished evaluation.
#[derive(Debug, Clone, PartialEq)]
pub struct Report {
    /// In the order of the protocol.
    pub rows: Vec<Row>,
    /// Pairs scored.
    pub n: usize,
    /// Frames among which answers were looked for.
    pub candidate_count: usize,
    /// What was asked for.
    pub protocol: Protocol,
}

/// Evaluates every navigator of the protocol on the room's test pairs; `progress` hears of each one begun.
///
/// # Errors
/// [`Error`], when the room is too short, a threshold is no threshold, or the work is cancelled.
///
/// Source: SeeSE3, Tables nav and nav_full (sec. 2.6).
pub fn evaluate(
    navigator: &Navigator,
    protocol: &Protocol,
    cancel: &Cancellation,
    progress: &mut dyn FnMut(usize, NavigatorKind),
) -> Result<Report, Error> {
    check_thresholds(&protocol.thresholds)?;
    let timeline = navigator.room().timeline();
    let bench = Bench {
        poses: navigator.room().poses(),
        adapter: navigator.adapter().clone(),
        latents: navigator.latents().to_owned(),
        test: protocol.split.test_pairs(timeline, protocol.stride)?,
        train: protocol.split.train_pairs(timeline, protocol.stride).unwrap_or_default(),
        candidates: protocol.split.candidates(timeline),
        protocol,
        cancel,
    };
    let mut rows = Vec::with_capacity(protocol.navigators.len());
    for (position, &kind) in protocol.navigators.iter().enumerate() {
        cancel.check()?;
        progress(position, kind);
        rows.push(bench.row(kind)?);
    }
    Ok(Report { rows, n: bench.test.len(), candidate_count: bench.candidates.len(), protocol: protocol.clone() })
}

/// What every row is computed from.
struct Bench<'a> {
    poses: &'a [Pose],
    adapter: Arc<Adapter>,
    latents: Array2<f64>,
    test: Vec<Pair>,
    train: Vec<Pair>,
    candidates: Vec<FrameId>,
    protocol: &'a Protocol,
    cancel: &'a Cancellation,
}

impl Bench<'_> {
    fn row(&self, kind: NavigatorKind) -> Result<Row, Error> {
        let steps: Vec<Array1<f64>> = match kind {
            NavigatorKind::Identity if self.protocol.exclude_source.is_none() => {
                return self.row_of_frames(kind, self.test.iter().map(|pair| pair.source).collect());
            }
            NavigatorKind::Identity => vec![Array1::zeros(self.latents.ncols()); self.test.len()],
            NavigatorKind::Random => return self.row_of_frames(kind, self.random_frames()?),
            NavigatorKind::Oracle => return self.row_of_frames(kind, self.nearest_poses()?),
            NavigatorKind::InversePoincare(reading) => {
                self.twists(&self.test).map(|twist| self.adapter.inverse().step(twist, reading, 1.0)).collect()
            }
            NavigatorKind::RidgeRefit => self.refit(&self.train)?,
            NavigatorKind::RidgeRefitInSample => self.refit(&self.test)?,
        };
        let mut predicted = self.latents_of(self.test.iter().map(|pair| pair.source));
        predicted.outer_iter_mut().zip(&steps).for_each(|(mut row, step)| row += step);
        let index = exact_index(self.latents.view(), &self.candidates);
        let mut retrieved = Vec::with_capacity(self.test.len());
        for (latent, pair) in predicted.outer_iter().zip(&self.test) {
            self.cancel.check()?;
            let nearest = index.nearest(&latent.to_vec(), 1, self.exclusion(pair.source));
            let first = nearest.first().ok_or(Error::NoCandidates { source_frame: pair.source })?;
            retrieved.push(first.frame);
        }
        Ok(self.scored(kind, &predicted, &retrieved))
    }

    fn row_of_frames(&self, kind: NavigatorKind, retrieved: Vec<FrameId>) -> Result<Row, Error> {
        let predicted = self.latents_of(retrieved.iter().copied());
        Ok(self.scored(kind, &predicted, &retrieved))
    }

    fn scored(&self, kind: NavigatorKind, predicted: &Array2<f64>, retrieved: &[FrameId]) -> Row {
        let targets = self.latents_of(self.test.iter().map(|pair| pair.target));
        Row {
            name: kind.name().to_owned(),
            n: self.test.len(),
            latent: Some(LatentScores::of(targets.view(), predicted.view())),
            retrieval: RetrievalScores::of(&self.test, retrieved, self.poses, &self.protocol.thresholds),
        }
    }

    fn random_frames(&self) -> Result<Vec<FrameId>, Error> {
        let mut random = ChaCha8Rng::seed_from_u64(self.protocol.seed);
        let draw = |pair: &Pair| {
            self.cancel.check()?;
            let allowed = self.allowed(pair.source)?;
            Ok(allowed[random.random_range(0..allowed.len())])
        };
        self.test.iter().map(draw).collect()
    }

    fn nearest_poses(&self) -> Result<Vec<FrameId>, Error> {
        let mut nearest = Vec::with_capacity(self.test.len());
        for &pair in &self.test {
            self.cancel.check()?;
            let errors = self.allowed(pair.source)?.into_iter().map(|f| (twist_error(pair, f, self.poses), f));
            let best = errors.min_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            nearest.push(best.ok_or(Error::NoCandidates { source_frame: pair.source })?.1);
        }
        Ok(nearest)
    }

    /// Candidates that may be retrieved from a source; at least one.
    fn allowed(&self, source: FrameId) -> Result<Vec<FrameId>, Error> {
        let exclusion = self.exclusion(source);
        let open = |frame: &FrameId| !exclusion.is_some_and(|exclusion| exclusion.covers(*frame));
        let allowed: Vec<FrameId> = self.candidates.iter().copied().filter(open).collect();
        if allowed.is_empty() { Err(Error::NoCandidates { source_frame: source }) } else { Ok(allowed) }
    }

    fn exclusion(&self, centre: FrameId) -> Option<Exclusion> {
        self.protocol.exclude_source.map(|radius| Exclusion { centre, radius })
    }

    /// Latent steps of the test pairs from a linear map fitted on `fit_on`.
    fn refit(&self, fit_on: &[Pair]) -> Result<Vec<Array1<f64>>, Error> {
        let rows: Vec<Twist> = self.twists(fit_on).collect();
        let inputs = Array2::from_shape_fn((rows.len(), 6), |(row, column)| rows[row].to_vector()[column]);
        let steps = self.latents_of(fit_on.iter().map(|pair| pair.target))
            - self.latents_of(fit_on.iter().map(|pair| pair.source));
        let fit = Ridge::fit(inputs.view(), steps.view(), REFIT_ALPHA, Intercept::None)?;
        let predict = |twist: Twist| fit.predict(Array1::from_iter(twist.to_vector().iter().copied()).view());
        Ok(self.twists(&self.test).map(predict).collect())
    }

    fn twists<'b>(&'b self, pairs: &'b [Pair]) -> impl Iterator<Item = Twist> + 'b {
        pairs.iter().map(|pair| body_twist(&self.poses[pair.source.row()], &self.poses[pair.target.row()]))
    }

    fn latents_of(&self, frames: impl Iterator<Item = FrameId>) -> Array2<f64> {
        self.latents.select(Axis(0), &frames.map(FrameId::row).collect::<Vec<_>>())
    }
}

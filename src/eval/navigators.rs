//! The paper's navigation table: one row a navigator, all on the same pairs and candidates.

use ndarray::{Array2, ArrayView2, Axis, s};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::retrieval::twist_error;
use super::{Error, LatentScores, RetrievalScores, check_thresholds, default_thresholds};
use crate::adapter::{Adapter, CorrectorKind, Reading};
use crate::cancel::Cancellation;
use crate::geometry::{Pose, body_twist};
use crate::index::Exclusion;
use crate::navigation::{
    self, Ground, Leg, Metric, Mode, Navigator, Plan, Refit, Search, Space, Start, StepKind,
    Stepper, walk,
};
use crate::pairs::{Pair, Split};
use crate::room::{FrameId, Timeline};

/// One way to choose the next frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NavigatorKind {
    /// ĝ = g: stay. It retrieves the source itself, also where another frame looks exactly the
    /// same, so that its Hit@ε is P(‖ΔP‖ < ε), whatever the encoder; with the source excluded, the
    /// frame that looks most like it.
    Identity,
    /// A candidate drawn at random.
    Random,
    /// The candidate whose pose is nearest to the target: what retrieval could reach at best.
    Oracle,
    /// Imagines where the motion leads and takes the frame that is nearest under a metric.
    Step(StepKind, Metric),
}

/// Between a way to step and a metric that is not the paper's, in a navigator's name.
const UNDER: char = '+';

impl NavigatorKind {
    /// Every navigator.
    pub fn all() -> Vec<Self> {
        let homogeneous = StepKind::InversePoincare(Reading::Homogeneous);
        let steps = StepKind::all().into_iter();
        let steps = steps.flat_map(|step| Metric::ALL.map(|metric| (step, metric)));
        let steps =
            steps.filter(|&(step, metric)| metric != Metric::Calibrated || step == homogeneous);
        let steps = steps.map(|(step, metric)| Self::Step(step, metric));

        [Self::Identity, Self::Random, Self::Oracle]
            .into_iter()
            .chain(steps)
            .collect()
    }

    /// The rows of the table for an adapter: the baselines, the three readings, its correctors, the
    /// refits on raw motions, and inverse Poincaré under the other metrics that it has.
    pub fn table(adapter: &Adapter) -> Vec<Self> {
        let full = |step: StepKind| Self::Step(step, Metric::Full);
        let corrector = |kind: CorrectorKind| full(StepKind::Corrector(kind));

        let refit = |in_sample: bool| {
            full(StepKind::Refit(Refit {
                z_scored: false,
                intercept: false,
                in_sample,
            }))
        };

        let affine = StepKind::InversePoincare(Reading::Affine);
        let gated = adapter.motion_of_coordinates().is_err();
        let others = [Metric::RowSpace, Metric::Whitened, Metric::Motion];
        let others = others
            .into_iter()
            .filter(|&metric| !(gated && metric == Metric::Motion));

        let mut rows = vec![Self::Identity, Self::Random, Self::Oracle];
        rows.extend(Reading::ALL.map(|reading| full(StepKind::InversePoincare(reading))));
        rows.extend(adapter.correctors().map(|known| corrector(known.kind())));
        rows.extend([refit(false), refit(true)]);

        rows.extend(others.map(|metric| Self::Step(affine, metric)));
        let homogeneous = StepKind::InversePoincare(Reading::Homogeneous);
        let calibrated = adapter.error_covariance().filter(|_| !gated);
        rows.extend(calibrated.map(|_| Self::Step(homogeneous, Metric::Calibrated)));

        rows
    }

    /// Its name in tables, JSON and on the wire: the way to step, and `+METRIC` unless that is the
    /// paper's.
    pub fn name(self) -> String {
        match self {
            Self::Identity => "identity".to_owned(),
            Self::Random => "random".to_owned(),
            Self::Oracle => "oracle".to_owned(),
            Self::Step(step, Metric::Full) => step.name().to_owned(),
            Self::Step(step, metric) => format!("{}{UNDER}{}", step.name(), metric.name()),
        }
    }

    /// The navigator with this [`NavigatorKind::name`].
    pub fn from_name(name: &str) -> Option<Self> {
        Self::all().into_iter().find(|kind| kind.name() == name)
    }

    /// The names in words, for those who gave another.
    pub fn known_names() -> String {
        let steps: Vec<&str> = StepKind::all().into_iter().map(StepKind::name).collect();
        format!(
            "identity, random, oracle, {}; ways to step also with +row-space, +whitened or +motion, and \
             inverse-poincare-homogeneous with +calibrated",
            steps.join(", ")
        )
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
    /// Equal parts of each motion.
    pub steps: u32,
    /// How the parts hang together.
    pub mode: Mode,
    /// Rows of the table; those of [`NavigatorKind::table`] if empty.
    pub navigators: Vec<NavigatorKind>,
}

impl Protocol {
    /// The rows that a table of this protocol has in a room: those that were asked for, or the
    /// adapter's own.
    ///
    /// # Errors
    /// [`Error::NothingToFitOn`] for a refit without pairs of its own, [`Error::Navigation`] for no
    /// step at all.
    pub fn rows(&self, navigator: &Navigator) -> Result<Vec<NavigatorKind>, Error> {
        if self.steps == 0 {
            return Err(navigation::Error::Steps {
                actual: 0,
                most: u32::MAX,
            }
            .into());
        }

        let can_fit = self.can_fit(navigator.room().timeline());
        let unfitted = |kind: &NavigatorKind| {
            matches!(kind, NavigatorKind::Step(StepKind::Refit(refit), _) if !refit.in_sample)
                && !can_fit
        };

        if self.navigators.is_empty() {
            let table = NavigatorKind::table(navigator.adapter());
            return Ok(table.into_iter().filter(|kind| !unfitted(kind)).collect());
        }

        match self.navigators.iter().find(|kind| unfitted(kind)) {
            Some(kind) => Err(Error::NothingToFitOn {
                navigator: kind.name(),
                split: self.split,
            }),
            None => Ok(self.navigators.clone()),
        }
    }

    /// Whether there are pairs apart from those that are tested: a refit that is not in sample
    /// needs some.
    fn can_fit(&self, timeline: &Timeline) -> bool {
        self.split != Split::Whole && self.split.train_pairs(timeline, self.stride).is_ok()
    }

    /// The paper's protocol at a stride: time split, source included, one step, ε of 0.1, 0.2, 0.3
    /// and 0.5.
    pub fn paper(stride: u32) -> Self {
        Self {
            split: Split::Time,
            stride,
            exclude_source: None,
            thresholds: default_thresholds(),
            seed: 0,
            steps: 1,
            mode: Mode::OpenLoop,
            navigators: Vec::new(),
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

/// Evaluates every navigator of the protocol on the room's test pairs; `progress` hears of each one
/// begun.
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
    let navigators = protocol.rows(navigator)?;

    let bench = Bench {
        poses: navigator.room().poses(),
        adapter: navigator.adapter(),
        latents: navigator.latents(),
        test: protocol.split.test_pairs(timeline, protocol.stride)?,
        train: protocol
            .split
            .train_pairs(timeline, protocol.stride)
            .unwrap_or_default(),
        candidates: protocol.split.candidates(timeline),
        protocol,
        cancel,
    };

    let mut rows = Vec::with_capacity(navigators.len());
    for (position, &kind) in navigators.iter().enumerate() {
        cancel.check()?;
        progress(position, kind);
        rows.push(bench.row(kind)?);
    }

    let protocol = Protocol {
        navigators,
        ..protocol.clone()
    };

    Ok(Report {
        rows,
        n: bench.test.len(),
        candidate_count: bench.candidates.len(),
        protocol,
    })
}

/// What every row is computed from.
struct Bench<'a> {
    poses: &'a [Pose],
    adapter: &'a Adapter,
    latents: ArrayView2<'a, f64>,
    test: Vec<Pair>,
    train: Vec<Pair>,
    candidates: Vec<FrameId>,
    protocol: &'a Protocol,
    cancel: &'a Cancellation,
}

impl Bench<'_> {
    fn row(&self, kind: NavigatorKind) -> Result<Row, Error> {
        match kind {
            NavigatorKind::Identity => self.identity(),
            NavigatorKind::Random => Ok(self.row_of_frames(kind, &self.random_frames()?)),
            NavigatorKind::Oracle => Ok(self.row_of_frames(kind, &self.nearest_poses()?)),
            NavigatorKind::Step(step, metric) => {
                let ground = Ground {
                    latents: self.latents,
                    poses: self.poses,
                    train: &self.train,
                    test: &self.test,
                };
                let stepper = Stepper::new(step, self.adapter, ground)?;

                let search = Search::exact(metric, self.adapter, self.latents, &self.candidates)?;
                let space = Space {
                    adapter: self.adapter,
                    stepper: &stepper,
                    latents: self.latents,
                    poses: self.poses,
                    search: &search,
                };

                let mut predicted =
                    Array2::zeros((self.test.len(), self.adapter.coordinate_count()));
                let mut retrieved = Vec::with_capacity(self.test.len());
                for (&pair, mut row) in self.test.iter().zip(predicted.outer_iter_mut()) {
                    let Some(end) = self.walked(space, pair)?.pop() else {
                        continue;
                    };
                    row.assign(&end.latent.slice(s![..self.adapter.coordinate_count()]));

                    retrieved.push(end.neighbours[0].frame);
                }

                Ok(self.scored(kind, &predicted, &retrieved))
            }
        }
    }

    fn walked(&self, space: Space<'_>, pair: Pair) -> Result<Vec<navigation::Step>, Error> {
        let Protocol {
            steps,
            mode,
            exclude_source,
            ..
        } = *self.protocol;

        let [source, target] = [pair.source, pair.target].map(|frame| self.poses[frame.row()]);
        let latent = self.latents.row(pair.source.row()).to_owned();
        let start = Start {
            latent,
            frame: Some(pair.source),
            pose: Some(source),
        };

        let leg = Leg {
            motion: body_twist(&source, &target),
            goal: Some(target),
        };

        let plan = Plan {
            mode,
            steps,
            hit_count: 1,
            exclude_source,
        };

        walk(space, &start, leg, plan, self.cancel).map_err(|error| match error {
            navigation::Error::NoCandidates { .. } => Error::NoCandidates {
                source_frame: pair.source,
            },
            other => other.into(),
        })
    }

    fn identity(&self) -> Result<Row, Error> {
        if self.protocol.exclude_source.is_none() {
            let sources: Vec<FrameId> = self.test.iter().map(|pair| pair.source).collect();
            return Ok(self.row_of_frames(NavigatorKind::Identity, &sources));
        }

        let search = Search::exact(Metric::Full, self.adapter, self.latents, &self.candidates)?;
        let mut retrieved = Vec::with_capacity(self.test.len());
        for pair in &self.test {
            self.cancel.check()?;

            let nearest = search.nearest(
                self.latents.row(pair.source.row()),
                1,
                self.exclusion(pair.source),
            );
            let found = nearest.first().ok_or(Error::NoCandidates {
                source_frame: pair.source,
            })?;

            retrieved.push(found.frame);
        }

        let here = self.coordinates_of(self.test.iter().map(|pair| pair.source));
        Ok(self.scored(NavigatorKind::Identity, &here, &retrieved))
    }

    fn row_of_frames(&self, kind: NavigatorKind, retrieved: &[FrameId]) -> Row {
        self.scored(
            kind,
            &self.coordinates_of(retrieved.iter().copied()),
            retrieved,
        )
    }

    fn scored(&self, kind: NavigatorKind, predicted: &Array2<f64>, retrieved: &[FrameId]) -> Row {
        let targets = self.coordinates_of(self.test.iter().map(|pair| pair.target));
        Row {
            name: kind.name(),
            n: self.test.len(),
            latent: Some(LatentScores::of(targets.view(), predicted.view())),
            retrieval: RetrievalScores::of(
                &self.test,
                retrieved,
                self.poses,
                &self.protocol.thresholds,
            ),
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

            let errors = self
                .allowed(pair.source)?
                .into_iter()
                .map(|f| (twist_error(pair, f, self.poses), f));
            let best = errors.min_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));

            nearest.push(
                best.ok_or(Error::NoCandidates {
                    source_frame: pair.source,
                })?
                .1,
            );
        }

        Ok(nearest)
    }

    /// Candidates that may be retrieved from a source; at least one.
    fn allowed(&self, source: FrameId) -> Result<Vec<FrameId>, Error> {
        let exclusion = self.exclusion(source);
        let open = |frame: &FrameId| !exclusion.is_some_and(|exclusion| exclusion.covers(*frame));
        let allowed: Vec<FrameId> = self.candidates.iter().copied().filter(open).collect();
        if allowed.is_empty() {
            Err(Error::NoCandidates {
                source_frame: source,
            })
        } else {
            Ok(allowed)
        }
    }

    fn exclusion(&self, centre: FrameId) -> Option<Exclusion> {
        self.protocol
            .exclude_source
            .map(|radius| Exclusion { centre, radius })
    }

    fn coordinates_of(&self, frames: impl Iterator<Item = FrameId>) -> Array2<f64> {
        let coordinates = self
            .latents
            .slice(s![.., ..self.adapter.coordinate_count()]);
        coordinates.select(Axis(0), &frames.map(FrameId::row).collect::<Vec<_>>())
    }
}

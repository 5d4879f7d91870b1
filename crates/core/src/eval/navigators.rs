//! The paper's navigation table: one row per navigator, all on the same pairs and candidates.

use ndarray::{Array2, ArrayView2, Axis, s};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::retrieval::twist_error;
use super::{Error, LatentScores, RetrievalScores, check_thresholds, default_thresholds};
use crate::adapter::Adapter;
use crate::cancel::Cancellation;
use crate::geometry::{Pose, body_twist};
use crate::index::Exclusion;
use crate::navigation::{
    self, Leg, Mode, Navigator, NavigatorKind, Plan, RefitData, RelationalSpace, RelationalView,
    RelationalWalk, RetrievalMetric, SHORTLIST, Search, Space, Start, StepKind, Stepper,
    relational_walk, walk,
};
use crate::room::{FrameId, Timeline};
use crate::splits::{Pair, Split};
use crate::statistics::MeanInterval;

/// All settings of an evaluation except the room and the adapter.
#[derive(Debug, Clone, PartialEq)]
pub struct Protocol {
    /// Split of the frames into training and test.
    pub split: Split,
    /// Frames from source to target.
    pub stride: u32,
    /// Excludes the source frame and this many rows to each side from retrieval; `None`
    /// excludes nothing.
    pub exclude_source: Option<u32>,
    /// ε of Hit@ε.
    pub thresholds: Vec<f64>,
    /// Seed of the random navigator.
    pub seed: u64,
    /// Number of equal steps per motion, at least 1.
    pub steps: u32,
    /// How these steps are chained.
    pub mode: Mode,
    /// Number of frames that the relational reader compares with the source; at least 1.
    pub shortlist: usize,
    /// Rows of the table; if empty, those of [`NavigatorKind::table`] that can be fitted in the
    /// room.
    pub navigators: Vec<NavigatorKind>,
}

impl Protocol {
    /// The rows of the table in a room: the requested ones, or else the adapter's default rows that
    /// can be fitted there.
    ///
    /// # Errors
    /// [`Error::NothingToFitOn`] when a requested refit has no training pairs,
    /// [`Error::Navigation`] when `steps` is 0.
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

        // Default rows that cannot be fitted are omitted; a requested row that cannot be fitted is
        // an error.
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

    /// Whether the split has training pairs that are not tested, as an out-of-sample refit needs.
    fn can_fit(&self, timeline: &Timeline) -> bool {
        self.split != Split::Whole && self.split.train_pairs(timeline, self.stride).is_ok()
    }

    /// The paper's protocol at a stride: time split, source not excluded, one step, ε = 0.1, 0.2,
    /// 0.3, 0.5.
    pub fn paper(stride: u32) -> Self {
        Self {
            split: Split::Time,
            stride,
            exclude_source: None,
            thresholds: default_thresholds(),
            seed: 0,
            steps: 1,
            mode: Mode::OpenLoop,
            shortlist: SHORTLIST,
            navigators: Vec::new(),
        }
    }
}

/// One navigator's scores.
#[derive(Debug, Clone, PartialEq)]
pub struct Row {
    /// [`NavigatorKind::name`], or a fixed name for a client's predictions.
    pub name: String,
    /// Pairs scored.
    pub n: usize,
    /// Scores of the predicted latents; `None` when only frames were predicted.
    pub latent: Option<LatentScores>,
    /// Scores of the retrieved frames.
    pub retrieval: RetrievalScores,
    /// For each ε, the difference of Hit@ε to that of Identity on the same pairs, with its 95 %
    /// interval. Empty for Identity itself.
    pub hits_over_identity: Vec<(f64, MeanInterval)>,
    /// Whether these are no held-out scores; set by [`Report::marked`].
    pub leaks: bool,
}

impl Row {
    /// The name, followed by LEAK if the scores are no held-out scores.
    pub fn label(&self) -> String {
        match self.leaks {
            true => format!("{} LEAK", self.name),
            false => self.name.clone(),
        }
    }
}

/// A finished evaluation.
#[derive(Debug, Clone, PartialEq)]
pub struct Report {
    /// One row per navigator, in the order of the protocol.
    pub rows: Vec<Row>,
    /// Pairs scored.
    pub n: usize,
    /// Number of candidate frames.
    pub candidate_count: usize,
    /// The protocol, with the navigators that were evaluated.
    pub protocol: Protocol,
}

/// Evaluates the navigators of the protocol on the room's test pairs. `progress` is called before
/// each, with its index and kind.
///
/// # Errors
/// [`Error`] when the room is too short for the protocol, a threshold is out of range, the adapter
/// lacks what a navigator needs, or the work is cancelled.
///
/// Source: SeeSE3, Tables nav and nav_full (Sec. A.9).
pub fn evaluate(
    navigator: &Navigator,
    protocol: &Protocol,
    cancel: &Cancellation,
    progress: &mut dyn FnMut(usize, NavigatorKind),
) -> Result<Report, Error> {
    check_thresholds(&protocol.thresholds)?;
    let timeline = navigator.room().timeline();
    let navigators = protocol.rows(navigator)?;

    let inputs = TableInputs {
        navigator,
        poses: navigator.room().poses(),
        adapter: navigator.adapter(),
        latents: navigator.latents(),
        test: protocol.split.test_pairs(timeline, protocol.stride)?,
        // Only refits use training pairs; `Protocol::rows` has refused a refit without any.
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
        rows.push(inputs.row(kind)?);
    }

    let identity = NavigatorKind::Identity.name();
    let baseline = match rows.iter().find(|row| row.name == identity) {
        Some(row) => row.retrieval.clone(),
        None => inputs.row(NavigatorKind::Identity)?.retrieval,
    };
    for row in rows.iter_mut().filter(|row| row.name != identity) {
        row.hits_over_identity = row.retrieval.hits_over(&baseline);
    }

    // An empty list of navigators is replaced by the rows that were evaluated.
    let protocol = Protocol {
        navigators,
        ..protocol.clone()
    };

    Ok(Report {
        rows,
        n: inputs.test.len(),
        candidate_count: inputs.candidates.len(),
        protocol,
    })
}

/// Common inputs of all rows of the table.
struct TableInputs<'a> {
    navigator: &'a Navigator,
    poses: &'a [Pose],
    adapter: &'a Adapter,
    latents: ArrayView2<'a, f64>,
    test: Vec<Pair>,
    train: Vec<Pair>,
    candidates: Vec<FrameId>,
    protocol: &'a Protocol,
    cancel: &'a Cancellation,
}

impl TableInputs<'_> {
    fn row(&self, kind: NavigatorKind) -> Result<Row, Error> {
        match kind {
            NavigatorKind::Identity => self.identity(),
            NavigatorKind::Random => Ok(self.row_of_frames(kind, &self.random_frames()?)),
            NavigatorKind::Oracle => Ok(self.row_of_frames(kind, &self.nearest_poses()?)),
            NavigatorKind::Relational => self.relational(),
            NavigatorKind::Step(step, metric) => {
                // A refit is fitted once, for all pairs.
                let ground = RefitData {
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
                    // Only the last step of a walk is scored.
                    let Some(end) = self.walked(space, pair)?.pop() else {
                        continue;
                    };

                    // Only coordinates are scored, not the gate weights of a mixture.
                    row.assign(&end.latent.slice(s![..self.adapter.coordinate_count()]));

                    retrieved.push(end.neighbors[0].frame);
                }

                Ok(self.scored(kind, &predicted, &retrieved))
            }
        }
    }

    /// The relational reader predicts no latent, so the row has only scores of frames.
    fn relational(&self) -> Result<Row, Error> {
        let search = Search::exact(
            RetrievalMetric::Full,
            self.adapter,
            self.latents,
            &self.candidates,
        )?;
        let space = RelationalSpace {
            shortlist: self.protocol.shortlist,
            ..self.navigator.relational_space(&search)?
        };

        let mut retrieved = Vec::with_capacity(self.test.len());
        for &pair in &self.test {
            let [source, target] = [pair.source, pair.target].map(|frame| self.poses[frame.row()]);
            let latent = self.latents.row(pair.source.row()).to_owned();
            let walk = RelationalWalk {
                space,
                latents: self.latents,
                poses: self.poses,
                start: RelationalView {
                    cells: space.cells,
                    image: pair.source.row(),
                    latent: &latent,
                },
                start_frame: Some(pair.source),
                start_pose: Some(source),
                leg: body_twist(&source, &target),
                goal: Some(target),
                source_from_leg: Pose::identity(),
                plan: self.plan(),
            };

            // Only the last step of a walk is scored.
            let walked = relational_walk(&walk, self.cancel);
            let steps = walked.map_err(|error| of_pair(error, pair))?;
            retrieved.extend(steps.last().map(|neighbors| neighbors[0].frame));
        }

        Ok(Row {
            name: NavigatorKind::Relational.name(),
            n: self.test.len(),
            latent: None,
            retrieval: RetrievalScores::of(
                &self.test,
                &retrieved,
                self.poses,
                &self.protocol.thresholds,
            ),
            hits_over_identity: Vec::new(),
            leaks: false,
        })
    }

    fn plan(&self) -> Plan {
        Plan {
            mode: self.protocol.mode,
            steps: self.protocol.steps,
            top_k: 1,
            exclude_source: self.protocol.exclude_source,
        }
    }

    fn walked(&self, space: Space<'_>, pair: Pair) -> Result<Vec<navigation::Step>, Error> {
        let [source, target] = [pair.source, pair.target].map(|frame| self.poses[frame.row()]);
        let latent = self.latents.row(pair.source.row()).to_owned();
        let start = Start {
            latent,
            frame: Some(pair.source),
            pose: Some(source),
        };

        // The requested motion is the true one from source to target.
        let leg = Leg {
            motion: body_twist(&source, &target),
            goal: Some(target),
        };

        let walked = walk(space, &start, leg, self.plan(), self.cancel);
        walked.map_err(|error| of_pair(error, pair))
    }

    fn identity(&self) -> Result<Row, Error> {
        // No search: another frame with the same latent could be returned instead of the source.
        if self.protocol.exclude_source.is_none() {
            let sources: Vec<FrameId> = self.test.iter().map(|pair| pair.source).collect();
            return Ok(self.row_of_frames(NavigatorKind::Identity, &sources));
        }

        let search = Search::exact(
            RetrievalMetric::Full,
            self.adapter,
            self.latents,
            &self.candidates,
        )?;
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

        // The predicted latent is the source's, whatever frame was retrieved.
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
            hits_over_identity: Vec::new(),
            leaks: false,
        }
    }

    fn random_frames(&self) -> Result<Vec<FrameId>, Error> {
        let mut random = ChaCha8Rng::seed_from_u64(self.protocol.seed);
        let draw = |pair: &Pair| {
            self.cancel.check()?;

            // One draw per pair, among the candidates that are not excluded.
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

            // Ties are broken by the smaller frame number, so that the row is reproducible.
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

    /// Candidates for a source that are not excluded; at least one.
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

    fn exclusion(&self, center: FrameId) -> Option<Exclusion> {
        self.protocol
            .exclude_source
            .map(|radius| Exclusion { center, radius })
    }

    fn coordinates_of(&self, frames: impl Iterator<Item = FrameId>) -> Array2<f64> {
        let coordinates = self
            .latents
            .slice(s![.., ..self.adapter.coordinate_count()]);
        coordinates.select(Axis(0), &frames.map(FrameId::row).collect::<Vec<_>>())
    }
}

/// Names the pair for which no candidate was left.
fn of_pair(error: navigation::Error, pair: Pair) -> Error {
    match error {
        navigation::Error::NoCandidates { .. } => Error::NoCandidates {
            source_frame: pair.source,
        },
        other => other.into(),
    }
}

//! A [`Navigator`]: one room, embedded by one adapter and indexed for queries.

use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use ndarray::{Array1, Array2, ArrayView1, ArrayView2, Axis};
use strum::VariantArray;

use super::{
    Error, FitOn, IndexKind, Leg, Limits, Method, Mode, Plan, Query, Refit, RefitData,
    RelationalSpace, RelationalView, RelationalWalk, RequestedMotion, RetrievalMetric, SHORTLIST,
    Search, Source, Space, Start, StepKind, Stepper, check_twist, relational_walk, walk,
};
use crate::adapter::{self, Adapter, Cells};
use crate::cancel::Cancellation;
use crate::features::Features;
use crate::geometry::{Pose, PoseError, Twist, body_twist, exp};
use crate::index::{Audit, Neighbor};
use crate::room::{FrameId, Room};
use crate::splits::Pair;

/// Maximum number of cached refits; the oldest is dropped first.
const MOST_REFITS: usize = 32;

/// A retrieved frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RetrievedFrame {
    /// The frame and its distance to the query latent.
    pub neighbor: Neighbor,
    /// Its pose, `world_from_camera`.
    pub pose: Pose,
}

/// One step of an answer.
#[derive(Debug, Clone, PartialEq)]
pub struct AnswerStep {
    /// ĝ, the predicted latent; `None` for a method that predicts none.
    pub latent: Option<Array1<f64>>,
    /// The retrieved frames, the nearest first; at least one.
    pub frames: Vec<RetrievedFrame>,
    /// The requested pose after the step, `world_from_camera`, if the source's pose is known.
    pub requested_pose: Option<Pose>,
    /// Error of the nearest frame against `requested_pose`, if known.
    pub error: Option<StepError>,
}

/// Error of a step's nearest frame against the requested pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepError {
    /// Distance and angle.
    pub pose: PoseError,
    /// ‖ΔP_requested − ΔP_retrieved‖₂, both from the source, as compared with ε in Hit@ε.
    pub twist: f64,
}

impl StepError {
    /// Error of the pose `found` against `wanted`, with the twists from `source`. All three are
    /// `world_from_camera`.
    pub fn of(source: &Pose, found: &Pose, wanted: &Pose) -> Self {
        let difference =
            body_twist(source, wanted).to_vector() - body_twist(source, found).to_vector();
        Self {
            pose: PoseError::between(found, wanted),
            twist: difference.norm(),
        }
    }
}

/// The answer to a [`Query`].
#[derive(Debug, Clone, PartialEq)]
pub struct Answer {
    /// All steps in order.
    pub steps: Vec<AnswerStep>,
    /// The whole requested motion in the source's body frame, if the source's pose is known and the
    /// logarithm is unique.
    pub motion: Option<Twist>,
}

/// One room under one adapter: the latents of all frames and an index over them. Immutable, except
/// for caches.
pub struct Navigator {
    room: Arc<Room>,
    adapter: Arc<Adapter>,
    latents: Array2<f64>,
    /// Cells of all frames, if the adapter has a relational reader.
    cells: Option<Cells>,
    kind: IndexKind,
    /// The search under [`RetrievalMetric::Full`].
    search: Search,
    /// Searches under the other metrics, indexed by `metric as usize`, built on first use.
    other_searches: [OnceLock<Search>; RetrievalMetric::VARIANTS.len()],
    /// Cache of fitted refits, by variant and pairs.
    refits: Mutex<Vec<(Refit, FitOn, Arc<Stepper>)>>,
    /// Held while a search is built, so that no two threads build the same search.
    building: Mutex<()>,
}

impl Navigator {
    /// Embeds a room's features and indexes them.
    ///
    /// # Errors
    /// [`Error::FeatureRows`] unless there is one feature row per frame; [`Error::Adapter`] when
    /// the source of the features is not the adapter's.
    pub fn new(
        room: Arc<Room>,
        features: &Features,
        adapter: Arc<Adapter>,
        kind: IndexKind,
    ) -> Result<Self, Error> {
        adapter.check_source(features.source())?;
        let latents = adapter.embed(features.rows())?;
        Self::of_latents(room, features, adapter, kind, latents)
    }

    /// As [`Navigator::new`], with latents (n, k) that were computed before from the same features and
    /// adapter.
    ///
    /// # Errors
    /// As [`Navigator::new`]; [`Error::FeatureRows`] also for another number of latents.
    pub fn of_latents(
        room: Arc<Room>,
        features: &Features,
        adapter: Arc<Adapter>,
        kind: IndexKind,
        latents: Array2<f64>,
    ) -> Result<Self, Error> {
        adapter.check_source(features.source())?;
        if let Some(latent) = latents.outer_iter().next() {
            adapter.check_latent(&latent.to_vec())?;
        }

        let frame_count = room.frame_count();
        for rows in [features.rows().nrows(), latents.nrows()] {
            if rows != frame_count {
                return Err(Error::FeatureRows {
                    room: room.id().clone(),
                    frame_count,
                    rows,
                });
            }
        }

        let search = Search::new(kind, RetrievalMetric::Full, &adapter, latents.view())?;
        let cells = match adapter.relational() {
            Some(reader) => Some(reader.cells(features.rows())?),
            None => None,
        };

        Ok(Self {
            room,
            adapter,
            latents,
            cells,
            kind,
            search,
            other_searches: Default::default(),
            refits: Mutex::new(Vec::new()),
            building: Mutex::new(()),
        })
    }

    /// The room.
    pub fn room(&self) -> &Arc<Room> {
        &self.room
    }

    /// The adapter.
    pub fn adapter(&self) -> &Arc<Adapter> {
        &self.adapter
    }

    /// Latents of all frames, shape (n, k).
    pub fn latents(&self) -> ArrayView2<'_, f64> {
        self.latents.view()
    }

    /// Approximate memory use, bytes, without the room, the adapter and the caches (searches under
    /// other metrics, refits).
    pub fn memory_bytes(&self) -> usize {
        let cells = self.cells.as_ref().map_or(0, Cells::memory_bytes);
        self.latents.len() * size_of::<f64>() + self.search.memory_bytes() + cells
    }

    /// The room's views for relational navigation, with `search` over the candidate frames.
    ///
    /// # Errors
    /// [`Error::Adapter`] when the adapter has no relational reader.
    pub fn relational_space<'a>(
        &'a self,
        search: &'a Search,
    ) -> Result<RelationalSpace<'a>, Error> {
        let reader = self.adapter.relational().zip(self.cells.as_ref());
        let (reader, cells) = reader.ok_or(adapter::Error::NoRelational)?;

        Ok(RelationalSpace {
            adapter: &self.adapter,
            reader,
            cells,
            search,
            shortlist: SHORTLIST,
        })
    }

    /// Cells of all frames, if the adapter has a relational reader.
    pub fn cells(&self) -> Option<&Cells> {
        self.cells.as_ref()
    }

    /// The kind of the index of the frames.
    pub fn index_kind(&self) -> IndexKind {
        self.search.kind()
    }

    /// Recall of an approximate index against the exact scan; `None` if the index is exact.
    pub fn audit(&self) -> Option<Audit> {
        self.search.audit()
    }

    /// The `k` frames nearest to a latent under [`RetrievalMetric::Full`].
    pub fn nearest(&self, latent: ArrayView1<'_, f64>, k: usize) -> Vec<RetrievedFrame> {
        self.retrieved(&self.search.nearest(latent, k, None))
    }

    /// The search over all frames under a metric.
    ///
    /// # Errors
    /// [`Error::Adapter`] when the adapter does not support the metric, for instance without an
    /// error covariance.
    pub fn search(&self, metric: RetrievalMetric) -> Result<&Search, Error> {
        if metric == RetrievalMetric::Full {
            return Ok(&self.search);
        }

        let cell = &self.other_searches[metric as usize];
        if let Some(search) = cell.get() {
            return Ok(search);
        }

        // Check again under the lock: another thread may have built the search meanwhile. The lock
        // guards no data, so poisoning is harmless.
        let _building = self.building.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(search) = cell.get() {
            return Ok(search);
        }

        let search = Search::new(self.kind, metric, &self.adapter, self.latents.view())?;
        Ok(cell.get_or_init(|| search))
    }

    /// A stepper for this room. A refit is fitted on first use and cached.
    ///
    /// # Errors
    /// As [`Stepper::new`]; [`Error::Pairs`] when the room has no pairs to fit a refit on.
    pub fn stepper(&self, kind: StepKind, fit_on: FitOn) -> Result<Arc<Stepper>, Error> {
        let StepKind::Refit(refit) = kind else {
            return Ok(Arc::new(self.fit(kind, &[], &[])?));
        };

        // The lock is held while a refit is fitted, so that two callers do not both fit it.
        let mut refits = self.refits.lock().unwrap_or_else(PoisonError::into_inner);
        let known = refits
            .iter()
            .find(|(other, other_fit_on, _)| *other == refit && *other_fit_on == fit_on);
        if let Some((_, _, stepper)) = known {
            return Ok(stepper.clone());
        }

        let FitOn { split, stride } = fit_on;
        let timeline = self.room.timeline();
        let stepper = if refit.in_sample {
            self.fit(kind, &[], &split.test_pairs(timeline, stride)?)?
        } else {
            self.fit(kind, &split.train_pairs(timeline, stride)?, &[])?
        };

        let stepper = Arc::new(stepper);
        if refits.len() == MOST_REFITS {
            refits.remove(0);
        }
        refits.push((refit, fit_on, stepper.clone()));
        Ok(stepper)
    }

    fn fit(&self, kind: StepKind, train: &[Pair], test: &[Pair]) -> Result<Stepper, Error> {
        let data = RefitData {
            latents: self.latents.view(),
            poses: self.room.poses(),
            train,
            test,
        };

        Stepper::new(kind, &self.adapter, data)
    }

    /// The latent, the frame and the pose of a source.
    ///
    /// # Errors
    /// [`Error::SourceFrame`] for an unknown frame, [`Error::Adapter`] for an invalid feature or
    /// latent.
    pub fn start(&self, source: &Source, pose: Option<Pose>) -> Result<Start, Error> {
        match source {
            Source::Frame(frame) => {
                let pose = *self.room.pose(*frame).map_err(Error::SourceFrame)?;
                let latent = self.latents.row(frame.row()).to_owned();

                Ok(Start {
                    latent,
                    frame: Some(*frame),
                    pose: Some(pose),
                })
            }
            Source::Feature(feature) => Ok(Start {
                latent: self.adapter.embed_one(feature)?,
                frame: None,
                pose,
            }),
            Source::Latent(latent) => {
                self.adapter.check_latent(latent)?;

                Ok(Start {
                    latent: Array1::from(latent.clone()),
                    frame: None,
                    pose,
                })
            }
        }
    }

    /// Answers a query: walks its motions in order and returns the frames retrieved at every step.
    ///
    /// # Errors
    /// [`Error`] when the query is over a limit, invalid for the room or the adapter, or cancelled.
    pub fn answer(
        &self,
        query: &Query,
        limits: Limits,
        cancel: &Cancellation,
    ) -> Result<Answer, Error> {
        query.check(limits)?;
        let start = self.start(&query.source.source, query.source.pose)?;
        let twists = self.twists(&query.motion, &start)?;
        let (step, metric) = match query.method {
            Method::Latent(step, metric) => (step, metric),
            Method::Relational => return self.relational_answer(query, &start, &twists, cancel),
        };
        let stepper = self.stepper(step, query.fit_on)?;
        let space = Space {
            stepper: &stepper,
            search: self.search(metric)?,
            ..self.space(&stepper)
        };

        let plan = plan_of(query);

        let mut steps = Vec::new();
        let mut from = start.clone();
        let mut wanted = start.pose;

        // Each motion is one leg. A leg starts where the previous leg arrived. Its goal is computed
        // from the previous leg's goal, so that a closed loop corrects the error of earlier legs.
        for twist in twists {
            let previous_goal = wanted;
            let leg = Leg {
                motion: twist,
                goal: previous_goal.map(|pose| pose * exp(&twist)),
            };
            let walked = walk(space, &from, leg, plan, cancel)?;

            for (done, step) in (1usize..).zip(walked) {
                // The requested pose after step n of S is previous_goal · exp(n ξ / S), with ξ the
                // motion.
                let walked_so_far = twist.times(done).divided(query.steps);
                wanted = previous_goal.map(|pose| pose * exp(&walked_so_far));

                from = query
                    .mode
                    .next_start(&from, &step.latent, step.neighbors[0].frame, space);
                steps.push(AnswerStep {
                    latent: Some(step.latent),
                    ..self.answer_step(&step.neighbors, start.pose, wanted)
                });
            }
        }

        Ok(Answer {
            steps,
            motion: whole_motion(start.pose, wanted),
        })
    }

    /// Answers a query with the relational reader.
    fn relational_answer(
        &self,
        query: &Query,
        start: &Start,
        twists: &[Twist],
        cancel: &Cancellation,
    ) -> Result<Answer, Error> {
        let space = self.relational_space(&self.search)?;

        // A frame's cells are in the room; those of a feature are computed.
        let given = match &query.source.source {
            Source::Frame(_) => None,
            Source::Feature(feature) => {
                let row = ArrayView1::from(feature.as_slice()).insert_axis(Axis(0));
                Some(space.reader.cells(row)?)
            }
            Source::Latent(_) => return Err(Error::ViewNeeded),
        };
        let source = RelationalView {
            cells: given.as_ref().unwrap_or(space.cells),
            image: start.frame.map_or(0, FrameId::row),
            latent: &start.latent,
        };

        let mut steps: Vec<AnswerStep> = Vec::new();
        let mut wanted = start.pose;
        let mut source_from_leg = Pose::identity();
        for &twist in twists {
            let previous_goal = wanted;

            // An open loop compares every step with the source; the other modes continue from the
            // frame that the last leg retrieved.
            let arrived = steps.last().map(|step| step.frames[0].neighbor.frame);
            let at = arrived.filter(|_| query.mode != Mode::OpenLoop);
            let latent = at.map(|frame| self.latents.row(frame.row()).to_owned());
            let view = match (at, &latent) {
                (Some(frame), Some(latent)) => RelationalView {
                    cells: space.cells,
                    image: frame.row(),
                    latent,
                },
                _ => source,
            };

            let walked = relational_walk(
                &RelationalWalk {
                    space,
                    latents: self.latents.view(),
                    poses: self.room.poses(),
                    start: view,
                    start_frame: at.or(start.frame),
                    start_pose: at.map_or(start.pose, |f| Some(self.room.poses()[f.row()])),
                    leg: twist,
                    goal: previous_goal.map(|pose| pose * exp(&twist)),
                    source_from_leg,
                    plan: plan_of(query),
                },
                cancel,
            )?;

            for (done, neighbors) in (1usize..).zip(walked) {
                let walked_so_far = twist.times(done).divided(query.steps);
                wanted = previous_goal.map(|pose| pose * exp(&walked_so_far));
                steps.push(self.answer_step(&neighbors, start.pose, wanted));
            }
            source_from_leg *= exp(&twist);
        }

        Ok(Answer {
            steps,
            motion: whole_motion(start.pose, wanted),
        })
    }

    /// The data of a walk over all frames of the room, with search under [`RetrievalMetric::Full`].
    pub fn space<'a>(&'a self, stepper: &'a Stepper) -> Space<'a> {
        Space {
            adapter: &self.adapter,
            stepper,
            latents: self.latents.view(),
            poses: self.room.poses(),
            search: &self.search,
        }
    }

    fn twists(&self, motion: &RequestedMotion, start: &Start) -> Result<Vec<Twist>, Error> {
        let target = match motion {
            RequestedMotion::Twists(twists) => return Ok(twists.clone()),
            RequestedMotion::TargetFrame(frame) => {
                *self.room.pose(*frame).map_err(Error::TargetFrame)?
            }
            RequestedMotion::TargetPose(pose) => *pose,
        };

        let source = start.pose.ok_or(Error::PoseNeeded { what: "a target" })?;
        let twist = body_twist(&source, &target);
        check_twist(twist, 0)?;

        Ok(vec![twist])
    }

    fn answer_step(
        &self,
        neighbors: &[Neighbor],
        source: Option<Pose>,
        requested: Option<Pose>,
    ) -> AnswerStep {
        let frames = self.retrieved(neighbors);
        let error = source
            .zip(requested)
            .map(|(source, requested)| StepError::of(&source, &frames[0].pose, &requested));

        AnswerStep {
            latent: None,
            frames,
            requested_pose: requested,
            error,
        }
    }

    fn retrieved(&self, neighbors: &[Neighbor]) -> Vec<RetrievedFrame> {
        neighbors
            .iter()
            .map(|&neighbor| RetrievedFrame {
                neighbor,
                pose: self.room.poses()[neighbor.frame.row()],
            })
            .collect()
    }
}

fn plan_of(query: &Query) -> Plan {
    Plan {
        mode: query.mode,
        steps: query.steps,
        top_k: query.top_k as usize,
        exclude_source: query.exclude_source,
    }
}

/// All motions as one twist, from the source to the last requested pose; `None` if a pose is
/// unknown or the logarithm is not unique.
fn whole_motion(source: Option<Pose>, wanted: Option<Pose>) -> Option<Twist> {
    let motion = source.zip(wanted).map(|(from, to)| body_twist(&from, &to));
    motion.filter(|twist| twist.is_unique_logarithm())
}

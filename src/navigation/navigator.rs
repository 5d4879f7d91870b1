//! One room, ready to answer.

use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use ndarray::{Array1, Array2, ArrayView1, ArrayView2};

use super::{
    Displacement, Error, FitOn, Ground, IndexKind, Leg, Limits, Metric, Plan, Query, Search,
    Source, Space, Start, StepKind, Stepper, check_twist, walk,
};
use crate::adapter::Adapter;
use crate::cancel::Cancellation;
use crate::features::Features;
use crate::geometry::{Pose, PoseError, Twist, body_twist, exp};
use crate::index::{Audit, Neighbour};
use crate::room::Room;

/// A retrieved frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hit {
    /// The frame and its distance to the latent that was looked for.
    pub neighbour: Neighbour,
    /// Its pose, `world_from_camera`.
    pub pose: Pose,
}

/// One step of an answer.
#[derive(Debug, Clone, PartialEq)]
pub struct AnswerStep {
    /// ĝ, the latent that was looked for.
    pub latent: Array1<f64>,
    /// The frames nearest to it; at least one.
    pub hits: Vec<Hit>,
    /// Where the step should have arrived, `world_from_camera`, if the source's pose is known.
    pub requested_pose: Option<Pose>,
    /// The nearest frame's error against it.
    pub error: Option<StepError>,
}

/// How far a step's nearest frame is from where it should have arrived.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepError {
    /// As distance and angle.
    pub pose: PoseError,
    /// ‖ΔP_requested − ΔP_retrieved‖₂, both from the source: what Hit@ε compares with ε.
    pub twist: f64,
}

impl StepError {
    /// The error of a found pose where another was wanted, for a camera that started at `source`;
    /// all `world_from_camera`.
    pub fn of(source: &Pose, found: &Pose, wanted: &Pose) -> Self {
        let difference =
            body_twist(source, wanted).to_vector() - body_twist(source, found).to_vector();
        Self {
            pose: PoseError::between(found, wanted),
            twist: difference.norm(),
        }
    }
}

/// What a navigator answers.
#[derive(Debug, Clone, PartialEq)]
pub struct Answer {
    /// All steps in order.
    pub steps: Vec<AnswerStep>,
    /// The whole motion that was asked for, in the source's body frame, if its logarithm is unique.
    pub displacement: Option<Twist>,
}

/// One room under one adapter: latents of all frames and an index over them. Immutable.
pub struct Navigator {
    room: Arc<Room>,
    adapter: Arc<Adapter>,
    latents: Array2<f64>,
    kind: IndexKind,
    search: Search,
    /// Of the metrics but the first, made when they are first asked for.
    other_searches: [OnceLock<Search>; 4],
    making: Mutex<()>,
}

impl Navigator {
    /// Embeds a room's features and indexes them.
    ///
    /// # Errors
    /// [`Error::FeatureRows`], or [`Error::Adapter`] when the features are not the adapter's.
    pub fn new(
        room: Arc<Room>,
        features: &Features,
        adapter: Arc<Adapter>,
        kind: IndexKind,
    ) -> Result<Self, Error> {
        adapter.check_source(features.source())?;
        let frame_count = room.frame_count();
        let rows = features.rows().nrows();
        if rows != frame_count {
            return Err(Error::FeatureRows {
                room: room.id().clone(),
                frame_count,
                rows,
            });
        }

        let latents = adapter.embed(features.rows())?;
        let search = Search::new(kind, Metric::Full, &adapter, latents.view())?;

        Ok(Self {
            room,
            adapter,
            latents,
            kind,
            search,
            other_searches: Default::default(),
            making: Mutex::new(()),
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

    /// What was measured of an approximate index; none for the exact scan.
    pub fn audit(&self) -> Option<Audit> {
        self.search.audit()
    }

    /// The `k` frames nearest to a latent, by all its coordinates.
    pub fn nearest(&self, latent: ArrayView1<'_, f64>, k: usize) -> Vec<Hit> {
        self.hits(&self.search.nearest(latent, k, None))
    }

    /// All frames under a metric.
    ///
    /// # Errors
    /// [`Error::Adapter`] when the metric needs what the adapter lacks.
    pub fn search(&self, metric: Metric) -> Result<&Search, Error> {
        let other = match metric {
            Metric::Full => return Ok(&self.search),
            Metric::RowSpace => 0,
            Metric::Whitened => 1,
            Metric::Motion => 2,
            Metric::Calibrated => 3,
        };

        let place = &self.other_searches[other];
        if let Some(made) = place.get() {
            return Ok(made);
        }

        // One caller makes it; a poisoned lock guards nothing that could be broken.
        let _making = self.making.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(made) = place.get() {
            return Ok(made);
        }

        let made = Search::new(self.kind, metric, &self.adapter, self.latents.view())?;
        Ok(place.get_or_init(|| made))
    }

    /// A way to step in this room.
    ///
    /// # Errors
    /// As [`Stepper::new`]; [`Error::Pairs`] when the room has no pair to fit a refit on.
    pub fn stepper(&self, kind: StepKind, fit_on: FitOn) -> Result<Stepper, Error> {
        let FitOn { split, stride } = fit_on;
        let timeline = self.room.timeline();
        let mut train = Vec::new();
        let mut test = Vec::new();

        match kind {
            StepKind::Refit(refit) if refit.in_sample => {
                test = split.test_pairs(timeline, stride)?
            }
            StepKind::Refit(_) => train = split.train_pairs(timeline, stride)?,
            _ => {}
        }

        let ground = Ground {
            latents: self.latents.view(),
            poses: self.room.poses(),
            train: &train,
            test: &test,
        };

        Stepper::new(kind, &self.adapter, ground)
    }

    /// The latent, the frame and the pose of a source.
    ///
    /// # Errors
    /// [`Error::SourceFrame`] for an unknown frame, [`Error::Adapter`] for a feature or latent that
    /// does not fit.
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

    /// Navigates.
    ///
    /// # Errors
    /// [`Error`], naming what to change; nothing is kept of a refused question.
    pub fn answer(
        &self,
        query: &Query,
        limits: Limits,
        cancel: &Cancellation,
    ) -> Result<Answer, Error> {
        query.check(limits)?;
        let start = self.start(&query.source.source, query.source.pose)?;
        let twists = self.twists(&query.displacement, &start)?;
        let stepper = self.stepper(query.step, query.fit_on)?;
        let space = Space {
            stepper: &stepper,
            search: self.search(query.metric)?,
            ..self.space(&stepper)
        };

        let plan = Plan {
            mode: query.mode,
            steps: query.steps,
            hit_count: query.hit_count as usize,
            exclude_source: query.exclude_source,
        };

        let mut steps = Vec::new();
        let mut from = start.clone();
        let mut wanted = start.pose;
        for twist in twists {
            let begun_at = wanted;
            let leg = Leg {
                motion: twist,
                goal: begun_at.map(|pose| pose * exp(&twist)),
            };
            let walked = walk(space, &from, leg, plan, cancel)?;

            for (done, step) in (1..).zip(walked) {
                let share = Twist {
                    linear: twist.linear * f64::from(done),
                    angular: twist.angular * f64::from(done),
                };
                wanted = begun_at.map(|pose| pose * exp(&share.divided(query.steps)));

                from = self.arrived(&from, &step, query.mode);
                steps.push(self.answer_step(step, start.pose, wanted));
            }
        }

        let displacement = start
            .pose
            .zip(wanted)
            .map(|(from, to)| body_twist(&from, &to));

        Ok(Answer {
            steps,
            displacement: displacement.filter(|twist| twist.is_unique_logarithm()),
        })
    }

    /// Where frames are looked for: among all, by all coordinates.
    pub fn space<'a>(&'a self, stepper: &'a Stepper) -> Space<'a> {
        Space {
            adapter: &self.adapter,
            stepper,
            latents: self.latents.view(),
            poses: self.room.poses(),
            search: &self.search,
        }
    }

    fn twists(&self, displacement: &Displacement, start: &Start) -> Result<Vec<Twist>, Error> {
        let target = match displacement {
            Displacement::Twists(twists) => return Ok(twists.clone()),
            Displacement::TargetFrame(frame) => {
                *self.room.pose(*frame).map_err(Error::TargetFrame)?
            }
            Displacement::TargetPose(pose) => *pose,
        };

        let source = start.pose.ok_or(Error::PoseNeeded { what: "a target" })?;
        let twist = body_twist(&source, &target);
        check_twist(twist, 0)?;

        Ok(vec![twist])
    }

    /// Where the next motion begins: open loop goes on in latent space, the others from the
    /// retrieved frame.
    fn arrived(&self, from: &Start, step: &super::Step, mode: super::Mode) -> Start {
        let frame = step.neighbours[0].frame;
        match mode {
            super::Mode::OpenLoop => Start {
                latent: step.latent.clone(),
                ..from.clone()
            },
            super::Mode::Snap | super::Mode::ClosedLoop => Start {
                latent: self.latents.row(frame.row()).to_owned(),
                frame: Some(frame),
                pose: Some(self.room.poses()[frame.row()]),
            },
        }
    }

    fn answer_step(
        &self,
        step: super::Step,
        source: Option<Pose>,
        requested: Option<Pose>,
    ) -> AnswerStep {
        let hits = self.hits(&step.neighbours);
        let error = source
            .zip(requested)
            .map(|(source, requested)| StepError::of(&source, &hits[0].pose, &requested));

        AnswerStep {
            latent: step.latent,
            hits,
            requested_pose: requested,
            error,
        }
    }

    fn hits(&self, neighbours: &[Neighbour]) -> Vec<Hit> {
        neighbours
            .iter()
            .map(|&neighbour| Hit {
                neighbour,
                pose: self.room.poses()[neighbour.frame.row()],
            })
            .collect()
    }
}

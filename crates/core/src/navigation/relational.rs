//! Relational navigation: retrieves the frames to which the requested motion is most likely, by the
//! adapter's relational reader. Ours, not the paper's.
//!
//! Two stages bound the cost: the frames nearest to ĝ = φ(z) + W⁺ΔP are shortlisted, and the reader
//! compares the source view with each of them.

use ndarray::Array1;

use super::{Error, Mode, Search};
use crate::adapter::{Adapter, Cells, Reading, RelationalReader};
use crate::cancel::Cancellation;
use crate::geometry::{Pose, Twist, body_twist, exp};
use crate::index::{Exclusion, Neighbor};
use crate::room::FrameId;

/// Default number of frames that the reader compares with the source view. Rooms of up to this many
/// frames are searched completely.
///
/// `seese3 evaluate --shortlist` gives the hits by this number; docs/relational.md has them.
pub const SHORTLIST: usize = 1_024;

/// What the retrieval of a room's frames by the relational reader needs.
#[derive(Clone, Copy)]
pub struct RelationalSpace<'a> {
    /// The adapter, for the shortlist.
    pub adapter: &'a Adapter,
    /// The adapter's reader.
    pub reader: &'a RelationalReader,
    /// Cells of all frames.
    pub cells: &'a Cells,
    /// Search over the candidate frames under [`super::RetrievalMetric::Full`].
    pub search: &'a Search,
    /// Number of frames that the reader compares with the source view, at least 1.
    pub shortlist: usize,
}

/// A view that a motion starts from.
#[derive(Debug, Clone, Copy)]
pub struct RelationalView<'a> {
    /// Cells of one or more images.
    pub cells: &'a Cells,
    /// Position of the view's image in `cells`.
    pub image: usize,
    /// Latent of the view.
    pub latent: &'a Array1<f64>,
}

impl RelationalSpace<'_> {
    /// The `k` candidate frames to which `motion` from a view is most likely, the most likely first.
    /// Their distance is the negative mean log-likelihood of the motion, in nats and up to a
    /// constant.
    pub fn nearest(
        &self,
        view: RelationalView<'_>,
        motion: &Twist,
        k: usize,
        exclusion: Option<Exclusion>,
    ) -> Vec<Neighbor> {
        let step = self
            .adapter
            .step(view.latent.view(), *motion, Reading::Homogeneous, 1.0);
        let predicted = view.latent + &step;
        let shortlist = self
            .search
            .nearest(predicted.view(), self.shortlist.max(k), exclusion);

        let rows: Vec<usize> = shortlist
            .iter()
            .map(|neighbor| neighbor.frame.row())
            .collect();
        let likelihoods =
            self.reader
                .log_likelihoods(view.cells, view.image, &self.cells.select(&rows), motion);

        let mut ranked: Vec<Neighbor> = shortlist
            .iter()
            .zip(likelihoods)
            .map(|(neighbor, likelihood)| Neighbor {
                frame: neighbor.frame,
                distance: -likelihood,
            })
            .collect();
        ranked.sort_by(|a, b| {
            a.distance
                .total_cmp(&b.distance)
                .then(a.frame.cmp(&b.frame))
        });
        ranked.truncate(k);

        ranked
    }
}

/// Motion of one step of a relational walk.
///
/// An open loop always compares with the source, so its motion is the whole motion so far; the
/// other modes compare with the frame that the last step retrieved.
#[derive(Debug, Clone, Copy)]
pub struct RelationalStep {
    /// The motion of the whole leg, in the body frame of its start.
    pub leg: Twist,
    /// Steps of the leg before this one.
    pub done: u32,
    /// Steps of the leg in all, at least 1.
    pub steps: u32,
    /// `source_from_camera` at the start of the leg; the identity for the first leg.
    pub source_from_leg: Pose,
    /// The pose of the view that the step starts from, and the goal of the leg, if both are known;
    /// `world_from_camera`.
    pub poses: Option<[Pose; 2]>,
}

impl RelationalStep {
    /// The motion from the view that the step starts from.
    ///
    /// # Errors
    /// [`Error::PoseNeeded`] for a closed loop without poses.
    pub fn motion(&self, mode: Mode) -> Result<Twist, Error> {
        match (mode, self.poses) {
            (Mode::OpenLoop, _) => {
                let so_far = self.leg.times(self.done as usize + 1).divided(self.steps);
                let camera = self.source_from_leg * exp(&so_far);
                Ok(body_twist(&Pose::identity(), &camera))
            }
            (Mode::Snap, _) => Ok(self.leg.divided(self.steps)),
            (Mode::ClosedLoop, Some([at, goal])) => {
                Ok(body_twist(&at, &goal).divided(self.steps - self.done))
            }
            (Mode::ClosedLoop, None) => Err(Error::PoseNeeded {
                what: "a closed loop",
            }),
        }
    }
}

/// Walks one leg from a frame of the room, and returns the frames retrieved at every step.
///
/// # Errors
/// [`Error::NoCandidates`] when all frames are excluded, [`Error::PoseNeeded`] for a closed loop
/// without a goal, [`Error::Cancelled`] when the request was cancelled.
pub fn relational_walk(
    walk: &RelationalWalk<'_>,
    cancel: &Cancellation,
) -> Result<Vec<Vec<Neighbor>>, Error> {
    let RelationalWalk {
        space,
        latents,
        poses,
        start,
        start_frame,
        start_pose,
        leg,
        goal,
        source_from_leg,
        plan,
    } = *walk;

    let mut found: Vec<Vec<Neighbor>> = Vec::new();
    for done in 0..plan.steps {
        cancel.check()?;

        // The retrieved frame of the last step, unless the walk is an open loop.
        let last = found.last().map(|neighbors| neighbors[0].frame);
        let at = last.filter(|_| plan.mode != Mode::OpenLoop);
        let latent = at.map(|frame| latents.row(frame.row()).to_owned());
        let view = match (at, &latent) {
            (Some(frame), Some(latent)) => RelationalView {
                cells: space.cells,
                image: frame.row(),
                latent,
            },
            _ => start,
        };

        let pose = at.map_or(start_pose, |frame| Some(poses[frame.row()]));
        let step = RelationalStep {
            leg,
            done,
            steps: plan.steps,
            source_from_leg,
            poses: pose.zip(goal).map(|(at, goal)| [at, goal]),
        };
        let motion = step.motion(plan.mode)?;

        let exclusion = plan
            .exclude_source
            .zip(at.or(start_frame))
            .map(|(radius, center)| Exclusion { center, radius });
        let neighbors = space.nearest(view, &motion, plan.top_k, exclusion);
        if neighbors.is_empty() {
            return Err(Error::NoCandidates {
                frame_count: poses.len(),
            });
        }
        found.push(neighbors);
    }

    Ok(found)
}

/// The arguments of [`relational_walk`].
#[derive(Clone, Copy)]
pub struct RelationalWalk<'a> {
    /// What retrieval needs.
    pub space: RelationalSpace<'a>,
    /// Latents of all frames, shape (n, k).
    pub latents: ndarray::ArrayView2<'a, f64>,
    /// `world_from_camera` of all frames.
    pub poses: &'a [Pose],
    /// The view at the start of the leg; of an open loop, that of the source.
    pub start: RelationalView<'a>,
    /// The frame of the start, if it is one of the room.
    pub start_frame: Option<FrameId>,
    /// The pose of the start, `world_from_camera`, if known.
    pub start_pose: Option<Pose>,
    /// The motion, in the body frame at the start of the leg.
    pub leg: Twist,
    /// The goal pose of the leg, if known. Only a closed loop uses it.
    pub goal: Option<Pose>,
    /// `source_from_camera` at the start of the leg, for an open loop of several legs.
    pub source_from_leg: Pose,
    /// Number of steps, their mode and the retrieval.
    pub plan: super::Plan,
}

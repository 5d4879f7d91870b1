//! A partly mapped room, with the queries to planners and their answers.

use std::sync::Arc;

use ndarray::Array1;

use seese3_core::adapter::Adapter;
use seese3_core::features::Features;
use seese3_core::geometry::Pose;
use seese3_core::navigation::{IndexKind, Navigator, Pursuit};
use seese3_core::room::{FrameId, Room};
use seese3_core::splits::HoldOut;
use seese3_core::training::RoomData;
use seese3_robot::fitting::{FitRun, RoomReader, fit};
use seese3_robot::planning::{Hops, LEAST_ARRIVAL_PROBABILITY, Route, RouteBounds};
use seese3_robot::tracking::Map;

use super::{Error, Within, check_hold_out};

/// Settings of an evaluation, besides the rooms and the adapter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlanningProtocol {
    /// Which frames are mapped, and which are used as query views.
    pub hold_out: HoldOut,
    /// Number of queries per room.
    pub questions: usize,
    /// The longest hop, ‖(v, ω)‖ with meters and radians mixed. `None` uses the adapter's own,
    /// which the pose-graph planners exceed if there is no other path.
    pub longest_hop: Option<f64>,
    /// Seed of the random queries.
    pub seed: u64,
    /// Whether an adapter is fitted to the mapped frames, starting from the given adapter's
    /// weights. Our planner then locates the query view with it.
    pub is_fitted: bool,
}

/// The answer of a planner.
#[derive(Debug, Clone, PartialEq)]
pub struct PlannedWay {
    /// The planner's estimate of the camera pose, `world_from_camera`.
    pub start: Pose,
    /// The poses to drive to, in order, `world_from_camera`.
    pub poses: Vec<Pose>,
    /// Whether the planner reports that the goal is reached.
    pub says_reached: bool,
    /// The planner's probability that the robot ends within the tolerance, if it estimates one.
    pub probability: Option<f64>,
}

/// The mapped part of a room, as planners see it.
pub struct MappedRoom {
    /// Navigator over the mapped frames alone.
    pub navigator: Arc<Navigator>,
    /// Raw features of the mapped frames, row by frame.
    pub features: Features,
    /// The map; `None` if the adapter is not calibrated.
    pub(super) map: Option<Map>,
    /// Pose estimator of the adapter fitted to the mapped frames, if one was fitted.
    pub(super) reader: Option<RoomReader>,
    pub(super) pursuit: Pursuit,
    pub(super) bounds: RouteBounds,
}

/// A query to the planners.
pub struct PlanningQuestion {
    /// Raw feature of the camera's view, shape (d,).
    pub feature: Vec<f32>,
    /// Latent of the view, shape (k,).
    pub latent: Array1<f64>,
    /// The goal, a frame of the mapped room.
    pub goal: FrameId,
}

impl MappedRoom {
    /// Maps the frames of the protocol's hold-out, and fits an adapter to them if
    /// [`PlanningProtocol::is_fitted`].
    ///
    /// # Errors
    /// [`Error`] if the room is too small, or its features do not match the adapter.
    pub fn new(
        data: &RoomData<'_>,
        adapter: &Arc<Adapter>,
        protocol: &PlanningProtocol,
    ) -> Result<Self, Error> {
        check_hold_out(data.room, protocol.hold_out)?;
        let what = || format!("room '{}'", data.room.id());
        let rows = rows(&protocol.hold_out.mapped(data.room.timeline()));
        let frames = data.room.frames().select(&rows);
        let room = Room::new(
            data.room.id().clone(),
            frames,
            data.room.provenance().clone(),
        );
        let room = Arc::new(room.map_err(|problem| Error::Input(problem.to_string()))?);
        let features = data.features.select(&rows);

        let navigator = Navigator::new(room, &features, adapter.clone(), IndexKind::Exact);
        let navigator = Arc::new(navigator.within(what)?);
        let map = match adapter.error_model() {
            Some(_) => {
                let mapped = all_frames(&navigator);
                let map = Map::new(navigator.clone(), &mapped).within(what)?;
                Some(map.with_features(features.rows(), &mapped))
            }
            None => None,
        };

        let reader = if protocol.is_fitted {
            let data = RoomData {
                room: navigator.room(),
                revision: data.revision,
                features: &features,
            };
            let mapped = all_frames(&navigator);
            let fitted = fit(&data, &mapped, Some(adapter), 0, FitRun::UNWATCHED).within(what)?;
            let reader = RoomReader::new(&data, &mapped, Some(adapter.clone()), &fitted);
            Some(reader.within(what)?)
        } else {
            None
        };

        let own = Pursuit::of(&navigator);
        Ok(Self {
            pursuit: Pursuit {
                step: protocol.longest_hop.unwrap_or(own.step),
                ..own
            },
            bounds: RouteBounds {
                hops: protocol
                    .longest_hop
                    .map_or(Hops::Preferably(own.step), Hops::AtMost),
                tolerance_m: own.tolerance_m,
                tolerance_rad: own.tolerance_rad,
                least_arrival_probability: LEAST_ARRIVAL_PROBABILITY,
            },
            navigator,
            features,
            map,
            reader,
        })
    }

    /// The poses of the mapped frames, `world_from_camera`.
    pub fn poses(&self) -> &[Pose] {
        self.navigator.room().poses()
    }

    /// Step size and tolerances of the latent planner.
    pub fn pursuit(&self) -> &Pursuit {
        &self.pursuit
    }

    /// Bounds of the pose-graph planners: hop length, tolerances and arrival probability.
    pub fn bounds(&self) -> RouteBounds {
        self.bounds
    }

    /// The poses of a route's frames.
    pub fn poses_of(&self, route: &Route) -> Vec<Pose> {
        let pose = |frame: &FrameId| self.poses()[frame.row()];
        route.frames.iter().map(pose).collect()
    }
}

pub(super) fn rows(frames: &[FrameId]) -> Vec<usize> {
    frames.iter().map(|frame| frame.row()).collect()
}

pub(super) fn all_frames(navigator: &Navigator) -> Vec<FrameId> {
    (0..navigator.room().frame_count() as u32)
        .map(FrameId)
        .collect()
}

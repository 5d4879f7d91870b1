//! A partly mapped room, and what planners are asked and answer in it.

use std::sync::Arc;

use ndarray::Array1;

use seese3_core::adapter::Adapter;
use seese3_core::features::Features;
use seese3_core::geometry::Pose;
use seese3_core::navigation::{IndexKind, Navigator, Pursuit};
use seese3_core::room::{FrameId, Room};
use seese3_core::splits::HoldOut;
use seese3_core::training::RoomData;
use seese3_robot::fitting::{RoomReader, fit};
use seese3_robot::planning::{Hops, LEAST_ARRIVAL_PROBABILITY, Route, RouteBounds};
use seese3_robot::tracking::Map;

use super::{Error, Within};

/// What decides an evaluation besides the rooms and the adapter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlanningProtocol {
    /// Which frames are mapped, and which views are asked about.
    pub hold_out: HoldOut,
    /// Questions in each room.
    pub questions: usize,
    /// The longest hop, ‖(v, ω)‖ with metres and radians mixed. None takes the adapter's own, which
    /// ours and the pose graph exceed where there is no other way.
    pub longest_hop: Option<f64>,
    /// Of the questions.
    pub seed: u64,
    /// Whether an adapter is fitted to the mapped frames, from the given one's weights, and tells
    /// ours where a view is.
    pub is_fitted: bool,
}

/// What a planner answers.
#[derive(Debug, Clone, PartialEq)]
pub struct PlannedWay {
    /// Where the planner believes the camera to be, `world_from_camera`.
    pub start: Pose,
    /// The poses to drive to, in order, `world_from_camera`.
    pub poses: Vec<Pose>,
    /// Whether the planner says that the goal is reached.
    pub says_reached: bool,
    /// How probable the planner thinks it that the robot ends within the tolerance, if it says
    /// that.
    pub probability: Option<f64>,
}

/// What planners know of a room.
pub struct MappedRoom {
    /// The mapped frames as a room of their own.
    pub navigator: Arc<Navigator>,
    /// The same features, row by frame.
    pub features: Features,
    /// None if the adapter is not calibrated.
    pub(super) map: Option<Map>,
    /// Of the adapter that was fitted to the mapped frames, if one was.
    pub(super) reader: Option<RoomReader>,
    pub(super) pursuit: Pursuit,
    pub(super) bounds: RouteBounds,
}

/// A question to the planners.
pub struct PlanningQuestion {
    /// What the camera sees, shape (d,).
    pub feature: Vec<f32>,
    /// The same under the adapter, shape (k,).
    pub latent: Array1<f64>,
    /// The goal, a frame of the mapped room.
    pub goal: FrameId,
}

impl MappedRoom {
    /// Maps the frames that a protocol keeps, and fits an adapter to them if it says so.
    ///
    /// # Errors
    /// [`Error`] if the room is too small, or its features are not those of the adapter.
    pub fn new(
        data: &RoomData<'_>,
        adapter: &Arc<Adapter>,
        protocol: &PlanningProtocol,
    ) -> Result<Self, Error> {
        let what = || format!("room '{}'", data.room.id());
        let rows = rows(&protocol.hold_out.mapped(data.room.frame_count()));
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
            let fitted = fit(&data, &mapped, Some(adapter), 0, &|_| ()).within(what)?;
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

    /// What is asked of a way.
    pub fn pursuit(&self) -> &Pursuit {
        &self.pursuit
    }

    /// What is asked of a route.
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

//! Ways for a camera to drive: from what it sees to a goal in the room, over the room's frames.
//!
//! - [`BelievedStart`] says where the camera is believed to be.
//! - A [`PoseGraph`] finds the shortest way in hops.
//! - [`plan`] puts the two together, and says with which probability a camera arrives that drives the
//!   way without looking again. It plans nothing from a start that is as good as unknown.

mod arrival;
mod pose_graph;
mod start;

pub use arrival::arrival_probability;
pub use pose_graph::{Hops, NoRoute, PoseGraph, Route, RouteBounds};
pub use start::{BelievedStart, KnownRoom};

use crate::tracking::PoseWithCovariance;
use seese3_core::cancel::{Cancellation, Cancelled};
use seese3_core::geometry::Pose;
use seese3_core::navigation::Navigator;
use seese3_core::room::FrameId;

/// Unless another one is asked for, nothing is planned where the camera would arrive with a smaller
/// probability. Chosen on six calibration rooms: of 0, 0.2, 0.3, 0.5 and 0.7 the smallest with which no
/// view of another room started a way.
pub const LEAST_ARRIVAL_PROBABILITY: f64 = 0.2;

/// What comes of planning.
#[derive(Debug, Clone, PartialEq)]
pub enum Planned {
    /// There is a way.
    Way {
        /// The way.
        route: Route,
        /// The probability that a camera that drives it without looking again ends within the
        /// tolerance; none where it is not known how surely the start is.
        arrival_probability: Option<f64>,
    },
    /// The view does not tell where the camera is.
    StartUnknown(StartUnknown),
    /// The start is known, and there is no way.
    NoRoute(NoRoute),
}

/// Why a view does not tell where the camera is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum StartUnknown {
    /// It looks like no place of the room.
    FarFromRoom {
        /// Its distance over the room's limit, above 1.
        out_of_distribution: f64,
    },
    /// It looks like several places, or not much like any: not enough for this way and this tolerance.
    Unsure {
        /// With which probability a camera would arrive; below what was asked for.
        arrival_probability: f64,
    },
}

/// Plans a way over all frames of a room to a goal, `world_from_camera`.
///
/// # Errors
/// [`Cancelled`] when nobody waits for the answer any more.
pub fn plan(
    navigator: &Navigator,
    start: &BelievedStart,
    goal: &Pose,
    bounds: RouteBounds,
    cancel: &Cancellation,
) -> Result<Planned, Cancelled> {
    if let Some(out_of_distribution) = start.beyond_limit() {
        return Ok(Planned::StartUnknown(StartUnknown::FarFromRoom {
            out_of_distribution,
        }));
    }

    let poses = navigator.room().poses();
    let frames: Vec<FrameId> = (0..poses.len() as u32).map(FrameId).collect();
    let graph = PoseGraph::new(poses, &frames);
    let route = match graph.route(&start.pose, goal, bounds, cancel)? {
        Ok(route) => route,
        Err(why) => return Ok(Planned::NoRoute(why)),
    };

    let last = route
        .frames
        .last()
        .map_or(start.pose, |frame| poses[frame.row()]);
    let arrival_probability = start.covariance.map(|covariance| {
        let start = PoseWithCovariance {
            pose: start.pose,
            covariance,
        };
        arrival_probability(
            &start,
            &last,
            goal,
            bounds.tolerance_m,
            bounds.tolerance_rad,
        )
    });

    Ok(match arrival_probability {
        Some(arrival_probability) if arrival_probability < bounds.least_arrival_probability => {
            Planned::StartUnknown(StartUnknown::Unsure {
                arrival_probability,
            })
        }
        _ => Planned::Way {
            route,
            arrival_probability,
        },
    })
}

//! Route planning over a room's frames, from a view to a goal.
//!
//! - [`BelievedStart`] is the start pose: estimated from a view, recorded, or given.
//! - [`PoseGraph`] finds the shortest route: the least sum of hop lengths, each hop of bounded
//!   length.
//! - [`plan`] combines both. It computes the probability that a camera that drives the route
//!   without corrections arrives; only the error of the start pose counts. It returns no route if
//!   that probability is too low.

mod arrival;
mod pose_graph;
mod start;

pub use arrival::arrival_probability;
pub use pose_graph::{Hops, NoRoute, PoseGraph, Route, RouteBounds};
pub use start::BelievedStart;

use crate::tracking::PoseWithCovariance;
use seese3_core::cancel::{Cancellation, Cancelled};
use seese3_core::geometry::Pose;
use seese3_core::navigation::Navigator;
use seese3_core::room::FrameId;

/// Default minimum arrival probability of a planned route.
///
/// Chosen on six calibration rooms from 0, 0.2, 0.3, 0.5 and 0.7: the smallest value at which
/// views of another room never got a route.
pub const LEAST_ARRIVAL_PROBABILITY: f64 = 0.2;

/// Result of planning.
#[derive(Debug, Clone, PartialEq)]
pub enum Planned {
    /// A route was found.
    Way {
        /// The route.
        route: Route,
        /// Probability of ending within the tolerance when the route is driven open loop; `None`
        /// if the start has no covariance.
        arrival_probability: Option<f64>,
    },
    /// The start pose is unknown or too uncertain.
    StartUnknown(StartUnknown),
    /// No route leads to the goal. The certainty of the start pose was not checked.
    NoRoute(NoRoute),
}

/// Why the start pose cannot be used.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum StartUnknown {
    /// The view is out of distribution: it matches no place of the room.
    FarFromRoom {
        /// Distance of the view from the room's map, divided by the largest accepted distance;
        /// above 1. `None` if it is unknown.
        out_of_distribution: Option<f64>,
    },
    /// The start covariance is too large for this route and tolerance, for example because several
    /// places look alike.
    Unsure {
        /// Arrival probability, below the requested minimum.
        arrival_probability: f64,
    },
}

/// Plans a route over all frames of a room to `goal`, `world_from_camera`.
///
/// # Errors
/// [`Cancelled`] once `cancel` is set.
pub fn plan(
    navigator: &Navigator,
    start: &BelievedStart,
    goal: &Pose,
    bounds: RouteBounds,
    cancel: &Cancellation,
) -> Result<Planned, Cancelled> {
    if start.is_unknown() {
        return Ok(Planned::StartUnknown(StartUnknown::FarFromRoom {
            out_of_distribution: start.out_of_distribution,
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

//! The covariance inflation factor of corrected map poses.

use std::sync::Arc;

use super::Error;
use crate::tracking::{
    InitialPose, Map, Segment, Status, Tracker, TrackerSettings, replay_streams,
};
use seese3_core::adapter::Adapter;
use seese3_core::navigation::{IndexKind, Navigator};
use seese3_core::splits::HoldOut;
use seese3_core::statistics::coverage_deviation;
use seese3_core::training::RoomData;

/// Smallest factor of the search grid.
const SMALLEST_FACTOR: f64 = 0.1;
/// Ratio of successive factors of the grid.
const FACTOR_RATIO: f64 = 1.1;
/// Number of factors of the grid.
const FACTOR_COUNT: i32 = 40;

/// Finds the factor with the best coverage of reported map poses, by replaying the rooms through
/// trackers with each factor. The maps leave blocks of frames out. `None` if the tracker was never
/// localized.
///
/// # Errors
/// [`Error`] if a room cannot be mapped.
pub fn map_pose_factor(
    adapter: &Arc<Adapter>,
    rooms: &[RoomData<'_>],
) -> Result<Option<f64>, Error> {
    let mut trackers = Vec::with_capacity(rooms.len());
    for data in rooms {
        trackers.push(tracker(adapter, data)?);
    }

    let mut best: Option<(f64, f64)> = None;
    for step in 0..FACTOR_COUNT {
        let factor = SMALLEST_FACTOR * FACTOR_RATIO.powi(step);
        trackers = trackers
            .into_iter()
            .map(|tracker| tracker.with_map_pose_factor(factor))
            .collect();

        let mut surprises = Vec::new();
        for (tracker, data) in trackers.iter().zip(rooms) {
            surprises.extend(replayed_surprises(tracker, data));
        }

        if let Some(deviation) = coverage_deviation(&mut surprises)
            && best.is_none_or(|(_, least)| deviation < least)
        {
            best = Some((factor, deviation));
        }
    }

    Ok(best.map(|(factor, _)| factor))
}

fn tracker(adapter: &Arc<Adapter>, data: &RoomData<'_>) -> Result<Tracker, Error> {
    let room = Arc::new(data.room.clone());
    let mapped = HoldOut::Blocks.mapped(data.room.timeline());
    let navigator = Navigator::new(room, data.features, adapter.clone(), IndexKind::Exact)?;
    let map = Map::new(Arc::new(navigator), &mapped)?;
    let map = map.with_features(data.features.rows(), &mapped);

    Ok(Tracker::new(
        vec![Arc::new(map)],
        TrackerSettings::of(adapter),
    )?)
}

/// Squared Mahalanobis lengths of the map-pose errors of frames with status TRACKING.
fn replayed_surprises(tracker: &Tracker, data: &RoomData<'_>) -> Vec<f64> {
    let segment = Segment {
        latents: tracker.maps()[0].navigator().latents(),
        features: Some(data.features.rows()),
        poses: data.room.poses(),
        frames: &HoldOut::Blocks.tracked(data.room.timeline()),
    };

    let replayed = replay_streams(tracker, segment, data.room, InitialPose::Given);
    let is_tracking = |row: usize| replayed.updates[row].status == Status::Tracking;
    replayed.map_pose_surprises_where(is_tracking)
}

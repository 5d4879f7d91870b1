//! What a recording covers in space and time.

use crate::room::{FrameId, Room};
use crate::statistics::median;

/// What a recording covers in space and time.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct RecordingExtent {
    /// The smallest coordinates of the camera positions in the world frame, meters.
    pub min: [f64; 3],
    /// The largest coordinates, meters.
    pub max: [f64; 3],
    /// Sum over the segments of the time from the first frame to the last one, seconds; `None`
    /// without timestamps.
    pub duration_s: Option<f64>,
    /// One over the median time between successive frames of a segment, hertz; `None` without
    /// timestamps, and if no frame is later than the one before.
    pub frame_rate_hz: Option<f64>,
}

impl RecordingExtent {
    /// The extent of a room's recording.
    pub fn of(room: &Room) -> Self {
        let positions = room.poses().iter().map(|pose| pose.translation.vector);
        let limits = |limit: fn(f64, f64) -> f64| {
            let limits = positions.clone().reduce(|a, b| a.zip_map(&b, limit));
            limits.unwrap_or_default().into()
        };

        let times = room.timestamps_ns();
        let successive = (1..times.len()).filter_map(|row| {
            let [before, after] = [row - 1, row].map(|row| FrameId(row as u32));
            room.timeline()
                .joins(before, after)
                .then(|| (times[row].saturating_sub(times[row - 1])) as f64 * 1e-9)
        });
        let intervals: Vec<f64> = successive.filter(|interval| *interval > 0.0).collect();
        let median_interval = (!intervals.is_empty()).then(|| median(&intervals));

        Self {
            min: limits(f64::min),
            max: limits(f64::max),
            duration_s: (!times.is_empty()).then(|| intervals.iter().sum()),
            frame_rate_hz: median_interval.map(f64::recip),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Pose;
    use crate::room::{Frames, Provenance, RoomId};

    /// Oracle: by hand: two segments of 0.2 s and 0.1 s, with 10 frames a second.
    #[test]
    fn a_recording_has_an_extent_in_space_and_time() {
        let at = |x: f64, y: f64| Pose::translation(x, y, 1.0);
        let frames = Frames {
            poses: vec![
                at(0.0, 5.0),
                at(1.0, -2.0),
                at(3.0, 0.0),
                at(-1.0, 0.0),
                at(0.0, 0.0),
            ],
            timestamps_ns: vec![0, 100_000_000, 200_000_000, 5_000_000_000, 5_100_000_000],
            sequences: vec![0, 0, 0, 1, 1],
            ..Frames::default()
        };
        let room = |frames| Room::new(RoomId::new("a").unwrap(), frames, Provenance::default());
        let extent = RecordingExtent::of(&room(frames.clone()).unwrap());
        assert_eq!(
            (extent.min, extent.max),
            ([-1.0, -2.0, 1.0], [3.0, 5.0, 1.0])
        );
        assert!((extent.duration_s.unwrap() - 0.3).abs() < 1e-12);
        assert!((extent.frame_rate_hz.unwrap() - 10.0).abs() < 1e-9);

        let untimed = Frames {
            timestamps_ns: Vec::new(),
            ..frames
        };
        let extent = RecordingExtent::of(&room(untimed).unwrap());
        assert_eq!((extent.duration_s, extent.frame_rate_hz), (None, None));
    }
}

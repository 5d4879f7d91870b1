//! The times of a recording's frames.

use seese3_core::room::{FrameId, Room};
use seese3_core::statistics::median;

/// Default frame period of a recording without timestamps, seconds: 30 Hz.
pub const ASSUMED_PERIOD_S: f64 = 1.0 / 30.0;

/// Seconds from one frame of a room to a later one, from timestamps or else [`ASSUMED_PERIOD_S`].
pub fn seconds_between(room: &Room, from: FrameId, to: FrameId) -> f64 {
    let times = room.timestamps_ns();
    match (times.get(from.row()), times.get(to.row())) {
        (Some(from), Some(to)) => to.saturating_sub(*from) as f64 * 1e-9,
        _ => f64::from(to.0.saturating_sub(from.0)) * ASSUMED_PERIOD_S,
    }
}

/// Median frame period within sequences, seconds; [`ASSUMED_PERIOD_S`] if the recording has no
/// usable timestamps.
pub fn frame_period_s(room: &Room) -> f64 {
    let steps: Vec<f64> = (1..room.frame_count() as u32)
        .map(|row| (FrameId(row - 1), FrameId(row)))
        .filter(|(from, to)| room.timeline().joins(*from, *to))
        .map(|(from, to)| seconds_between(room, from, to))
        .collect();

    let period = median(&steps);
    if period.is_finite() && period > 0.0 {
        period
    } else {
        ASSUMED_PERIOD_S
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use seese3_core::geometry::Pose;
    use seese3_core::room::{Frames, Provenance, RoomId};

    fn room(timestamps_ns: Vec<i64>, sequences: Vec<u32>) -> Room {
        let frames = Frames {
            poses: vec![Pose::identity(); 5],
            timestamps_ns,
            sequences,
            ..Frames::default()
        };
        Room::new(RoomId::new("r").unwrap(), frames, Provenance::default()).unwrap()
    }

    /// Oracle: by hand. A pause between two sequences is not counted. A recording without
    /// timestamps, or with one for all frames, has the default of 30 Hz.
    #[test]
    fn the_period_is_that_within_sequences() {
        let tenth = 100_000_000;
        let paused = vec![0, tenth, 2 * tenth, 900 * tenth, 901 * tenth];
        let found = frame_period_s(&room(paused, vec![0, 0, 0, 1, 1]));
        assert!((found - 0.1).abs() < 1e-9);

        assert_eq!(
            frame_period_s(&room(Vec::new(), Vec::new())),
            ASSUMED_PERIOD_S
        );
        assert_eq!(
            frame_period_s(&room(vec![7; 5], Vec::new())),
            ASSUMED_PERIOD_S
        );
    }
}

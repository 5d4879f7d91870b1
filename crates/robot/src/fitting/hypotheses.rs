//! Estimates of the motion between a view and its most similar mapped frames.

use seese3_core::geometry::Twist;
use seese3_core::index::Neighbour;

/// What tells how a view's camera stands to the mapped frame that it resembles most.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MotionReader {
    /// Nothing: the view is taken to be where the mapped frame is.
    NearestFrame,
    /// The adapter that learned from other rooms.
    ZeroShot,
    /// The adapter that was fitted to this room.
    Fitted,
}

impl MotionReader {
    /// Every reader.
    pub const ALL: [Self; 3] = [Self::NearestFrame, Self::ZeroShot, Self::Fitted];

    /// Its name in reports, on the wire and on disk.
    pub fn name(self) -> &'static str {
        match self {
            Self::NearestFrame => "nearest-frame",
            Self::ZeroShot => "zero-shot",
            Self::Fitted => "fitted",
        }
    }
}

/// The reader of one part of a motion, and the share of its reading that is believed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PartRule {
    /// The reader.
    pub reader: MotionReader,
    /// The share of its reading that is believed, 0 to 1; 0 for [`MotionReader::NearestFrame`].
    pub gain: f64,
}

impl PartRule {
    /// The mapped frame's own pose.
    pub(super) const NONE: Self = Self {
        reader: MotionReader::NearestFrame,
        gain: 0.0,
    };
}

/// What the readers say of a view.
#[derive(Debug, Clone, PartialEq)]
pub struct MotionHypotheses {
    /// The mapped frame that the view resembles most.
    pub nearest: Neighbour,
    /// Its distance, in deviations of a feature column.
    pub distance: f64,
    /// The motion from it to the view, as the adapter of other rooms reads it.
    pub zero_shot: Option<Twist>,
    /// The same, as the fitted adapter reads it.
    pub fitted: Option<Twist>,
    /// How far apart the view's poses are when it is read from other mapped frames than the
    /// nearest, by the best informed reader: the median over the next ones, ‖(v, ω)‖, metres and
    /// radians mixed. The size of an error is expected from it.
    pub disagreement: f64,
}

impl MotionHypotheses {
    /// The motion that a reader says; none of a reader that is not there.
    pub fn by(&self, reader: MotionReader) -> Option<Twist> {
        match reader {
            MotionReader::NearestFrame => Some(Twist::default()),
            MotionReader::ZeroShot => self.zero_shot,
            MotionReader::Fitted => self.fitted,
        }
    }

    /// The motion whose translation and rotation come from these readers.
    pub fn combined(&self, translation: PartRule, rotation: PartRule) -> Twist {
        let read = |rule: PartRule| {
            let motion = self.by(rule.reader).unwrap_or_default();
            motion.scaled(rule.gain)
        };

        Twist {
            linear: read(translation).linear,
            angular: read(rotation).angular,
        }
    }
}

//! Estimates of the motion between a view and its most similar mapped frames.

use seese3_core::geometry::Twist;
use seese3_core::index::Neighbor;
use strum::{Display, VariantArray};

/// Source of the relative pose between a view and its most similar mapped frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Display, VariantArray)]
#[strum(serialize_all = "kebab-case")]
pub enum MotionReader {
    /// Zero motion: the pose of the mapped frame is the estimate.
    NearestFrame,
    /// The adapter trained on other rooms.
    ZeroShot,
    /// The adapter fitted to this room.
    Fitted,
}

/// Estimator and shrinkage gain for the translation or the rotation of a motion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PartRule {
    /// The estimator.
    pub reader: MotionReader,
    /// Factor on its estimate, 0 to 1; 0 for [`MotionReader::NearestFrame`] only.
    pub gain: f64,
}

impl PartRule {
    /// Zero motion from the mapped frame.
    pub(super) const NONE: Self = Self {
        reader: MotionReader::NearestFrame,
        gain: 0.0,
    };
}

/// Estimates of a view's motion from its most similar mapped frame, one per estimator.
#[derive(Debug, Clone, PartialEq)]
pub struct MotionHypotheses {
    /// Most similar mapped frame.
    pub nearest: Neighbor,
    /// Distance of that frame, in standard deviations of a feature column.
    pub distance: f64,
    /// Motion from that frame to the view, estimated by the adapter of other rooms.
    pub zero_shot: Option<Twist>,
    /// Motion from that frame to the view, estimated by the fitted adapter.
    pub fitted: Option<Twist>,
    /// Spread of the view's pose estimates, which predicts the size of the error. It is the median
    /// ‖(v, ω)‖ from the estimate relative to the nearest frame to those relative to the next
    /// frames, meters and radians mixed. The fitted adapter is used if there is one, else the
    /// zero-shot adapter.
    pub disagreement: f64,
}

impl MotionHypotheses {
    /// Motion estimated by `reader`; `None` if that adapter is missing.
    pub fn by(&self, reader: MotionReader) -> Option<Twist> {
        match reader {
            MotionReader::NearestFrame => Some(Twist::default()),
            MotionReader::ZeroShot => self.zero_shot,
            MotionReader::Fitted => self.fitted,
        }
    }

    /// Combines translation and rotation from the estimators of two rules, each times its gain.
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

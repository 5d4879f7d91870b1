//! Keypoints of an image: positions, scores and descriptors.

use nalgebra::Vector2;
use ndarray::ArrayView2;

use crate::features::FeatureSource;

/// Source of the keypoints of a room: the encoder, its outputs, and the features of the same pass.
#[derive(Debug, Clone, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct KeypointSource {
    /// Source of the features by which similar frames are retrieved; encoder and preprocessing are
    /// those of the keypoints.
    pub feature: FeatureSource,
    /// The output with the probabilities of keypoints.
    pub positions: String,
    /// The output with the reliability of the descriptors.
    pub reliability: String,
    /// The output with the descriptors.
    pub descriptors: String,
    /// Path of the model's file when the room was encoded.
    pub model_file: String,
}

/// Maximum number of keypoints of an image.
pub const MAX_KEYPOINTS: usize = 600;

/// Factor between a unit-length descriptor and its 8-bit numbers: ±0.5 becomes ±127.
const DESCRIPTOR_SCALE: f32 = 254.0;

/// The keypoints of one image, the best score first.
#[derive(Debug, Clone, PartialEq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Keypoints {
    points: Vec<Vector2<f32>>,
    scores: Vec<f32>,
    /// Row by row.
    descriptors: Vec<i8>,
}

impl Keypoints {
    /// Keypoints in descending order of their scores, at most [`MAX_KEYPOINTS`].
    ///
    /// - `points`: fractions of the image's width and height from its top left corner.
    /// - `scores`: higher is better.
    /// - `descriptors`: shape (n, d), each row of unit length. They are stored in 8 bit.
    ///
    /// # Panics
    /// If the three do not have the same number of rows.
    pub fn new(points: &[Vector2<f32>], scores: &[f32], descriptors: ArrayView2<'_, f32>) -> Self {
        assert_eq!(points.len(), scores.len());
        assert_eq!(points.len(), descriptors.nrows());

        let mut order: Vec<usize> = (0..points.len()).collect();
        order.sort_by(|&a, &b| scores[b].total_cmp(&scores[a]));
        order.truncate(MAX_KEYPOINTS);

        let quantized = |value: &f32| (value * DESCRIPTOR_SCALE).round().clamp(-127.0, 127.0) as i8;
        Self {
            points: order.iter().map(|&place| points[place]).collect(),
            scores: order.iter().map(|&place| scores[place]).collect(),
            descriptors: order
                .iter()
                .flat_map(|&place| descriptors.row(place).map(quantized))
                .collect(),
        }
    }

    /// The number of keypoints.
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// Whether the image has no keypoint.
    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// Positions, fractions of the image's width and height from its top left corner.
    pub fn points(&self) -> &[Vector2<f32>] {
        &self.points
    }

    /// Scores, in descending order.
    pub fn scores(&self) -> &[f32] {
        &self.scores
    }

    /// The number of columns of a descriptor; 0 without keypoints.
    pub fn descriptor_width(&self) -> usize {
        self.descriptors.len() / self.len().max(1)
    }

    /// The descriptor of the keypoint at `place`, in 8 bit.
    pub fn descriptor(&self, place: usize) -> &[i8] {
        let width = self.descriptor_width();
        &self.descriptors[place * width..(place + 1) * width]
    }
}

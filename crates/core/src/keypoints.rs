//! Keypoints of an image: positions, scores and descriptors.

use nalgebra::Vector2;
use ndarray::ArrayView2;

use crate::features::FeatureSource;

/// Source of the keypoints of a room: the encoder, its outputs, and the features of the same pass.
#[derive(Debug, Clone, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct KeypointSource {
    /// Source of the features of the same encoder pass; encoder and preprocessing are those of the
    /// keypoints.
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

impl KeypointSource {
    /// Whether keypoints of both sources can be matched: the same encoder, preparation and outputs.
    /// The path of the model's file does not matter.
    pub fn is_like(&self, other: &Self) -> bool {
        let outputs = |source: &Self| {
            let Self {
                positions,
                reliability,
                descriptors,
                ..
            } = source;
            [positions, reliability, descriptors].map(Clone::clone)
        };
        self.feature.is_like(&other.feature) && outputs(self) == outputs(other)
    }
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

    /// The descriptors of all keypoints, in 8 bit.
    pub fn descriptors(&self) -> impl ExactSizeIterator<Item = &[i8]> {
        let width = self.descriptor_width();
        (0..self.len()).map(move |place| &self.descriptors[place * width..(place + 1) * width])
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a failed step is a failed test")]
mod tests {
    use super::*;

    /// Oracle: the definition, worked by hand. ±0.5 is ±127, larger numbers are clamped, and the
    /// best score comes first.
    #[test]
    fn keypoints_are_sorted_and_quantized() {
        let points = [[0.1, 0.2].into(), [0.3, 0.4].into(), [0.5, 0.6].into()];
        let descriptors = ndarray::arr2(&[[0.5, 0.0], [-1.0, 0.25], [0.003, -0.5]]);
        let keypoints = Keypoints::new(&points, &[0.2, 0.9, 0.5], descriptors.view());

        assert_eq!(keypoints.points(), [points[1], points[2], points[0]]);
        assert_eq!(keypoints.scores(), [0.9, 0.5, 0.2]);
        assert_eq!(keypoints.descriptor(0), [-127, 64]);
        assert_eq!(keypoints.descriptor(1), [1, -127]);
        assert_eq!(keypoints.descriptor(2), [127, 0]);
        assert_eq!(keypoints.descriptor_width(), 2);
    }

    /// Oracle: the limit.
    #[test]
    fn only_the_best_keypoints_are_kept() {
        let count = MAX_KEYPOINTS + 10;
        let points = vec![Vector2::zeros(); count];
        let scores: Vec<f32> = (0..count).map(|place| place as f32).collect();
        let descriptors = ndarray::Array2::zeros((count, 4));
        let keypoints = Keypoints::new(&points, &scores, descriptors.view());
        assert_eq!(keypoints.len(), MAX_KEYPOINTS);
        assert_eq!(keypoints.scores()[0], (count - 1) as f32);
        assert_eq!(*keypoints.scores().last().unwrap(), 10.0);

        let none = Keypoints::new(&[], &[], ndarray::Array2::zeros((0, 4)).view());
        assert_eq!(none, Keypoints::default());
        assert_eq!((none.len(), none.descriptor_width()), (0, 0));
    }
}

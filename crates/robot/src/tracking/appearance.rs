//! Principal components of a room's features, used to retrieve mapped frames.
//!
//! Latents encode motion in any room, but distinguish the places of one room poorly. In six
//! calibration rooms with every second frame mapped, the frame nearest by latent was 0.035 m away.
//! By feature it was 0.015 m away, and by 32 components of the feature 0.017 m.

use nalgebra::SymmetricEigen;
use ndarray::{Array1, Array2, ArrayView2, ArrayViewMut1, Axis};

use seese3_core::matrices::to_nalgebra;
use seese3_core::room::FrameId;

/// Number of principal components.
pub const COMPONENTS: usize = 32;
/// Maximum number of mapped frames used for the PCA.
const SAMPLED: usize = 128;
/// Minimum number of mapped frames for the PCA.
const FEWEST: usize = 48;
/// Regularization of the component scale, as a fraction of the largest standard deviation. A
/// component is divided by the square root of (its standard deviation + this term): a compromise
/// between no scaling and whitening. Chosen on calibration rooms; it has little effect.
const LEAST_SHARE: f64 = 0.05;
/// Root mean square length of the coordinates of mapped frames.
const SPREAD: f64 = 10.0;
/// Components below this fraction of the largest variance are rounding errors.
const ROUNDING: f64 = 1e-9;
/// Largest variance of unit-length features that are identical up to rounding.
const LEAST_VARIANCE: f64 = 1e-12;
/// Number of contiguous cross-validation folds of the mapped frames.
const FOLDS: usize = 5;

/// PCA coordinates of a room's mapped frames, row by frame.
pub struct RoomAppearance {
    /// PCA of all mapped frames.
    pub appearance: Appearance,
    /// Coordinates by that PCA, shape (n, c).
    pub coordinates: Array2<f64>,
    /// Coordinates by the PCA without one fold of the mapped frames, one array per fold. They
    /// measure errors at unmapped places, since such views were not part of the PCA.
    pub without_part: Vec<Array2<f64>>,
}

impl RoomAppearance {
    /// PCA of the mapped frames of a room; `features` has shape (n, d). `None` if the frames are
    /// too few or identical.
    pub fn of(features: ArrayView2<'_, f32>, mapped: &[FrameId]) -> Option<Self> {
        let features = MappedFeatures::at_length_one(features, mapped);
        let places: Vec<usize> = (0..mapped.len()).collect();
        let appearance = Appearance::of(&features, &places)?;

        let without = |part: usize| {
            let is_of_rest = |place: &usize| part_of(*place, mapped.len()) != part;
            let rest: Vec<usize> = places.iter().copied().filter(is_of_rest).collect();
            Some(features.coordinates(&Appearance::of(&features, &rest)?))
        };

        Some(Self {
            coordinates: features.coordinates(&appearance),
            without_part: (0..FOLDS).map(without).collect::<Option<_>>()?,
            appearance,
        })
    }
}

/// Unit-length features of the mapped frames.
struct MappedFeatures<'a> {
    mapped: &'a [FrameId],
    /// Number of frames of the room, mapped or not.
    frame_count: usize,
    /// One row per mapped frame, shape (m, d).
    rows: Array2<f64>,
}

impl<'a> MappedFeatures<'a> {
    fn at_length_one(features: ArrayView2<'_, f32>, mapped: &'a [FrameId]) -> Self {
        let mut rows = Array2::zeros((mapped.len(), features.ncols()));
        for (mut row, frame) in rows.outer_iter_mut().zip(mapped) {
            row.assign(&features.row(frame.row()).mapv(f64::from));
            to_length_one(&mut row);
        }

        Self {
            mapped,
            frame_count: features.nrows(),
            rows,
        }
    }

    /// Coordinates, one row per frame of the room, shape (n, c); zero for frames that are not
    /// mapped.
    fn coordinates(&self, appearance: &Appearance) -> Array2<f64> {
        let Appearance { mean, components } = appearance;
        let of_mapped = self.rows.dot(&components.t()) - components.dot(mean);

        let mut coordinates = Array2::zeros((self.frame_count, components.nrows()));
        for (row, frame) in of_mapped.outer_iter().zip(self.mapped) {
            coordinates.row_mut(frame.row()).assign(&row);
        }
        coordinates
    }
}

/// Fold of the mapped frame at index `place` of `count`.
pub fn part_of(place: usize, count: usize) -> usize {
    place * FOLDS / count
}

/// Scaled PCA of features: nearby views of one room have nearby coordinates.
#[derive(Debug, Clone)]
pub struct Appearance {
    /// Mean of the unit-length features, shape (d,).
    mean: Array1<f64>,
    /// Scaled components, one per row, shape (c, d). Row products are five times as fast as column
    /// products, and are computed for every frame.
    components: Array2<f64>,
}

impl Appearance {
    /// PCA of the mapped frames at these indices. `None` if they are too few or identical.
    fn of(features: &MappedFeatures<'_>, places: &[usize]) -> Option<Self> {
        let every = places.len().div_ceil(SAMPLED).max(1);
        let sampled: Vec<usize> = places.iter().copied().step_by(every).collect();
        if sampled.len() < FEWEST {
            return None;
        }

        let mut centered = features.rows.select(Axis(0), &sampled);
        let mean = centered.mean_axis(Axis(0))?;
        centered -= &mean;

        // The Gram matrix of the frames has the same nonzero eigenvalues as the larger covariance
        // of the columns.
        let count = sampled.len() as f64;
        let products = centered.dot(&centered.t()) / count;
        let eigen = SymmetricEigen::new(to_nalgebra(products.view()));
        let mut order: Vec<usize> = (0..sampled.len()).collect();
        order.sort_by(|a, b| eigen.eigenvalues[*b].total_cmp(&eigen.eigenvalues[*a]));

        let largest = eigen.eigenvalues[order[0]];
        if !(largest.is_finite() && largest > LEAST_VARIANCE) {
            return None;
        }
        order.retain(|place| eigen.eigenvalues[*place] > ROUNDING * largest);
        order.truncate(COMPONENTS);

        // A component is a weighted sum of centered frames. The weights give it unit length,
        // divided by the square root of its scale.
        let mut weights = Array2::zeros((sampled.len(), order.len()));
        let mut mean_square = 0.0;
        for (mut column, place) in weights.columns_mut().into_iter().zip(order) {
            let variance = eigen.eigenvalues[place];
            let scale = variance.sqrt() + LEAST_SHARE * largest.sqrt();
            mean_square += variance / scale;

            let length = (count * variance * scale).sqrt();
            let vector = eigen.eigenvectors.column(place);
            column.assign(
                &vector
                    .iter()
                    .map(|weight| weight / length)
                    .collect::<Array1<f64>>(),
            );
        }
        let mut components = weights.t().dot(&centered);
        components *= SPREAD / mean_square.sqrt();

        Some(Self { mean, components })
    }

    /// The mean, shape (d,), and the scaled components, shape (c, d).
    pub fn parts(&self) -> (&Array1<f64>, &Array2<f64>) {
        (&self.mean, &self.components)
    }

    /// The PCA of [`Appearance::parts`]; `None` if the shapes differ.
    pub fn of_parts(mean: Array1<f64>, components: Array2<f64>) -> Option<Self> {
        (components.ncols() == mean.len()).then_some(Self { mean, components })
    }

    /// Coordinates of a feature of shape (d,).
    pub fn coordinates(&self, feature: &[f32]) -> Array1<f64> {
        let mut row: Array1<f64> = feature.iter().copied().map(f64::from).collect();
        to_length_one(&mut row.view_mut());
        self.components.dot(&(row - &self.mean))
    }

    /// Approximate memory use, bytes.
    pub fn memory_bytes(&self) -> usize {
        (self.mean.len() + self.components.len()) * size_of::<f64>()
    }
}

/// Normalizes a feature to unit length; a zero feature is unchanged.
fn to_length_one(feature: &mut ArrayViewMut1<'_, f64>) {
    let length = feature.dot(feature).sqrt();
    if length > 0.0 {
        *feature /= length;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frames(count: usize) -> Vec<FrameId> {
        (0..count as u32).map(FrameId).collect()
    }

    /// Oracle: by hand. Features rotate a little in a plane and have arbitrary lengths. Nearly all
    /// variation is the sine of the angle, scaled to a root mean square of 10; lengths are ignored.
    #[test]
    fn coordinates_tell_what_varies_and_no_length() {
        let angle = |row: usize| 0.001 * (row as f64 - 49.5);
        let features = Array2::from_shape_fn((100, 3), |(row, column)| {
            let length = 1.0 + (row % 7) as f64;
            let direction = [angle(row).cos(), angle(row).sin(), 0.0];
            (length * direction[column]) as f32
        });
        let found = RoomAppearance::of(features.view(), &frames(100))
            .unwrap()
            .appearance;
        let coordinates: Vec<Array1<f64>> = features
            .outer_iter()
            .map(|row| found.coordinates(&row.to_vec()))
            .collect();

        let square = |row: &Array1<f64>| row.dot(row);
        let mean_square: f64 = coordinates.iter().map(square).sum::<f64>() / 100.0;
        assert!((mean_square.sqrt() - 10.0).abs() < 1e-3, "{mean_square}");

        // The sine is odd and the angles are symmetric, so the mean is zero.
        let sines: f64 = (0..100).map(|row| angle(row).sin().powi(2)).sum();
        let scale = 10.0 / (sines / 100.0).sqrt();
        for (row, found) in coordinates.iter().enumerate() {
            let expected = scale * angle(row).sin();
            assert!((found[0].abs() - expected.abs()).abs() < 0.05, "{row}");
        }

        let longer: Vec<f32> = features.row(3).iter().map(|x| 5.0 * x).collect();
        let off = found.coordinates(&longer) - &coordinates[3];
        assert!(off.dot(&off).sqrt() < 1e-4, "{off}");
    }

    /// Oracle: the definition: there is no PCA of identical frames or of fewer than [`FEWEST`].
    #[test]
    fn nothing_is_told_of_frames_that_are_few_or_alike() {
        let alike = Array2::from_elem((100, 5), 2.0);
        assert!(RoomAppearance::of(alike.view(), &frames(100)).is_none());
        assert!(RoomAppearance::of(Array2::zeros((100, 5)).view(), &frames(100)).is_none());

        let few = Array2::from_shape_fn((47, 5), |(row, column)| (row * column) as f32);
        assert!(RoomAppearance::of(few.view(), &frames(47)).is_none());
    }
}

//! What the views of one room differ in: the principal components of its own features.
//!
//! A latent holds what tells motion in any room, and little of what tells two places of this room
//! apart. In six calibration rooms of which every second frame was mapped the frame that was
//! nearest by its latent was .035 m off, by its feature .015 m, and by 32 components of the feature
//! .017 m.

use nalgebra::SymmetricEigen;
use ndarray::{Array1, Array2, ArrayView2, ArrayViewMut1, Axis};

use seese3_core::matrices::to_nalgebra;
use seese3_core::room::FrameId;

/// Components that are kept.
const COMPONENTS: usize = 32;
/// So many mapped frames are decomposed, at most.
const SAMPLED: usize = 128;
/// Of fewer frames nothing is told.
const FEWEST: usize = 48;
/// A component is divided by the root of its standard deviation, to which this share of the largest
/// one is added: those that vary little count for more than they would by themselves, and for less
/// than if all varied alike. Chosen on calibration rooms, where it makes little difference.
const LEAST_SHARE: f64 = 0.05;
/// The root mean square of the coordinates of mapped frames.
const SPREAD: f64 = 10.0;
/// Components with a smaller share of the largest variance are rounding.
const ROUNDING: f64 = 1e-9;
/// Features at length 1 that vary less than this, variance, are alike up to rounding.
const LEAST_VARIANCE: f64 = 1e-12;
/// Contiguous parts of the mapped frames that are left out of the components in turn.
const FOLDS: usize = 5;

/// The coordinates of mapped frames, row by frame.
pub struct RoomAppearance {
    /// By the components of all mapped frames.
    pub appearance: Appearance,
    /// By those components, shape (n, c).
    pub coordinates: Array2<f64>,
    /// By the components without one part of the mapped frames, a part each. A view of a place that
    /// was not mapped is nearer to mapped frames than one whose neighbours the components were made
    /// for.
    pub without_part: Vec<Array2<f64>>,
}

impl RoomAppearance {
    /// Of the mapped frames of a room, whose features have shape (n, d). None if they are few or
    /// all alike.
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

/// The features of mapped frames at length 1.
struct MappedFeatures<'a> {
    mapped: &'a [FrameId],
    /// How many frames the room has, mapped or not.
    frame_count: usize,
    /// A row per mapped frame, shape (m, d).
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

    /// The coordinates of the mapped frames, row by frame of the room, shape (n, c); those of other
    /// frames are zeros.
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

/// The part that the frame at this place of `count` mapped frames belongs to.
pub fn part_of(place: usize, count: usize) -> usize {
    place * FOLDS / count
}

/// Coordinates in which nearby views of one room lie near to one another.
#[derive(Debug, Clone)]
pub struct Appearance {
    /// Of the features at length 1, shape (d,).
    mean: Array1<f64>,
    /// A component per row, scaled, shape (c, d): a view's coordinates are then products of rows,
    /// which is five times as fast as products of columns, and asked for with every frame.
    components: Array2<f64>,
}

impl Appearance {
    /// The components of the mapped frames at these places. None if they are few or all alike.
    fn of(features: &MappedFeatures<'_>, places: &[usize]) -> Option<Self> {
        let every = places.len().div_ceil(SAMPLED).max(1);
        let sampled: Vec<usize> = places.iter().copied().step_by(every).collect();
        if sampled.len() < FEWEST {
            return None;
        }

        let mut centred = features.rows.select(Axis(0), &sampled);
        let mean = centred.mean_axis(Axis(0))?;
        centred -= &mean;

        // The products of frames have the same eigenvalues as those of columns, of which there are
        // more.
        let count = sampled.len() as f64;
        let products = centred.dot(&centred.t()) / count;
        let eigen = SymmetricEigen::new(to_nalgebra(products.view()));
        let mut order: Vec<usize> = (0..sampled.len()).collect();
        order.sort_by(|a, b| eigen.eigenvalues[*b].total_cmp(&eigen.eigenvalues[*a]));

        let largest = eigen.eigenvalues[order[0]];
        if !(largest.is_finite() && largest > LEAST_VARIANCE) {
            return None;
        }
        order.retain(|place| eigen.eigenvalues[*place] > ROUNDING * largest);
        order.truncate(COMPONENTS);

        // A component is a sum of centred frames: the weights make it a unit vector, divided by the
        // root of its scale.
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
        let mut components = weights.t().dot(&centred);
        components *= SPREAD / mean_square.sqrt();

        Some(Self { mean, components })
    }

    /// The coordinates of a feature of shape (d,).
    pub fn coordinates(&self, feature: &[f32]) -> Array1<f64> {
        let mut row: Array1<f64> = feature.iter().copied().map(f64::from).collect();
        to_length_one(&mut row.view_mut());
        self.components.dot(&(row - &self.mean))
    }

    /// About how much memory it holds, bytes.
    pub fn memory_bytes(&self) -> usize {
        (self.mean.len() + self.components.len()) * size_of::<f64>()
    }
}

/// Divides a feature by its length; a feature of zeros stays as it is.
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

    /// Oracle: by hand. Features turn a little in a plane, besides a length that says nothing:
    /// nearly all that varies is the sine of the angle, scaled to a root mean square of 10, and
    /// lengths do not matter.
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

        // The sines are odd in the angle, so that their mean is zero.
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

    /// Oracle: the definition: nothing can be told of frames that are few or all alike.
    #[test]
    fn nothing_is_told_of_frames_that_are_few_or_alike() {
        let alike = Array2::from_elem((100, 5), 2.0);
        assert!(RoomAppearance::of(alike.view(), &frames(100)).is_none());
        assert!(RoomAppearance::of(Array2::zeros((100, 5)).view(), &frames(100)).is_none());

        let few = Array2::from_shape_fn((47, 5), |(row, column)| (row * column) as f32);
        assert!(RoomAppearance::of(few.view(), &frames(47)).is_none());
    }
}

//! The path of a recording in feature space and in latent space, aligned to the true path.

use nalgebra::{Matrix2, SymmetricEigen};
use ndarray::{Array2, ArrayView2, Axis, s};

use seese3_core::adapter::Adapter;
use seese3_core::matrices::to_nalgebra;
use seese3_core::training::RoomData;

use super::super::Error;
use super::plane::Plane;
use crate::report::{Figure, Section, Series};

/// Adds the two pictures of a recording before and after the adapter.
pub fn add(section: &mut Section, data: &RoomData<'_>, adapter: &Adapter) -> Result<(), Error> {
    let features = data.features.rows();
    let truth = places(data);

    // σ ⊙ W maps a latent to the six motion components; the first three are the translation.
    let latents = adapter.embed(features)?;
    let coordinates = latents.slice(s![.., ..adapter.coordinate_count()]);
    let motion = coordinates.dot(&adapter.motion_of_coordinates()?.t());

    let before = main_directions(features.mapv(f64::from).view());
    let after = main_directions(motion.slice(s![.., ..3]));
    let off_if_still = off(&truth, &Array2::zeros(truth.raw_dim()));

    for (name, what, rows) in [
        ("unrolled-before.svg", "features", before),
        ("unrolled-after.svg", "σ ⊙ W φ (translation)", after),
    ] {
        let laid = laid_over(&truth, &rows);
        let off_m = off(&truth, &laid);
        let title = format!("{}: {what}", data.room.id());
        let both = vec![series("true path", &truth), series(what, &laid)];
        let picture = Figure::new(title, "meters", "meters", both).svg()?;

        let caption = format!(
            "Room {}: the true path in its plane, and the two main directions of {what} laid over it: {off_m:.2} m off (root mean \
             square); the middle of the path is {off_if_still:.2} m off",
            data.room.id()
        );
        section.picture(name, picture, caption);
    }

    Ok(())
}

/// The positions of a recording in its principal plane, meters, shape (n, 2).
fn places(data: &RoomData<'_>) -> Array2<f64> {
    let poses = data.room.poses();
    let plane = Plane::of(poses);
    Array2::from_shape_fn((poses.len(), 2), |(row, c)| plane.place(&poses[row])[c])
}

fn series(name: &str, rows: &Array2<f64>) -> Series {
    Series::line(
        name,
        rows.outer_iter().map(|row| [row[0], row[1]]).collect(),
    )
}

/// Procrustes alignment of rows (n, 2) to `truth` (n, 2): rotation, reflection if needed, and
/// scale. Both must have zero mean.
fn laid_over(truth: &Array2<f64>, rows: &Array2<f64>) -> Array2<f64> {
    let product = rows.t().dot(truth);
    let svd = Matrix2::from_fn(|r, c| product[(r, c)]).svd(true, true);
    let (Some(u), Some(v_t)) = (svd.u, svd.v_t) else {
        return Array2::zeros(rows.raw_dim());
    };

    let size: f64 = rows.iter().map(|x| x * x).sum();
    let turn = u * v_t * (svd.singular_values.sum() / size.max(f64::MIN_POSITIVE));
    rows.dot(&Array2::from_shape_fn((2, 2), |(r, c)| turn[(r, c)]))
}

/// Root mean square of the distances between corresponding rows.
fn off(truth: &Array2<f64>, rows: &Array2<f64>) -> f64 {
    let squares: f64 = (truth - rows).iter().map(|x| x * x).sum();
    (squares / truth.nrows().max(1) as f64).sqrt()
}

/// Scores of the rows on their first two principal components, shape (n, 2).
fn main_directions(rows: ArrayView2<'_, f64>) -> Array2<f64> {
    let centered = &rows - &(rows.sum_axis(Axis(0)) / rows.nrows().max(1) as f64);

    // Both Gram matrices have the same nonzero eigenvalues; decompose the smaller one.
    let wide = centered.ncols() > centered.nrows();
    let gram = if wide {
        centered.dot(&centered.t())
    } else {
        centered.t().dot(&centered)
    };
    let eigen = SymmetricEigen::new(to_nalgebra(gram.view()));

    // Sort the eigenvalues, largest variance first.
    let mut order: Vec<usize> = (0..gram.nrows()).collect();
    order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));

    // With X Xᵀ, a score is the eigenvector's entry times the singular value. With XᵀX, it is the
    // projection of the row on the eigenvector.
    let main = |which: usize, row: usize| match order.get(which) {
        None => 0.0,
        Some(&at) if wide => eigen.eigenvectors[(row, at)] * eigen.eigenvalues[at].max(0.0).sqrt(),
        Some(&at) => centered
            .row(row)
            .iter()
            .enumerate()
            .map(|(c, x)| x * eigen.eigenvectors[(c, at)])
            .sum(),
    };

    Array2::from_shape_fn((rows.nrows(), 2), |(row, which)| main(which, row))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand: a path that is rotated by 90°, mirrored and doubled aligns exactly with the
    /// true path.
    #[test]
    fn a_turned_mirrored_and_scaled_path_is_laid_over_the_true_one() {
        let truth = ndarray::array![[-1.0, -1.0], [2.0, -1.0], [-1.0, 2.0]];
        let rows = ndarray::array![[-2.0, -2.0], [-2.0, 4.0], [4.0, -2.0]];
        assert!(off(&truth, &laid_over(&truth, &rows)) < 1e-9);

        // Rotated by 90° and doubled only: unlike a reflection, a rotation is not its own inverse.
        let rows = ndarray::array![[2.0, -2.0], [2.0, 4.0], [-4.0, -2.0]];
        assert!(off(&truth, &laid_over(&truth, &rows)) < 1e-9);

        assert!((off(&truth, &Array2::zeros((3, 2))) - 2.0).abs() < 1e-12);
    }

    /// Oracle: by hand. Points along (3, 4) lie on one line. Wide rows give the same scores as tall
    /// rows, up to sign.
    #[test]
    fn the_main_direction_is_where_rows_vary_most() {
        let rows = Array2::from_shape_fn((5, 2), |(i, c)| i as f64 * [3.0, 4.0][c]);
        let found = main_directions(rows.view());
        assert!(
            ((found[(4, 0)] - found[(0, 0)]).abs() - 20.0).abs() < 1e-9
                && found.column(1).iter().all(|x| x.abs() < 1e-6)
        );

        let wide = Array2::from_shape_fn((5, 9), |(i, c)| if c < 2 { rows[(i, c)] } else { 0.0 });
        let again = main_directions(wide.view());
        assert!((found[(4, 0)].abs() - again[(4, 0)].abs()).abs() < 1e-9);
    }
}

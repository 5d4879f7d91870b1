//! Matrices between the two libraries: ndarray holds features and latents, nalgebra decomposes.

use nalgebra::DMatrix;
use ndarray::{Array2, ArrayView2};

/// The same matrix in nalgebra.
pub fn to_nalgebra(matrix: ArrayView2<'_, f64>) -> DMatrix<f64> {
    DMatrix::from_fn(matrix.nrows(), matrix.ncols(), |row, column| {
        matrix[(row, column)]
    })
}

/// The same matrix in ndarray.
pub fn to_ndarray(matrix: &DMatrix<f64>) -> Array2<f64> {
    Array2::from_shape_fn(matrix.shape(), |at| matrix[at])
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand; the libraries order their entries differently in memory, by column and by
    /// row.
    #[test]
    fn entries_keep_their_places() {
        let matrix = ndarray::array![[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]];
        let other = to_nalgebra(matrix.view());

        assert_eq!(
            other,
            DMatrix::from_row_slice(2, 3, &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
        );
        assert_eq!(to_ndarray(&other), matrix);
    }
}

//! Conversion of matrices between ndarray (features, latents) and nalgebra (decompositions).

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

/// Serialization of a symmetric matrix as its upper triangle, row by row, for `#[serde(with)]`.
#[cfg(feature = "serde")]
pub mod upper_triangle {
    use nalgebra::SMatrix;
    use serde::de::Error;
    use serde::{Deserialize, Deserializer, Serialize, Serializer};

    fn entries<const N: usize>() -> impl Iterator<Item = (usize, usize)> {
        (0..N).flat_map(|row| (row..N).map(move |column| (row, column)))
    }

    /// Writes the N(N + 1)/2 numbers of the upper triangle.
    ///
    /// # Errors
    /// Errors of the serializer.
    pub fn serialize<S: Serializer, const N: usize>(
        matrix: &SMatrix<f64, N, N>,
        serializer: S,
    ) -> Result<S::Ok, S::Error> {
        let values: Vec<f64> = entries::<N>().map(|at| matrix[at]).collect();
        values.serialize(serializer)
    }

    /// Reads N(N + 1)/2 numbers.
    ///
    /// # Errors
    /// A wrong count, and errors of the deserializer.
    pub fn deserialize<'de, D: Deserializer<'de>, const N: usize>(
        deserializer: D,
    ) -> Result<SMatrix<f64, N, N>, D::Error> {
        let values = Vec::<f64>::deserialize(deserializer)?;
        if values.len() != N * (N + 1) / 2 {
            return Err(D::Error::invalid_length(
                values.len(),
                &"N(N + 1)/2 numbers",
            ));
        }

        let mut matrix = SMatrix::zeros();
        for ((row, column), value) in entries::<N>().zip(values) {
            matrix[(row, column)] = value;
            matrix[(column, row)] = value;
        }
        Ok(matrix)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand; nalgebra is column-major, ndarray row-major.
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

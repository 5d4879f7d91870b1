//! Features: one row of encoder output per frame of a room, and a record of how they were made.

use ndarray::{Array2, ArrayView2};

/// Why a matrix of features is refused.
#[derive(Debug, thiserror::Error, PartialEq)]
#[allow(missing_docs, reason = "each variant's message says what it is")]
pub enum Error {
    #[error("features '{name}' are empty ({rows} rows, {columns} columns)")]
    Empty {
        name: String,
        rows: usize,
        columns: usize,
    },
    #[error(
        "features '{name}', row {row}, column {column} is {value}; every number must be finite"
    )]
    NotFinite {
        name: String,
        row: usize,
        column: usize,
        value: f32,
    },
    #[error("features '{name}' have {columns} columns, over the limit of {MAX_COLUMNS}")]
    TooWide { name: String, columns: usize },
}

/// The largest number of columns of a feature.
pub const MAX_COLUMNS: usize = 131_072;

/// The word that a [`FeatureSource`] holds where the origin of its features is not known.
pub const UNSPECIFIED: &str = "unspecified";

/// How a set of features was made. Features of different sources are never mixed: an adapter
/// accepts only features of the source that it was trained on.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FeatureSource {
    /// The short name under which a room holds the features, for instance `effnet-block14`.
    pub name: String,
    /// The identity of the encoder, or `unspecified` if the features were imported without one.
    pub encoder: String,
    /// The name of the layer in the model, for instance `block14`.
    pub layer: String,
    /// Where the numbering of layers starts: `0` or `1`, or `name` if the layer has a name without
    /// a number.
    pub base: String,
    /// Whether the encoder's final normalisation layer was applied to the output: `none`, `final`
    /// or `unspecified`.
    pub norm: String,
    /// How the layer's output was reduced to one row, for instance `cls`, `mean`, `grid2x2`.
    pub pooling: String,
    /// How images were prepared for the encoder, as text that ends in its own hash, or
    /// `unspecified`.
    pub preprocess: String,
    /// The number of columns of a feature.
    pub dim: usize,
}

impl FeatureSource {
    /// The source of features that were imported as bare numbers, so that only their name and width
    /// are known.
    pub fn imported(name: &str, dim: usize) -> Self {
        let unspecified = || UNSPECIFIED.to_owned();
        Self {
            name: name.to_owned(),
            encoder: unspecified(),
            layer: unspecified(),
            base: unspecified(),
            norm: unspecified(),
            pooling: unspecified(),
            preprocess: unspecified(),
            dim,
        }
    }

    /// Whether features of the two sources can be compared: every field but the name is equal.
    /// Where the encoder is unspecified, only the name tells sources apart, so it must be equal
    /// too.
    pub fn is_like(&self, other: &Self) -> bool {
        // Destructured with no `..`, so that a new field breaks the build here.
        let Self {
            name,
            encoder,
            layer,
            base,
            norm,
            pooling,
            preprocess,
            dim,
        } = self;

        // The name is left out: it is a label, and does not change the numbers.
        let alike = (encoder, layer, base, norm, pooling, preprocess, dim)
            == (
                &other.encoder,
                &other.layer,
                &other.base,
                &other.norm,
                &other.pooling,
                &other.preprocess,
                &other.dim,
            );

        alike && (encoder != UNSPECIFIED || *name == other.name)
    }
}

/// Finite features of one room: shape (n, d), row i belongs to frame i.
#[derive(Debug, Clone)]
pub struct Features {
    source: FeatureSource,
    rows: Array2<f32>,
}

impl Features {
    /// Checks the numbers. `source.dim` is set to their number of columns.
    ///
    /// # Errors
    /// [`Error::Empty`] if there is no row or no column, [`Error::TooWide`] if there are more than
    /// [`MAX_COLUMNS`] columns, [`Error::NotFinite`] for the first number that is not finite.
    pub fn new(mut source: FeatureSource, rows: Array2<f32>) -> Result<Self, Error> {
        let name = source.name.clone();
        let (row_count, columns) = rows.dim();
        if row_count == 0 || columns == 0 {
            return Err(Error::Empty {
                name,
                rows: row_count,
                columns,
            });
        }

        if columns > MAX_COLUMNS {
            return Err(Error::TooWide { name, columns });
        }

        if let Some(((row, column), &value)) =
            rows.indexed_iter().find(|(_, value)| !value.is_finite())
        {
            return Err(Error::NotFinite {
                name,
                row,
                column,
                value,
            });
        }

        source.dim = columns;
        Ok(Self { source, rows })
    }

    /// The features of the given rows, in the given order. Every row must exist.
    #[must_use]
    pub fn select(&self, rows: &[usize]) -> Self {
        Self {
            source: self.source.clone(),
            rows: self.rows.select(ndarray::Axis(0), rows),
        }
    }

    /// How the features were made.
    pub fn source(&self) -> &FeatureSource {
        &self.source
    }

    /// The numbers, shape (n, d).
    pub fn rows(&self) -> ArrayView2<'_, f32> {
        self.rows.view()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: the definition. Sources are compared by how the features were made, and by their
    /// name only if the encoder is not known.
    #[test]
    fn sources_are_alike_by_their_making() {
        let made = |name: &str, layer: &str| FeatureSource {
            encoder: "e".to_owned(),
            layer: layer.to_owned(),
            ..FeatureSource::imported(name, 3)
        };

        assert!(made("a", "block1").is_like(&made("b", "block1")));
        assert!(!made("a", "block1").is_like(&made("a", "block2")));
        assert!(FeatureSource::imported("a", 3).is_like(&FeatureSource::imported("a", 3)));
        assert!(!FeatureSource::imported("a", 3).is_like(&FeatureSource::imported("b", 3)));
    }

    /// Oracle: IEEE 754's own list of what is not finite.
    #[test]
    fn one_nan_or_infinity_is_found_and_named() {
        for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            let mut rows = Array2::zeros((3, 2));
            rows[(2, 1)] = value;
            let error = Features::new(FeatureSource::imported("f", 2), rows).unwrap_err();
            assert!(error.to_string().contains("row 2, column 1"), "{error}");
        }
    }
}

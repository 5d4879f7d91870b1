//! Features: one row of encoder output per frame of a room, with their source.

use ndarray::{Array2, ArrayView2};

/// Why features are refused.
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

/// Maximum number of columns of a feature.
pub const MAX_COLUMNS: usize = 131_072;

/// Value of the fields of a [`FeatureSource`] that are not known.
pub const UNSPECIFIED: &str = "unspecified";

/// The source of features: encoder, layer, pooling and preprocessing. Features of different sources
/// are never mixed: an adapter accepts only those of its training source.
#[derive(Debug, Clone, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct FeatureSource {
    /// Short name of the features in a room, for instance `effnet-block14`.
    pub name: String,
    /// Identity of the encoder, or `unspecified` for features imported without one.
    pub encoder: String,
    /// The name of the layer in the model, for instance `block14`.
    pub layer: String,
    /// First number of the layer numbering: `0` or `1`, or `name` for a layer name without a number
    ///
    pub base: String,
    /// Whether the encoder's final normalization layer was applied: `none`, `final` or
    /// `unspecified`.
    pub norm: String,
    /// Pooling of the layer's output to one row, for instance `cls`, `mean`, `grid2x2`.
    pub pooling: String,
    /// Image preprocessing, as text that ends in its hash, or `unspecified`.
    pub preprocess: String,
    /// The number of columns of a feature.
    #[cfg_attr(feature = "serde", serde(default))]
    pub dim: usize,
}

impl FeatureSource {
    /// The source of imported features of which only name and width are known.
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

    /// Whether features of the two sources are comparable: all fields except the name are equal. If
    /// the encoder is unspecified, the names must be equal too.
    pub fn is_like(&self, other: &Self) -> bool {
        // Destructured without `..`, so that a new field is a compile error here.
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

        // The name is only a label and does not affect the numbers.
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

/// Features of one room, finite: shape (n, d), row i belongs to frame i.
#[derive(Debug, Clone)]
pub struct Features {
    source: FeatureSource,
    rows: Array2<f32>,
}

impl Features {
    /// Validates the numbers. Sets `source.dim` to the number of columns.
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

    /// The source of the features.
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

    /// Oracle: the definition. All fields except the name are compared; the name only if the
    /// encoder is unspecified.
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

    /// Oracle: IEEE 754's values that are not finite.
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

//! Features: one row of encoder output per frame of a room, and what made them.

use ndarray::{Array2, ArrayView2};

/// What is wrong with features.
#[derive(Debug, thiserror::Error, PartialEq)]
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

/// The widest feature that is accepted.
pub const MAX_COLUMNS: usize = 65_536;

/// What is said of an origin that is not known.
pub const UNSPECIFIED: &str = "unspecified";

/// What made a set of features. Two sources never mix: an adapter answers only for the one it was
/// trained on.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FeatureSource {
    /// The short name by which a room's features are called for, for instance `effnet-block14`.
    pub name: String,
    /// The encoder, or `unspecified` when the features were imported without saying.
    pub encoder: String,
    /// The layer by the model's own name for it, for instance `block14`.
    pub layer: String,
    /// What the layer's number counts from: `0`, `1`, or `name` when the layer is only named
    ///
    pub base: String,
    /// Whether the encoder's last norm was applied to the layer: `none`, `final`, or `unspecified`
    ///
    pub norm: String,
    /// How a map became one row, for instance `cls`, `mean`, `grid2x2`.
    pub pooling: String,
    /// What was done to an image before the encoder saw it, with its own hash, or `unspecified`.
    pub preprocess: String,
    /// Columns of a feature.
    pub dim: usize,
}

impl FeatureSource {
    /// The source of features that came as numbers alone, so that only their name and width are
    /// known.
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

    /// Whether two sources give comparable numbers: made alike, whatever they are called for short.
    /// Where an origin is unspecified the name is all there is to go by, so it must be the same.
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
    /// Checks the numbers; the width in `source` is taken from them.
    ///
    /// # Errors
    /// [`Error::Empty`], [`Error::TooWide`] or [`Error::NotFinite`].
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

    /// The features of these rows, in their order. Every row must be there.
    #[must_use]
    pub fn select(&self, rows: &[usize]) -> Self {
        Self {
            source: self.source.clone(),
            rows: self.rows.select(ndarray::Axis(0), rows),
        }
    }

    /// What made them.
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

    /// Oracle: the definition: how features were made counts, what they are called does not, unless
    /// nothing else is known.
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

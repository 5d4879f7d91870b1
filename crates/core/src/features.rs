//! Features: one row of encoder output per frame of a room, with their source.

use std::borrow::Cow;

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
    #[error(
        "features '{name}' have {rows} rows and features '{first}' have {expected}; \
         joined features need one row per frame in each part"
    )]
    JoinedRows {
        first: String,
        expected: usize,
        name: String,
        rows: usize,
    },
    #[error("joined features cannot be joined again")]
    JoinedTwice,
    #[error("features '{name}' are given twice; each part of joined features must be another")]
    SamePart { name: String },
}

/// Maximum number of columns of a feature.
pub const MAX_COLUMNS: usize = 131_072;

/// Value of the fields of a [`FeatureSource`] that are not known.
pub const UNSPECIFIED: &str = "unspecified";

/// Separator of the parts in the fields of joined features. Names of features cannot contain it.
pub const JOINED: char = '+';

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
    /// The sources of the parts of joined features, in the order of the columns; empty for features
    /// of one encoder, layer and pooling.
    #[cfg_attr(
        feature = "serde",
        serde(default, skip_serializing_if = "Vec::is_empty")
    )]
    pub parts: Vec<FeatureSource>,
}

/// The cells of features that are pooled to a grid. A feature is flattened in the order (channels,
/// rows, columns).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Grid {
    /// Cells down.
    pub rows: usize,
    /// Cells across.
    pub columns: usize,
    /// Numbers per cell.
    pub channels: usize,
}

impl Grid {
    /// Number of cells.
    pub fn cells(&self) -> usize {
        self.rows * self.columns
    }
}

impl FeatureSource {
    /// The source of features that are joined column by column, in the order given. Every text
    /// field joins those of the parts with [`JOINED`].
    ///
    /// # Errors
    /// [`Error::JoinedTwice`] if a part is joined itself, [`Error::SamePart`] if two parts are the same.
    pub fn joined(parts: &[Self]) -> Result<Self, Error> {
        if parts.iter().any(|part| !part.parts.is_empty()) {
            return Err(Error::JoinedTwice);
        }
        if let [only] = parts {
            return Ok(only.clone());
        }
        let is_first = |place: usize| !parts[..place].contains(&parts[place]);
        if let Some(again) = (0..parts.len()).find(|&place| !is_first(place)) {
            let name = parts[again].name.clone();
            return Err(Error::SamePart { name });
        }

        let text = |field: fn(&Self) -> &String| {
            let fields: Vec<&str> = parts.iter().map(|part| field(part).as_str()).collect();
            fields.join(&JOINED.to_string())
        };

        Ok(Self {
            name: text(|part| &part.name),
            encoder: text(|part| &part.encoder),
            layer: text(|part| &part.layer),
            base: text(|part| &part.base),
            norm: text(|part| &part.norm),
            pooling: text(|part| &part.pooling),
            preprocess: text(|part| &part.preprocess),
            dim: parts.iter().map(|part| part.dim).sum(),
            parts: parts.to_vec(),
        })
    }

    /// The sources of the parts; for features that are not joined, the source itself.
    pub fn parts(&self) -> &[Self] {
        match self.parts.as_slice() {
            [] => std::slice::from_ref(self),
            parts => parts,
        }
    }

    /// Whether features of this source can be made of feature sets with the given sources: one of
    /// them is like it or, for joined features, like each of its parts.
    pub fn is_among(&self, sources: &[Self]) -> bool {
        let mut parts = self.parts().iter();
        parts.all(|part| sources.iter().any(|source| source.is_like(part)))
    }

    /// The cells of features that are pooled to a grid; `None` for other poolings and for joined
    /// features.
    pub fn grid(&self) -> Option<Grid> {
        let size = self.pooling.strip_prefix("grid")?;
        // What follows `@` is the number of tokens before the patches.
        let (columns, rows) = size.split('@').next()?.split_once('x')?;
        let rows: usize = rows.parse().ok()?;
        let columns: usize = columns.parse().ok()?;
        let cells = rows.checked_mul(columns).filter(|&cells| cells > 0)?;

        (self.dim.is_multiple_of(cells)).then_some(Grid {
            rows,
            columns,
            channels: self.dim / cells,
        })
    }

    /// The source of imported features of which only name and width are known.
    pub fn imported(name: &str, dim: usize) -> Self {
        let unspecified = || UNSPECIFIED.to_owned();
        Self {
            parts: Vec::new(),
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
            parts,
        } = self;

        // Joined features are compared part by part.
        if !(parts.is_empty() && other.parts.is_empty()) {
            let pairs = parts.iter().zip(&other.parts);
            return parts.len() == other.parts.len()
                && pairs.into_iter().all(|(own, other)| own.is_like(other));
        }

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

    /// The features of a source among the feature sets of one room; joined features are made of
    /// their parts. `None` if a part is missing.
    ///
    /// # Errors
    /// As [`Features::joined`].
    pub fn of_source<'a>(
        sets: &'a [Self],
        source: &FeatureSource,
    ) -> Result<Option<Cow<'a, Self>>, Error> {
        let mut found = Vec::with_capacity(source.parts().len());
        for part in source.parts() {
            let Some(set) = sets.iter().find(|set| set.source.is_like(part)) else {
                return Ok(None);
            };
            found.push(set);
        }

        match found.as_slice() {
            [only] => Ok(Some(Cow::Borrowed(*only))),
            parts => Ok(Some(Cow::Owned(Self::joined(parts)?))),
        }
    }

    /// Joins features of one room column by column, in the order given.
    ///
    /// # Errors
    /// [`Error::JoinedRows`] if a part has another number of rows than the first,
    /// [`Error::JoinedTwice`] if a part is joined itself, [`Error::TooWide`] if the result has more
    /// than [`MAX_COLUMNS`] columns, [`Error::Empty`] without parts.
    pub fn joined(parts: &[&Self]) -> Result<Self, Error> {
        let sources: Vec<FeatureSource> = parts.iter().map(|part| part.source.clone()).collect();
        let source = FeatureSource::joined(&sources)?;
        let expected = parts.first().map_or(0, |first| first.rows.nrows());

        if let Some(part) = parts.iter().find(|part| part.rows.nrows() != expected) {
            return Err(Error::JoinedRows {
                first: parts[0].source.name.clone(),
                expected,
                name: part.source.name.clone(),
                rows: part.rows.nrows(),
            });
        }

        let views: Vec<ArrayView2<'_, f32>> = parts.iter().map(|part| part.rows.view()).collect();
        let rows = ndarray::concatenate(ndarray::Axis(1), &views).unwrap_or_default();
        Self::new(source, rows)
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

    /// Oracle: by hand. Joined columns keep the order of the parts, and the joined source is like
    /// another one only if all parts are.
    #[test]
    fn joined_features_keep_their_parts() {
        let set = |name: &str, first: f32, columns: usize| {
            let rows = Array2::from_shape_fn((2, columns), |(row, column)| {
                first + (10 * row + column) as f32
            });
            let source = FeatureSource {
                encoder: "e".to_owned(),
                pooling: "grid2x1".to_owned(),
                ..FeatureSource::imported(name, columns)
            };
            Features::new(source, rows).unwrap()
        };
        let (a, b) = (set("a", 0.0, 2), set("b", 100.0, 4));

        let both = Features::joined(&[&a, &b]).unwrap();
        assert_eq!(both.source().name, "a+b");
        assert_eq!(both.source().dim, 6);
        assert_eq!(
            both.rows().row(1).to_vec(),
            [10.0, 11.0, 110.0, 111.0, 112.0, 113.0]
        );

        let swapped = Features::joined(&[&b, &a]).unwrap();
        assert!(both.source().is_like(both.source()));
        assert!(!both.source().is_like(swapped.source()) && !both.source().is_like(a.source()));
        assert_eq!(
            Features::joined(&[&both, &a]).unwrap_err(),
            Error::JoinedTwice
        );
    }

    /// Oracle: by hand. Three columns by two rows are six cells; a width that is no multiple of six
    /// is no grid.
    #[test]
    fn grids_are_read_from_the_pooling() {
        let source = |pooling: &str, dim: usize| FeatureSource {
            pooling: pooling.to_owned(),
            ..FeatureSource::imported("f", dim)
        };

        let expected = Grid {
            rows: 2,
            columns: 3,
            channels: 4,
        };
        assert_eq!(source("grid3x2", 24).grid(), Some(expected));
        assert_eq!(source("grid3x2@5", 24).grid(), Some(expected));
        for (pooling, dim) in [("grid3x2", 25), ("mean", 24), ("grid0x2", 24), ("gridx", 4)] {
            assert_eq!(source(pooling, dim).grid(), None, "{pooling} {dim}");
        }
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

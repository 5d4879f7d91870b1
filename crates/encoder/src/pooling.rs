//! Pooling: reduces the output of a layer to one row.
//!
//! An output is a vector (C), tokens (N, C) or a feature map (C, H, W). A grid holds the means over
//! cells, which are cut as by PyTorch's `adaptive_avg_pool2d`, and is flattened in the order (C,
//! rows, columns).

use std::fmt;
use std::ops::Range;
use std::str::FromStr;

use ndarray::{Array3, ArrayView2, ArrayView3, ArrayViewD, Axis, Ix1, Ix2, Ix3};

use super::Error;

/// How the output of a layer is reduced to one row.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Pooling {
    /// The output is a vector and stays as it is.
    Vector,
    /// The first token, which is the class token.
    Cls,
    /// The mean over the map, or over the tokens after the first `skip`.
    Mean {
        /// The number of tokens before the patches: the class token and registers.
        skip: usize,
    },
    /// The mean over the patch tokens of a clip's anchor image, which is at position ⌊window / 2⌋;
    /// only for encoders of clips.
    Anchor {
        /// The number of tokens before the patches.
        skip: usize,
    },
    /// Means over the cells of a map, or of the patch tokens after the first `skip`, arranged in
    /// the rows and columns of the image's patches.
    Grid {
        /// Cells across.
        columns: usize,
        /// Cells down.
        rows: usize,
        /// The number of tokens before the patches.
        skip: usize,
    },
}

/// The largest number of columns or rows of a grid.
const MOST_CELLS: usize = 64;

impl Pooling {
    /// The pooling for an output with `rank` axes. An output with a single axis is never pooled.
    pub(super) fn for_rank(self, rank: usize) -> Self {
        if rank == 1 { Self::Vector } else { self }
    }

    /// Refuses a mean or grid over all tokens if their number shows that prefix tokens (class
    /// token, registers) come before the patches.
    pub(super) fn check_prefix(self, shape: &[usize], seen: InputSize) -> Result<(), Problem> {
        let is_over_all = matches!(
            self,
            Self::Mean { skip: 0 } | Self::Anchor { skip: 0 } | Self::Grid { skip: 0, .. }
        );

        match (shape, is_over_all) {
            (&[tokens, _], true) => match seen.prefix(tokens) {
                Some(prefix) => Err(Problem::Prefix { tokens, prefix }),
                None => Ok(()),
            },
            _ => Ok(()),
        }
    }

    /// The same pooling with `skip` tokens before the patches.
    #[must_use]
    pub fn after(self, skip: usize) -> Self {
        match self {
            Self::Vector | Self::Cls => self,
            Self::Mean { .. } => Self::Mean { skip },
            Self::Anchor { .. } => Self::Anchor { skip },
            Self::Grid { columns, rows, .. } => Self::Grid {
                columns,
                rows,
                skip,
            },
        }
    }

    /// Its text without the number of skipped tokens, for the names of features.
    pub(super) fn short(self) -> String {
        self.after(0).to_string()
    }

    /// Pools the output for one clip to a row.
    pub(super) fn pool(
        self,
        output: ArrayViewD<'_, f32>,
        seen: InputSize,
    ) -> Result<Vec<f32>, Problem> {
        let shape = output.shape().to_vec();
        let wrong = || Problem::Shape {
            pooling: self,
            shape: shape.clone(),
        };

        // If all tokens fill the image's patch grid, but not without the first `skip`, the model
        // has no prefix tokens: a patch would be mistaken for one.
        if let (2, Self::Cls | Self::Mean { skip: 1.. } | Self::Grid { skip: 1.., .. }) =
            (output.ndim(), self)
        {
            let skip = if let Self::Mean { skip } | Self::Grid { skip, .. } = self {
                skip
            } else {
                1
            };
            let after = shape[0]
                .checked_sub(skip)
                .and_then(|patches| seen.patches(patches));

            if seen.patches(shape[0]).is_some() && after.is_none() {
                return Err(Problem::NoPrefix { tokens: shape[0] });
            }
        }

        match (self, output.ndim()) {
            (Self::Vector, 1) => Ok(output
                .into_dimensionality::<Ix1>()
                .map_err(|_| wrong())?
                .to_vec()),
            (Self::Cls, 2) if shape[0] > 0 => Ok(output
                .into_dimensionality::<Ix2>()
                .map_err(|_| wrong())?
                .row(0)
                .to_vec()),
            (Self::Mean { skip }, 2) if skip < shape[0] => {
                let tokens = output.into_dimensionality::<Ix2>().map_err(|_| wrong())?;

                // The tokens (N, C) become a map (C, 1, N), whose only cell is their mean.
                let patches = tokens.slice_move(ndarray::s![skip.., ..]).reversed_axes();
                Ok(grid(patches.insert_axis(Axis(1)), 1, 1))
            }
            (
                Self::Grid {
                    columns,
                    rows,
                    skip,
                },
                2,
            ) if skip < shape[0] => {
                let shape = seen.patches(shape[0] - skip).ok_or_else(wrong)?;
                let tokens = output.into_dimensionality::<Ix2>().map_err(|_| wrong())?;
                let patches = tokens.slice_move(ndarray::s![skip.., ..]);
                let map = map_of_tokens(patches, shape);
                Ok(grid(map.view(), columns, rows))
            }
            (Self::Anchor { skip }, 2) if skip < shape[0] => {
                let of_anchor = seen.anchor(shape[0] - skip).ok_or_else(wrong)?;
                let tokens = output.into_dimensionality::<Ix2>().map_err(|_| wrong())?;
                let rows = skip + of_anchor.start..skip + of_anchor.end;
                let patches = tokens.slice_move(ndarray::s![rows, ..]).reversed_axes();
                Ok(grid(patches.insert_axis(Axis(1)), 1, 1))
            }
            (Self::Mean { .. }, 3) if shape[1] * shape[2] > 0 => Ok(grid(
                output.into_dimensionality::<Ix3>().map_err(|_| wrong())?,
                1,
                1,
            )),
            (Self::Grid { columns, rows, .. }, 3) if shape[1] * shape[2] > 0 => Ok(grid(
                output.into_dimensionality::<Ix3>().map_err(|_| wrong())?,
                columns,
                rows,
            )),
            _ => Err(wrong()),
        }
    }
}

/// The input of the network: the size of its images in pixels, and the number of images in a clip.
#[derive(Debug, Clone, Copy)]
pub(super) struct InputSize {
    pub width: usize,
    pub height: usize,
    pub window: usize,
}

/// Maximum number of prefix tokens that is detected: class token, distillation token, registers.
const MOST_PREFIX_TOKENS: usize = 8;

impl InputSize {
    /// The smallest number of prefix tokens without which `tokens` fill the image's patch grid;
    /// `None` if all tokens are patches, or no number up to [`MOST_PREFIX_TOKENS`] fits.
    fn prefix(self, tokens: usize) -> Option<usize> {
        if self.patches(tokens).is_some() {
            return None;
        }

        (1..=MOST_PREFIX_TOKENS.min(tokens.saturating_sub(1)))
            .find(|prefix| self.patches(tokens - prefix).is_some())
    }

    /// Of a number of patch tokens, those of the anchor image; `None` if no token is of one image or
    /// two.
    fn anchor(self, tokens: usize) -> Option<Range<usize>> {
        // A token that covers the whole clip is not of one image.
        let (times, height, width) = self.patches(tokens).filter(|(times, ..)| *times > 1)?;
        let first = self.window / 2 * times / self.window * height * width;
        Some(first..first + height * width)
    }

    /// The shape (times, rows, columns) of a number of patch tokens, if the image can be cut into
    /// that many square patches. A token of a clip may cover two images, one image, or the whole
    /// clip.
    fn patches(self, tokens: usize) -> Option<(usize, usize, usize)> {
        let times = if self.window > 1 {
            vec![self.window / 2, self.window, 1]
        } else {
            vec![1]
        };

        times.into_iter().find_map(|times| {
            let area = tokens.is_multiple_of(times).then(|| tokens / times)?;

            // Square patches: columns / rows = width / height, so columns²
            // = area · width / height. The integer root is checked below.
            let columns = (area * self.width / self.height).isqrt();
            let rows = area.checked_div(columns)?;
            let fits = columns * rows == area && columns * self.height == rows * self.width;

            fits.then_some((times, rows, columns))
        })
    }
}

/// The map (C, rows, columns) of patch tokens (N, C), which are ordered by time, row and column.
/// `shape` is (times, rows, columns). A map has no time axis: the tokens of a clip are averaged over
/// time.
fn map_of_tokens(
    patches: ArrayView2<'_, f32>,
    (times, height, width): (usize, usize, usize),
) -> Array3<f32> {
    let mean = |c: usize, place: usize| {
        let sum: f64 = (0..times)
            .map(|t| f64::from(patches[(t * height * width + place, c)]))
            .sum();
        (sum / times as f64) as f32
    };
    Array3::from_shape_fn((patches.ncols(), height, width), |(c, y, x)| {
        mean(c, y * width + x)
    })
}

/// Means over the cells of a map (C, H, W). Cell i of n covers ⌊iH/n⌋ up to but not including
/// ⌈(i+1)H/n⌉, so that neighboring cells overlap where n does not divide H.
fn grid(map: ArrayView3<'_, f32>, columns: usize, rows: usize) -> Vec<f32> {
    let (channels, height, width) = map.dim();
    let cell = |i: usize, n: usize, length: usize| i * length / n..((i + 1) * length).div_ceil(n);
    let mut row = Vec::with_capacity(channels * columns * rows);
    for channel in map.outer_iter() {
        for down in 0..rows {
            for across in 0..columns {
                let ys = cell(down, rows, height);
                let xs = cell(across, columns, width);
                let part = channel.slice(ndarray::s![ys, xs]);
                let sum: f64 = part.iter().map(|&value| f64::from(value)).sum();
                row.push((sum / part.len() as f64) as f32);
            }
        }
    }

    row
}

/// Why an output cannot be pooled as requested.
#[derive(Debug, thiserror::Error)]
pub(super) enum Problem {
    #[error(
        "its output of shape {shape:?} cannot be pooled by '{pooling}': cls needs tokens (n, c); grids need a map (c, h, w), \
         or patch tokens in the rows and columns of the image's aspect ratio, after the prefix tokens; anchor needs such \
         tokens of a clip"
    )]
    Shape { pooling: Pooling, shape: Vec<usize> },
    #[error(
        "all its {tokens} tokens are patches of the image, with no class token before them; give --prefix-tokens 0 and \
         --pool mean or a grid"
    )]
    NoPrefix { tokens: usize },
    #[error(
        "its {tokens} tokens are {} patches of the image and {prefix} before them (a class token, registers); give \
         --prefix-tokens {prefix} to pool the patches alone, or --prefix-tokens 0 to pool all of them",
        tokens - prefix
    )]
    Prefix { tokens: usize, prefix: usize },
}

impl fmt::Display for Pooling {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let skip = match self {
            Self::Vector => return f.write_str("vector"),
            Self::Cls => return f.write_str("cls"),
            Self::Mean { skip } => {
                f.write_str("mean")?;
                *skip
            }
            Self::Anchor { skip } => {
                f.write_str("anchor")?;
                *skip
            }
            Self::Grid {
                columns,
                rows,
                skip,
            } => {
                write!(f, "grid{columns}x{rows}")?;
                *skip
            }
        };

        if skip > 0 {
            write!(f, "@{skip}")
        } else {
            Ok(())
        }
    }
}

impl FromStr for Pooling {
    type Err = Error;

    /// Reads `vector`, `cls`, `mean`, `anchor` or `gridCxR` (columns × rows). `@N` after it skips the first N
    /// tokens.
    fn from_str(text: &str) -> Result<Self, Error> {
        let wrong = || Error::Option {
            what: "pooling",
            given: text.to_owned(),
            problem: format!(
                "is not cls, mean, anchor, or gridCxR with 1 to {MOST_CELLS} columns and rows"
            )
            .into(),
        };

        let (word, skip) = match text.split_once('@') {
            Some((word, skip)) => (word, skip.parse().map_err(|_| wrong())?),
            None => (text, 0),
        };

        let pooling = match word {
            "vector" => Self::Vector,
            "cls" => Self::Cls,
            "mean" => Self::Mean { skip },
            "anchor" => Self::Anchor { skip },
            _ => {
                let cells = |text: &str| text.parse().ok().filter(|n| (1..=MOST_CELLS).contains(n));
                let grid = word
                    .strip_prefix("grid")
                    .and_then(|grid| grid.split_once('x'));
                let (columns, rows) = grid
                    .and_then(|(columns, rows)| Some((cells(columns)?, cells(rows)?)))
                    .ok_or_else(wrong)?;

                Self::Grid {
                    columns,
                    rows,
                    skip,
                }
            }
        };

        Ok(pooling)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::{Array2, ArrayD};

    const SQUARE: InputSize = InputSize {
        width: 14,
        height: 14,
        window: 1,
    };

    fn map(channels: usize, height: usize, width: usize) -> ArrayD<f32> {
        Array3::from_shape_fn((channels, height, width), |(c, y, x)| {
            (100 * c + 10 * y + x) as f32
        })
        .into_dyn()
    }

    /// Oracle: PyTorch's definition by hand. Three rows in two cells overlap in the middle one:
    /// rows 0–1 and 1–2.
    #[test]
    fn cells_overlap_where_the_map_does_not_divide() {
        let pool = |text: &str, output: ArrayD<f32>| {
            text.parse::<Pooling>().unwrap().pool(output.view(), SQUARE)
        };

        assert_eq!(
            pool("grid1x2", map(2, 3, 1)).unwrap(),
            [5.0, 15.0, 105.0, 115.0]
        );

        assert_eq!(pool("grid2x1", map(1, 2, 2)).unwrap(), [5.0, 6.0]);
        assert_eq!(pool("mean", map(2, 2, 2)).unwrap(), [5.5, 105.5]);
    }

    /// Oracle: by hand. Five tokens of two columns: a class token and a 2×2 square of patches.
    #[test]
    fn tokens_after_the_prefix_are_a_square() {
        let tokens = || Array2::from_shape_fn((5, 2), |(n, c)| (10 * c + n) as f32).into_dyn();
        let pool = |text: &str| {
            text.parse::<Pooling>()
                .unwrap()
                .pool(tokens().view(), SQUARE)
        };

        assert_eq!(pool("cls").unwrap(), [0.0, 10.0]);
        assert_eq!(pool("mean@1").unwrap(), [2.5, 12.5]);
        assert_eq!(pool("mean").unwrap(), [2.0, 12.0]);

        assert_eq!(
            pool("grid2x2@1").unwrap(),
            [1.0, 2.0, 3.0, 4.0, 11.0, 12.0, 13.0, 14.0]
        );

        assert_eq!(pool("grid2x1@1").unwrap(), [2.0, 3.0, 12.0, 13.0]);
        assert!(pool("grid2x2").is_err(), "five tokens are no square");
        assert!(pool("mean@5").is_err(), "no token is left");

        let patches = Array2::<f32>::zeros((16, 2)).into_dyn();
        for word in ["cls", "mean@1", "grid2x2@1"] {
            let problem = word
                .parse::<Pooling>()
                .unwrap()
                .pool(patches.view(), SQUARE)
                .unwrap_err()
                .to_string();

            assert!(problem.contains("--prefix-tokens 0"), "{word}: {problem}");
        }

        assert!(
            "cls"
                .parse::<Pooling>()
                .unwrap()
                .pool(map(1, 2, 2).view(), SQUARE)
                .is_err()
        );
    }

    /// Oracle: by hand. 576 tokens are 32×18 patches of a wide image and 24×24 of a square one; the
    /// tokens of a clip also have a time axis.
    #[test]
    fn tokens_lie_in_the_images_shape() {
        let seen = |width, height, window| InputSize {
            width,
            height,
            window,
        };

        assert_eq!(seen(512, 288, 1).patches(576), Some((1, 18, 32)));
        assert_eq!(seen(384, 384, 1).patches(576), Some((1, 24, 24)));
        assert_eq!(seen(512, 384, 1).patches(768), Some((1, 24, 32)));
        assert_eq!(seen(384, 384, 16).patches(8 * 576), Some((8, 24, 24)));

        assert_eq!(seen(224, 224, 1).patches(257), None);

        let prefixes = [257, 201, 197, 196].map(|tokens| seen(224, 224, 1).prefix(tokens));
        assert_eq!(
            prefixes,
            [Some(1), Some(5), Some(1), None],
            "14 and 16 pixels a patch"
        );
        assert_eq!(seen(512, 384, 1).patches(576), None);

        let wide = Array2::from_shape_fn((8, 1), |(n, _)| n as f32).into_dyn();
        let halves: Pooling = "grid2x1".parse().unwrap();
        assert_eq!(
            halves.pool(wide.view(), seen(32, 16, 1)).unwrap(),
            [2.5, 4.5],
            "four across, two down"
        );
    }

    /// Oracle: by hand. A clip of 4 images of 2×2 patches, with a class token before them. The anchor
    /// is image 2: with a token for each image its patches are tokens 9 to 12, with tokens of two
    /// images those of the second time, 5 to 8.
    #[test]
    fn the_anchor_is_the_middle_image_of_a_clip() {
        let seen = InputSize {
            window: 4,
            ..SQUARE
        };
        let anchor: Pooling = "anchor@1".parse().unwrap();
        let tokens = |count: usize| {
            let numbers = Array2::from_shape_fn((count, 1), |(n, _)| n as f32);
            numbers.into_dyn()
        };
        assert_eq!(anchor.pool(tokens(17).view(), seen).unwrap(), [10.5]);
        assert_eq!(anchor.pool(tokens(9).view(), seen).unwrap(), [6.5]);

        assert!(
            anchor.pool(tokens(10).view(), seen).is_err(),
            "one token for the clip"
        );
        assert!(
            anchor.pool(tokens(5).view(), SQUARE).is_err(),
            "a single image"
        );
    }

    /// Oracle: the syntax in the documentation.
    #[test]
    fn words_are_read_and_written() {
        for word in [
            "vector",
            "cls",
            "mean",
            "mean@5",
            "anchor",
            "anchor@1",
            "grid2x2",
            "grid16x12@1",
        ] {
            assert_eq!(word.parse::<Pooling>().unwrap().to_string(), word);
        }

        for wrong in [
            "", "max", "grid", "grid0x2", "grid2", "mean@", "grid65x1", "mean@x",
        ] {
            assert!(wrong.parse::<Pooling>().is_err(), "{wrong}");
        }
    }
}

//! Relational reader: the motion between two views from the cosine similarities of the cells of
//! their feature maps. Ours, not the paper's.
//!
//! - The adapter subtracts two averaged features, which says how much changed. The similarities of
//!   all cells say what moved where, whatever it is; this carries over to other rooms.
//! - A small network maps the similarities to a Gaussian density of the motion with a full
//!   covariance. Sideways translation and yaw look alike, so their errors are correlated; the
//!   covariance keeps what is known about their combination.
//! - Both directions are read: the motion from the second view to the first is −ΔP.
//!
//! Start reading at [`RelationalReader`].

mod cells;
mod config;
mod inputs;
mod network;
mod pairs;

pub use cells::{CellLayout, Cells};
pub use config::{RelationalConfig, train_relational};
pub use network::{PAIRS_PER_EPOCH, RelationalNetwork, RelationalSamples};
pub use pairs::{PairSampler, RoomFrames};

use nalgebra::{Matrix6, Vector6};
use ndarray::{Array2, Array3, ArrayView2, Axis};

use super::{Error, Network};
use crate::features::FeatureSource;
use crate::geometry::Twist;
use inputs::{InputLayout, of_image};
use network::{Density, OUTPUTS, TWIST_SCALE, density, in_units};

/// Maximum number of members of a reader.
pub const MAX_MEMBERS: usize = 16;

/// Pairs whose inputs are computed at a time, which bounds the memory of intermediate results.
const CHUNK: usize = 256;

/// A trained relational reader: one network or several, whose densities are averaged. Immutable.
#[derive(Debug, Clone)]
pub struct RelationalReader {
    layout: CellLayout,
    inputs: InputLayout,
    members: Vec<RelationalNetwork<f32>>,
    error_scale: Option<[f64; 2]>,
}

/// A motion with its error covariance, (v, ω) in the body frame of the first camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MotionReading {
    /// The motion, meters and radians.
    pub twist: Twist,
    /// The covariance of its error.
    pub covariance: Matrix6<f64>,
}

impl RelationalReader {
    /// Validates trained networks for features of a source.
    ///
    /// # Errors
    /// [`Error::NotAGrid`] if a part of the source is not pooled to a grid, [`Error::Members`] for
    /// no member or more than [`MAX_MEMBERS`], [`Error::WeightShape`] if a network does not fit the
    /// grids, [`Error::WeightsNotFinite`] if a weight is not finite.
    pub fn new(
        source: &FeatureSource,
        members: Vec<RelationalNetwork<f32>>,
    ) -> Result<Self, Error> {
        let layout = CellLayout::of(source)?;
        let inputs = InputLayout::of(&layout);
        if members.is_empty() || members.len() > MAX_MEMBERS {
            return Err(Error::Members {
                count: members.len(),
            });
        }

        for member in &members {
            member.check(inputs.width())?;
        }

        Ok(Self {
            layout,
            inputs,
            members,
            error_scale: None,
        })
    }

    /// The same reader with its measured error scale: factors on the predicted standard deviations
    /// of v and ω.
    ///
    /// # Errors
    /// [`Error::ErrorModel`] if a factor is not finite and positive.
    pub fn with_error_scale(mut self, factors: [f64; 2]) -> Result<Self, Error> {
        let is_sound = |factor: &f64| factor.is_finite() && *factor > 0.0;
        if !factors.iter().all(is_sound) {
            return Err(Error::ErrorModel {
                what: "the error scale of a relational reader",
            });
        }

        self.error_scale = Some(factors);
        Ok(self)
    }

    /// Factors on the predicted standard deviations of v and ω, measured in rooms outside the
    /// training set; `None` if not measured.
    pub fn error_scale(&self) -> Option<[f64; 2]> {
        self.error_scale
    }

    /// Columns of a feature.
    pub fn feature_dim(&self) -> usize {
        self.layout.feature_dim()
    }

    /// The networks.
    pub fn members(&self) -> &[RelationalNetwork<f32>] {
        &self.members
    }

    /// Cells of feature rows, shape (n, d).
    ///
    /// # Errors
    /// [`Error::FeatureDim`] if the width is another than the training features'.
    pub fn cells(&self, rows: ArrayView2<'_, f32>) -> Result<Cells, Error> {
        Cells::of(&self.layout, rows)
    }

    /// Mean log-likelihood of a motion from image `image` of `from` to each image of `to`, over
    /// members and both directions; up to a constant that is the same for all images.
    pub fn log_likelihoods(
        &self,
        from: &Cells,
        image: usize,
        to: &Cells,
        motion: &Twist,
    ) -> Vec<f64> {
        let wanted = in_units(motion);
        let back = wanted.map(|x| -x);

        let mut all = Vec::with_capacity(to.count());
        self.for_each_density(from, image, to, |there, reverse| {
            let sum: f64 = there.iter().map(|d| d.log_likelihood(&wanted)).sum();
            let sum_back: f64 = reverse.iter().map(|d| d.log_likelihood(&back)).sum();
            all.push((sum + sum_back) / (there.len() + reverse.len()) as f64);
        });

        all
    }

    /// The motion from image `image` of `from` to each image of `to`.
    ///
    /// The mean of all members and directions, weighted by their information. The covariance is the
    /// inverse of their mean information, scaled by [`RelationalReader::error_scale`] if it was
    /// measured.
    pub fn motions(&self, from: &Cells, image: usize, to: &Cells) -> Vec<MotionReading> {
        let [linear, angular] = self.error_scale.unwrap_or([1.0, 1.0]);
        let scale = |i: usize| TWIST_SCALE[i] * if i < 3 { linear } else { angular };

        let mut readings = Vec::with_capacity(to.count());
        self.for_each_density(from, image, to, |there, reverse| {
            let mut information = Matrix6::zeros();
            let mut weighted = Vector6::zeros();
            let mut add = |density: &Density, sign: f64| {
                let root = Matrix6::from_fn(|i, j| density.root[i][j]);
                let own = root.transpose() * root;
                information += own;
                weighted += own * Vector6::from_fn(|i, _| sign * density.mean[i]);
            };
            there.iter().for_each(|density| add(density, 1.0));
            reverse.iter().for_each(|density| add(density, -1.0));

            // The diagonal of each root is bounded from below, so the information is invertible.
            let inverse = information.try_inverse().unwrap_or_else(Matrix6::identity);
            let mean = inverse * weighted;
            let count = (there.len() + reverse.len()) as f64;
            readings.push(MotionReading {
                twist: Twist::from_vector(&Vector6::from_fn(|i, _| mean[i] * TWIST_SCALE[i])),
                covariance: Matrix6::from_fn(|i, j| count * inverse[(i, j)] * scale(i) * scale(j)),
            });
        });

        readings
    }

    /// Calls `each` with the densities of every image of `to`: those of the motion to it, one per
    /// member, and those of the motion back.
    fn for_each_density(
        &self,
        from: &Cells,
        image: usize,
        to: &Cells,
        mut each: impl FnMut(&[Density], &[Density]),
    ) {
        let images: Vec<usize> = (0..to.count()).collect();
        for chunk in images.chunks(CHUNK) {
            let similarities = match chunk.len() == to.count() {
                true => from.similarities(image, to),
                false => from.similarities(image, &to.select(chunk)),
            };

            let inputs = self.inputs_of(&similarities);
            let back = self.outputs(&self.reversed(&inputs));
            let there = self.outputs(&inputs);
            for place in 0..chunk.len() {
                let of = |outputs: &[Array2<f32>]| -> Vec<Density> {
                    outputs.iter().map(|all| density(all.row(place))).collect()
                };
                each(&of(&there), &of(&back));
            }
        }
    }

    /// Inputs of all images, shape (n, inputs).
    fn inputs_of(&self, similarities: &[Array3<f32>]) -> Array2<f32> {
        let count = similarities.first().map_or(0, |part| part.len_of(Axis(0)));
        let mut inputs = Array2::zeros((count, self.inputs.width()));
        for (image, mut row) in inputs.outer_iter_mut().enumerate() {
            // Rows of a new array are contiguous.
            if let Some(row) = row.as_slice_mut() {
                self.inputs.write(of_image(similarities, image), row);
            }
        }

        inputs
    }

    /// The inputs of the same pairs in reverse order.
    fn reversed(&self, inputs: &Array2<f32>) -> Array2<f32> {
        let mut reversed = Array2::zeros(inputs.dim());
        for (row, mut into) in inputs.outer_iter().zip(reversed.outer_iter_mut()) {
            if let (Some(row), Some(into)) = (row.as_slice(), into.as_slice_mut()) {
                self.inputs.write_reversed(row, into);
            }
        }

        reversed
    }

    /// Outputs of every member, each of shape (n, [`OUTPUTS`]).
    fn outputs(&self, inputs: &Array2<f32>) -> Vec<Array2<f32>> {
        let members = self.members.iter();
        members
            .map(|member| member.outputs(inputs.clone()))
            .collect()
    }
}

impl RelationalNetwork<f32> {
    /// A network from its tensors in the order of [`Network::names`], which `tensor` returns.
    ///
    /// # Errors
    /// The errors of `tensor`.
    pub fn from_tensors<E>(
        mut tensor: impl FnMut(&str) -> Result<Array2<f32>, E>,
    ) -> Result<Self, E> {
        let mut network = Self::initial(1, 1, 0);
        for (name, into) in network.names().into_iter().zip(network.parameters_mut()) {
            *into = tensor(&name)?;
        }

        Ok(network)
    }

    /// Checks shapes and numbers for a given number of inputs.
    fn check(&self, inputs: usize) -> Result<(), Error> {
        let hidden = self.hidden_dim();
        let expected = [
            (hidden, inputs),
            (1, hidden),
            (1, hidden),
            (1, hidden),
            (hidden, hidden),
            (1, hidden),
            (OUTPUTS, hidden),
            (1, OUTPUTS),
        ];
        let tensors = self.names().into_iter().zip(self.parameters());
        for ((name, tensor), (rows, columns)) in tensors.zip(expected) {
            if tensor.dim() != (rows, columns) || rows * columns == 0 {
                return Err(Error::WeightShape {
                    tensor: format!("relational.{name}"),
                    expected: vec![rows, columns],
                    actual: tensor.shape().to_vec(),
                });
            }
        }

        match self.not_finite() {
            Some(tensor) => Err(Error::WeightsNotFinite { tensor }),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn source() -> FeatureSource {
        FeatureSource {
            pooling: "grid2x2".to_owned(),
            ..FeatureSource::imported("f", 12)
        }
    }

    fn reader(members: usize) -> RelationalReader {
        let inputs = InputLayout::of(&CellLayout::of(&source()).unwrap()).width();
        let members = (0..members as u64)
            .map(|seed| RelationalNetwork::initial(inputs, 8, seed))
            .collect();
        RelationalReader::new(&source(), members).unwrap()
    }

    fn cells(reader: &RelationalReader, images: usize) -> Cells {
        let rows = Array2::from_shape_fn((images, 12), |(row, column)| {
            ((row * 12 + column) as f32 * 0.7).sin()
        });
        reader.cells(rows.view()).unwrap()
    }

    /// Oracle: the definition. The motion back is the inverse motion, −ΔP, with the same
    /// covariance; more images than a chunk give the same readings as each alone.
    #[test]
    fn the_motion_back_is_the_inverse_motion() {
        let reader = reader(2);
        let cells = cells(&reader, CHUNK + 3);
        let there = reader.motions(&cells, 1, &cells);
        assert_eq!(there.len(), CHUNK + 3);

        for image in [0, 5, CHUNK + 2] {
            let alone = reader.motions(&cells, 1, &cells.select(&[image]))[0];
            let back = reader.motions(&cells, image, &cells.select(&[1]))[0];
            let near = |a: f64, b: f64| (a - b).abs() < 1e-4 * a.abs().max(1.0);
            for i in 0..6 {
                let [there, alone, back] = [there[image], alone, back]
                    .map(|reading| (reading.twist.to_vector()[i], reading.covariance[(i, i)]));
                assert!(near(there.0, alone.0) && near(there.1, alone.1));
                assert!(near(there.0, -back.0) && near(there.1, back.1));
            }
        }
    }

    /// Oracle: the density of a single direction and member is greatest at its mean; the mean over
    /// both directions is the definition.
    #[test]
    fn likelihoods_are_means_over_both_directions() {
        let reader = reader(1);
        let cells = cells(&reader, 3);
        let motion = Twist::from_vector(&Vector6::new(0.1, 0.2, -0.1, 0.05, 0.0, 0.3));
        let found = reader.log_likelihoods(&cells, 0, &cells, &motion);

        reader.for_each_density(&cells, 0, &cells.select(&[2]), |there, back| {
            let wanted = in_units(&motion);
            let expected = (there[0].log_likelihood(&wanted)
                + back[0].log_likelihood(&wanted.map(|x| -x)))
                / 2.0;
            assert!(
                (found[2] - expected).abs() < 1e-3,
                "{} {expected}",
                found[2]
            );
            assert!(there[0].log_likelihood(&there[0].mean) > there[0].log_likelihood(&wanted));
        });
    }

    /// Oracle: the contract. A scale of 2 on v and 3 on ω multiplies the covariance's blocks by 4,
    /// 9 and, between them, 6.
    #[test]
    fn the_error_scale_scales_the_covariance() {
        let plain = reader(1);
        let cells = cells(&plain, 2);
        let scaled = plain.clone().with_error_scale([2.0, 3.0]).unwrap();
        let [plain, scaled] =
            [&plain, &scaled].map(|reader| reader.motions(&cells, 0, &cells)[1].covariance);

        for (at, factor) in [((1, 2), 4.0), ((3, 5), 9.0), ((0, 4), 6.0)] {
            assert!((scaled[at] - factor * plain[at]).abs() < 1e-12);
        }
        for bad in [[0.0, 1.0], [1.0, f64::NAN], [-1.0, 1.0]] {
            assert!(reader(1).with_error_scale(bad).is_err());
        }
    }

    /// Oracle: the contract.
    #[test]
    fn networks_that_do_not_fit_are_refused() {
        let small = RelationalNetwork::initial(7, 8, 0);
        assert!(matches!(
            RelationalReader::new(&source(), vec![small]),
            Err(Error::WeightShape { .. })
        ));
        assert!(matches!(
            RelationalReader::new(&source(), Vec::new()),
            Err(Error::Members { count: 0 })
        ));
    }
}

//! Ridge regression in closed form, with scikit-learn's objective ‖Y − XB‖² + α‖B‖² (a sum, not a
//! mean). The intercept is not penalized.

use nalgebra::Cholesky;
use ndarray::{Array1, Array2, ArrayView1, ArrayView2, Axis, s};

use crate::matrices::{to_nalgebra, to_ndarray};

/// Why a fit fails.
#[derive(Debug, thiserror::Error, PartialEq)]
#[allow(missing_docs, reason = "each variant's message says what it is")]
pub enum Error {
    #[error(
        "ridge regression needs the same number of inputs and targets, at least one; got {inputs} and {targets}"
    )]
    Rows { inputs: usize, targets: usize },
    #[error("the penalty α must be finite and positive, got {alpha}")]
    Penalty { alpha: f64 },
    #[error(
        "the normal equations are not positive definite; the inputs are not finite or α is too small"
    )]
    NotPositiveDefinite,
}

/// Whether an intercept is fitted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Intercept {
    /// Y ≈ X B + b.
    Fitted,
    /// Y ≈ X B: the prediction for a zero input is zero.
    None,
}

/// A fitted linear map.
#[derive(Debug, Clone, PartialEq)]
pub struct Ridge {
    /// Coefficients, shape (targets, inputs), as scikit-learn's `coef_`.
    pub coefficients: Array2<f64>,
    /// Intercept, shape (targets,); zero if not fitted.
    pub intercept: Array1<f64>,
}

impl Ridge {
    /// Fits `targets` (n, t) on `inputs` (n, d) with penalty `alpha` > 0.
    ///
    /// # Errors
    /// [`Error::Rows`] when the numbers of inputs and targets differ or are 0; [`Error::Penalty`]
    /// when α is not finite and positive; [`Error::NotPositiveDefinite`] when an input is not
    /// finite or α is too small for the inputs.
    ///
    /// Source: SeeSE3, Sec. A.2, M3; equal to scikit-learn's `Ridge`.
    pub fn fit(
        inputs: ArrayView2<'_, f64>,
        targets: ArrayView2<'_, f64>,
        alpha: f64,
        intercept: Intercept,
    ) -> Result<Self, Error> {
        if inputs.nrows() != targets.nrows() || inputs.nrows() == 0 {
            return Err(Error::Rows {
                inputs: inputs.nrows(),
                targets: targets.nrows(),
            });
        }

        if !(alpha.is_finite() && alpha > 0.0) {
            return Err(Error::Penalty { alpha });
        }

        // Centering inputs and targets fits the intercept without a penalty.
        let center = |rows: ArrayView2<'_, f64>| match intercept {
            Intercept::Fitted => rows.sum_axis(Axis(0)) / rows.nrows() as f64,
            Intercept::None => Array1::zeros(rows.ncols()),
        };
        let input_mean = center(inputs);

        let target_mean = center(targets);
        let x = &inputs - &input_mean;
        let y = &targets - &target_mean;

        // (XᵀX + αI)⁻¹XᵀY = Xᵀ(XXᵀ + αI)⁻¹Y: solve the smaller system.
        let coefficients = if x.nrows() < x.ncols() {
            solved(gram(x.t()), alpha, &y)?.reversed_axes().dot(&x)
        } else {
            solved(gram(x.view()), alpha, &x.t().dot(&y))?.reversed_axes()
        };
        let intercept = target_mean - coefficients.dot(&input_mean);

        Ok(Self {
            coefficients,
            intercept,
        })
    }

    /// The prediction for one input of shape (d,).
    pub fn predict(&self, input: ArrayView1<'_, f64>) -> Array1<f64> {
        self.coefficients.dot(&input) + &self.intercept
    }
}

/// Columns of a block of [`gram`].
const GRAM_BLOCK: usize = 128;

/// XᵀX. Of two blocks that are mirrored, one is computed.
fn gram(x: ArrayView2<'_, f64>) -> Array2<f64> {
    let mut gram = Array2::zeros((x.ncols(), x.ncols()));
    let blocks = (0..x.ncols()).step_by(GRAM_BLOCK);
    for start in blocks {
        let end = (start + GRAM_BLOCK).min(x.ncols());
        let part = x
            .slice(s![.., start..end])
            .t()
            .dot(&x.slice(s![.., start..]));
        gram.slice_mut(s![start..end, start..]).assign(&part);
        gram.slice_mut(s![start.., start..end]).assign(&part.t());
    }

    gram
}

/// (G + αI)⁻¹R for a symmetric G.
fn solved(mut gram: Array2<f64>, alpha: f64, right: &Array2<f64>) -> Result<Array2<f64>, Error> {
    gram.diag_mut().mapv_inplace(|value| value + alpha);
    let cholesky = Cholesky::new(to_nalgebra(gram.view())).ok_or(Error::NotPositiveDefinite)?;
    let solution = cholesky.solve(&to_nalgebra(right.view()));

    Ok(to_ndarray(&solution))
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::array;

    /// Oracle: by hand. One input with Σx² = 5, Σxy = 10, α = 5 gives b = 10/(5+5) = 1.
    #[test]
    fn one_coefficient_by_hand() {
        let fit = Ridge::fit(
            array![[1.0], [2.0]].view(),
            array![[2.0], [4.0]].view(),
            5.0,
            Intercept::None,
        )
        .unwrap();

        assert!((fit.coefficients[(0, 0)] - 1.0).abs() < 1e-12);
        assert_eq!(fit.intercept[0], 0.0);
    }

    /// Oracle: a constant target is the intercept, which is not penalized.
    #[test]
    fn a_constant_is_the_intercept() {
        let inputs = array![[1.0], [2.0], [4.0]];
        let fit = Ridge::fit(
            inputs.view(),
            array![[7.0], [7.0], [7.0]].view(),
            1.0,
            Intercept::Fitted,
        )
        .unwrap();

        assert!((fit.predict(array![3.0].view())[0] - 7.0).abs() < 1e-12);
    }

    /// Oracle: the definition. At the minimum of ‖Y − XB − b‖² + α‖B‖² the gradient Xᵀ(Y − XB − b)
    /// − αB is zero, with more inputs than rows as with fewer.
    #[test]
    fn the_gradient_is_zero_however_wide_the_inputs() {
        for (rows, columns) in [(7, 30), (30, 7), (8, 8), (150, 300), (300, 150)] {
            let wave = |i: usize, j: usize| {
                ((3 * i + 7 * j) as f64 * 0.37).sin() + 0.1 * (i * j % 7) as f64
            };
            let x = Array2::from_shape_fn((rows, columns), |(i, j)| wave(i, j));
            let y = Array2::from_shape_fn((rows, 2), |(i, t)| wave(t + 5, i));
            let fit = Ridge::fit(x.view(), y.view(), 0.5, Intercept::Fitted).unwrap();
            let predicted = x.dot(&fit.coefficients.t()) + &fit.intercept;
            let gradient = x.t().dot(&(&y - &predicted)) - 0.5 * &fit.coefficients.t();

            assert!(
                gradient.iter().all(|g| g.abs() < 1e-9),
                "{rows} rows, {columns} columns"
            );
        }
    }

    #[test]
    fn bad_fits_are_refused() {
        let one = array![[1.0]];
        assert!(
            Ridge::fit(
                one.view(),
                Array2::zeros((2, 1)).view(),
                1.0,
                Intercept::None
            )
            .is_err()
        );

        assert!(Ridge::fit(one.view(), one.view(), 0.0, Intercept::None).is_err());
        assert!(Ridge::fit(array![[f64::NAN]].view(), one.view(), 1.0, Intercept::None).is_err());
    }
}

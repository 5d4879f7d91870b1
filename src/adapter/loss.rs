//! The training loss.

use ndarray::{Array2, ArrayView2};

use super::Real;

/// The mean over batch and components of (y − t)², and its gradient by y. Shapes (n, 6).
///
/// Source: SeeSE3, sec. 2.4: MSE on z-scored twists.
pub fn mean_squared_error<T: Real>(predicted: ArrayView2<'_, T>, target: ArrayView2<'_, T>) -> (f64, Array2<T>) {
    let difference = &predicted - &target;
    let count = difference.len() as f64;
    let loss = difference.iter().map(|x| x.f64() * x.f64()).sum::<f64>() / count;
    (loss, difference * T::of(2.0 / count))
}

//! The numbers against other libraries: mpmath, PyTorch, NumPy, scikit-learn, SciPy.
//!
//! Inputs and expected values lie in `tests/golden` with the scripts that made them; the same tests
//! run on a real room where the folder of large inputs is.

#[path = "../support/mod.rs"]
mod support;

mod correctors;
mod formulations;
mod geometry;
mod metrics;
mod multi_step;
mod navigation;
mod scores;
mod training;
mod trajectory;

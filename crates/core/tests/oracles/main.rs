//! The computations against other libraries: mpmath, PyTorch, NumPy, scikit-learn, SciPy; and the
//! contract of indexes. Expected values are in `tests/golden`, with the scripts that made them.
#![allow(
    missing_docs,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::too_many_lines,
    reason = "a failed step is a failed run here, and a case may be long"
)]

mod correctors;
mod geometry;
mod index_contract;
mod navigation;
mod relational;
mod scores;
mod training;

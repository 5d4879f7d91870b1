//! The library against other libraries and against definitions: mpmath, PyTorch, NumPy,
//! scikit-learn, SciPy, evo, Pillow; and the contracts of indexes, datasets, stores and of the tree
//! itself.
//!
//! Inputs and expected values lie in `tests/golden` with the scripts that made them. Tests that
//! need the folder of large inputs are ignored, visibly, unless asked for: `cargo test --
//! --ignored`.
#![allow(
    missing_docs,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::too_many_lines,
    reason = "a failed step is a failed run here, and a case may be long"
)]

/// Makes two tests of `fn name(room: &str, folder: PathBuf)`: with the oracles of the committed
/// synthetic room, and with those of the real room, which need the folder of large inputs.
macro_rules! on_oracle_rooms {
    ($name:ident) => {
        mod $name {
            #[test]
            fn on_the_synthetic_room() {
                super::$name("synthetic", crate::support::golden());
            }

            #[test]
            #[ignore = "needs the folder of large inputs: SEESE3_SHARED or ../shared"]
            fn on_the_real_room() {
                super::$name("real", crate::support::shared().join("oracles"));
            }
        }
    };
}

#[path = "../support/mod.rs"]
mod support;
#[path = "../support/dying.rs"]
mod dying;

mod correctors;
mod datasets;
mod encoders;
mod extension;
mod fitting;
mod formulations;
mod geometry;
mod hostile;
mod index_contract;
mod kitchen;
mod layering;
mod more_datasets;
mod multi_step;
mod navigation;
mod planning;
mod pose_check;
mod probes;
mod scores;
mod store;
mod store_care;
mod tracking;
mod training;
mod trajectory;

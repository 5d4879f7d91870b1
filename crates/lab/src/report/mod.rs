//! Results for people and for programs: tables, JSON and pictures.

mod adapter_sweep;
mod columns;
mod cross_room;
mod curves;
mod document;
mod formulations;
mod json;
mod layers;
mod odometry;
mod path_errors;
mod plot;
mod probe;
mod table;
mod theory;

pub use adapter_sweep::{
    configurations_rows, difficulty_rows, parts_rows, success_rows, sweep_parquet,
};
pub use columns::{Column, parquet_file};
pub use cross_room::{
    cross_room_json, cross_room_table, room_difference_text, room_mean_json, room_mean_text,
    rooms_table, scaling_table,
};
pub use curves::{Curves, Series, curves_svg};
pub use document::{Block, Document, Picture, Section};
pub use formulations::{formulations_json, formulations_table};
pub use json::{evaluation_json, training_json};
pub use layers::{encoders_table, layers_json, layers_table};
pub use odometry::{
    coverage_table, odometry_json, odometry_table, other_rooms_text, relocalisation_text,
};
pub use path_errors::{
    APE_FORMULA, PathErrors, PathProtocol, RPE_FORMULA, path_errors_json, path_errors_table,
};
pub use plot::{PathPlot, path_svg};
pub use probe::{probe_json, probe_table};
pub use table::{aligned, evaluation_table, training_table};
pub use theory::{theory_json, theory_table, theory_table_rows};

/// Why a result could not be rendered.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The drawing library refused a picture.
    #[error("a picture cannot be drawn: {problem}")]
    Picture {
        /// What the library says.
        problem: String,
    },
    /// The Parquet library refused a table.
    #[error("a Parquet table cannot be written")]
    Parquet(#[from] parquet::errors::ParquetError),
}

//! Results for people and for scripts: tables, JSON, pictures.

mod adapter_sweep;
mod columns;
mod cross_room;
mod curves;
mod document;
mod formulations;
mod json;
mod layers;
mod odometry;
pub mod paper;
mod path_errors;
mod plot;
mod probe;
mod recording;
mod table;
mod theory;
mod trajectory;

pub use adapter_sweep::{
    SweepRow, configurations_rows, difficulty_rows, parts_rows, success_rows, sweep_parquet,
};
pub use columns::{Column, parquet_file};
pub use cross_room::{
    CrossRoomRun, cross_room_json, cross_room_table, room_difference_text, room_mean_json,
    room_mean_text, rooms_table, scaling_table,
};
pub use curves::{Curves, Series, curves_svg};
pub use document::{Block, Document, Picture, Section};
pub use formulations::{FormulationScores, formulations_json, formulations_table};
pub use json::{evaluation_json, training_json};
pub use layers::{LayerScores, encoders_table, layers_json, layers_table};
pub use odometry::{
    Foreign, Relocalisation, TrackedRoom, coverage_table, foreign_text, odometry_json,
    odometry_table,
};
pub use path_errors::{
    APE_FORMULA, PathErrors, PathProtocol, RPE_FORMULA, path_errors_json, path_errors_table,
};
pub use plot::{PathPlot, path_svg};
pub use probe::{AtStride, ProbeScores, probe_table};
pub use recording::Recording;
pub use table::{aligned, evaluation_table, training_table};
pub use theory::{theory_json, theory_table, theory_table_rows};
pub use trajectory::{kitti_trajectory, tum_trajectory};

use crate::adapter::TrainingRecord;
use crate::scores::Rate;

/// One seed of a training command.
#[derive(Debug, Clone)]
pub struct TrainingRun {
    /// The run.
    pub record: TrainingRecord,
    /// Hit@0.1 of inverse Poincaré, affine reading, on the run's test pairs.
    pub hit_rate: Rate,
    /// Wall time of training, seconds.
    pub seconds: f64,
}

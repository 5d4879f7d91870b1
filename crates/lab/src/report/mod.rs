//! Renders results as tables, JSON and pictures.
//!
//! Results derive `Serialize`. Types named `…Json` here, and `…Record` in [`crate::reproduction`],
//! are whole JSON files, or parts that no result has in this shape.

mod adapter_sweep;
mod benchmark;
mod columns;
mod cross_room;
mod dot_plot;
mod figure;
mod document;
mod errors_file;
mod evaluation;
mod evaluation_files;
mod formulations;
mod layers;
mod localization;
mod odometry;
mod path_errors;
mod planning;
#[cfg(feature = "plots")]
mod plot_format;
mod probe;
mod robustness;
mod room_card;
mod table;
mod theory;
mod training;

pub use adapter_sweep::{
    configurations_table, difficulty_table, parts_table, success_table, sweep_parquet,
};
pub use benchmark::{benchmark_page, benchmark_table, metrics_page, metrics_table};
pub use columns::{ParquetColumn, parquet_file};
pub use cross_room::{
    CrossRoomJson, count_text, cross_room_json, cross_room_table, room_difference_text,
    room_mean_text, rooms_table, scaling_table,
};
pub use document::{Block, Document, Picture, Section};
pub use dot_plot::dot_plot;
pub use errors_file::{cross_room_errors_file, estimate_errors_file, retrieval_errors_file};
pub use evaluation::{
    AdapterJson, EvaluationContext, EvaluationJson, MotionBaselines, RoomJson, baselines_text,
    evaluation_json, evaluation_markdown, evaluation_table,
};
pub use evaluation_files::{
    curve_thresholds, evaluation_csv, evaluation_latex, hit_curves, report_at,
};
pub use figure::{Axes, Figure, PathPlot, Series};
pub use formulations::{add_formulations, formulations_table, spread_text};
pub use layers::{encoders_table, layers_table};
pub use localization::{
    LocalizationContext, LocalizationJson, MotionEvaluationJson, localization_table,
    matched_localization_table, motion_table,
};
pub use odometry::{
    OdometryJson, coverage_table, intervals_table, odometry_json, odometry_table, other_rooms_text,
    relocalization_text, scenarios_text,
};
pub use path_errors::{
    APE_FORMULA, PathErrorsJson, RPE_FORMULA, path_errors_json, path_errors_table,
};
pub use planning::{PlanningJson, planning_json, planning_table};
#[cfg(feature = "plots")]
pub use plot_format::{plot_pdf, plot_png};
pub use probe::{ProbeJson, ProbedRooms, probe_plot, probe_table};
pub use robustness::{RobustnessJson, robustness_json, robustness_table};
pub use room_card::{medians as medians_of_cards, room_card_table};
pub use table::{Column, Table, fixed};
pub use theory::{TheoryJson, theory_json, theory_plot, theory_table};
pub use training::{TrainingJson, gating_text, training_json, training_remark, training_table};

/// Why a result could not be rendered.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The drawing library refused a picture.
    #[error("a picture cannot be drawn: {problem}")]
    Picture {
        /// What the library says.
        #[source]
        problem: seese3_core::Cause,
    },
    /// The Parquet library refused a table.
    #[error("a Parquet table cannot be written")]
    Parquet(#[from] parquet::errors::ParquetError),
}

impl From<Error> for crate::experiments::Error {
    fn from(problem: Error) -> Self {
        Self::Rendering(problem.into())
    }
}

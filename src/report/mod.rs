//! Results for people and for scripts: tables, JSON, pictures.

mod json;
mod layers;
mod plot;
mod probe;
mod table;
mod trajectory;

pub use json::{evaluation_json, training_json};
pub use layers::{LayerScores, layers_json, layers_table};
pub use plot::{PathPlot, path_svg};
pub use probe::{AtStride, ProbeScores, probe_table};
pub use table::{evaluation_table, training_table};
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

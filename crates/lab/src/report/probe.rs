//! Probe metrics M1 to M4 of features in rooms, for `seese3 probe`.

use serde::Serialize;

use super::formulations::PARTS;
use super::table::{Table, fixed};
use crate::experiments::probe::{AtStride, DimensionScore, MutualKnnScore, ProbeScores};
use seese3_core::eval::Baselines;
use seese3_core::statistics::mean_of_known;

/// The JSON record of `seese3 probe`.
#[derive(Debug, Serialize)]
pub struct ProbeJson<'a> {
    /// The scores.
    #[serde(flatten)]
    pub rooms: ProbedRooms<'a>,
    /// The name of the features.
    pub features: &'a str,
    /// The train/test split.
    pub split: &'static str,
    /// The preset of M4.
    pub preset: &'static str,
    /// Why a room or a metric has no scores, in words.
    pub skipped: Vec<String>,
}

/// The scores of one room are top-level keys of the file; those of several rooms are a list.
#[derive(Debug, Serialize)]
#[serde(untagged)]
#[allow(missing_docs, reason = "the type's comment says what they are")]
pub enum ProbedRooms<'a> {
    One(&'a ProbeScores),
    Several { rooms: &'a [ProbeScores] },
}

impl<'a> ProbedRooms<'a> {
    /// The scores of one or several rooms.
    pub fn of(scores: &'a [ProbeScores]) -> Self {
        match scores {
            [only] => Self::One(only),
            rooms => Self::Several { rooms },
        }
    }
}

/// One line per room and metric, for M3 and M4 per stride.
pub fn probe_table(scores: &[ProbeScores]) -> Table {
    let mut table = Table::new(
        "room | metric | value | sd | transl. | rotation | direct. | magnit. | n | constant | nearest",
    );

    for score in scores {
        let mut line = |metric: String, values: Vec<String>| {
            table.row(&score.room, std::iter::once(metric).chain(values));
        };

        if let Some(MutualKnnScore { share, options }) = &score.m1 {
            // M1 has only a value and a frame count: empty cells keep the count in column `n`.
            let mut cells = vec![format!("{share:.3}")];
            cells.resize(6, String::new());
            cells.push(options.frames.to_string());
            line("M1".to_owned(), cells);
        }

        if let Some(DimensionScore { dimension, .. }) = &score.m2 {
            let [two_nn, mle] = fixed([dimension.two_nn.linear, dimension.mle_biased.harmonic], 3);
            line("M2 TwoNN".to_owned(), vec![two_nn]);
            line("M2 MLE".to_owned(), vec![mle]);
        }

        for (name, strides) in [("M3", &score.m3), ("M4", &score.m4)] {
            for at in strides {
                line(format!("{name} s{}", at.stride), stride_cells(at));

                // Show each fold: the joint score hides differences between folds.
                if at.splits.len() < 2 {
                    continue;
                }
                for under in &at.splits {
                    let mut cells = vec![format!("{:.3}", under.r2)];
                    cells.resize(7, String::new());
                    cells.extend(baseline_cells(under.baselines.as_ref()));
                    line(format!("{name} s{} {}", at.stride, under.split), cells);
                }
            }
        }
    }

    table
}

fn stride_cells(at: &AtStride) -> Vec<String> {
    let over_seeds = |of| mean_of_known(&at.runs.iter().map(of).collect::<Vec<f64>>());
    let spread = at.spread.as_ref().map(|spread| format!("{:.3}", spread.sd));

    let mut cells = vec![format!("{:.3}", at.r2), spread.unwrap_or_default()];
    cells.extend(fixed(PARTS.map(over_seeds), 3));
    cells.push(at.n.to_string());
    cells.extend(baseline_cells(at.baselines.as_ref()));
    cells
}

/// The R² of the mean training motion and the distance to the nearest training pose; empty for
/// several rooms together.
fn baseline_cells(baselines: Option<&Baselines>) -> [String; 2] {
    let Some(baselines) = baselines else {
        return [String::new(), String::new()];
    };

    let nearest = baselines.nearest_pose.map_or_else(String::new, |pose| {
        format!(
            "{:.2} m {:.0}°",
            pose.translation_m,
            pose.rotation_rad.to_degrees()
        )
    });
    [format!("{:.3}", baselines.constant_r2), nearest]
}

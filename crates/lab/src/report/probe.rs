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

/// What `--plot` draws: one row per room, one column per metric and stride.
pub fn probe_plot(scores: &[ProbeScores]) -> Table {
    let of_room = |score: &ProbeScores| -> Vec<(String, f64)> {
        let m1 = score.m1.as_ref().map(|m1| ("M1".to_owned(), m1.share));
        let m2 = score.m2.as_ref().into_iter().flat_map(|m2| {
            [
                ("M2 TwoNN".to_owned(), m2.dimension.two_nn.linear),
                ("M2 MLE".to_owned(), m2.dimension.mle_biased.harmonic),
            ]
        });
        let strides = [("M3", &score.m3), ("M4", &score.m4)];
        let strides = strides.into_iter().flat_map(|(name, strides)| {
            let named = strides.iter();
            named.map(move |at| (format!("{name} R², stride {}", at.stride), at.r2))
        });
        m1.into_iter().chain(m2).chain(strides).collect()
    };

    let rooms: Vec<Vec<(String, f64)>> = scores.iter().map(of_room).collect();
    let mut metrics: Vec<&String> = Vec::new();
    for (name, _) in rooms.iter().flatten() {
        if !metrics.contains(&name) {
            metrics.push(name);
        }
    }

    let head: Vec<&str> = metrics.iter().map(|name| name.as_str()).collect();
    let mut table = Table::new(&format!("room | {}", head.join(" | ")));
    for (score, found) in scores.iter().zip(&rooms) {
        let cell = |metric: &&String| {
            let value = found.iter().find(|(name, _)| name == *metric);
            value.map_or_else(String::new, |(_, value)| format!("{value:.3}"))
        };
        table.row(&score.room, metrics.iter().map(cell));
    }
    table
}

/// One line per room and metric, for M3 and M4 per stride.
pub fn probe_table(scores: &[ProbeScores]) -> Table {
    let mut table = Table::new(
        "room | metric | value | sd | transl. | rotation | direct. | magnit. | n | constant | nearest m | nearest °",
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

/// The R² of the mean training motion, and the distance and the angle to the nearest training pose;
/// empty for several rooms together.
fn baseline_cells(baselines: Option<&Baselines>) -> [String; 3] {
    let nearest = baselines.and_then(|baselines| baselines.nearest_pose);
    let [meters, degrees] = nearest.map_or_else(Default::default, |pose| {
        [
            format!("{:.2}", pose.translation_m),
            format!("{:.0}", pose.rotation_rad.to_degrees()),
        ]
    });
    let constant = baselines.map_or_else(String::new, |found| format!("{:.3}", found.constant_r2));
    [constant, meters, degrees]
}

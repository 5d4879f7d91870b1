//! Section: the layers of an encoder, and the oracle layer.

use rayon::prelude::*;

use seese3_core::adapter::Preset;
use seese3_core::splits::Split;
use seese3_core::statistics::{mean_of_known, paired_difference};
use seese3_core::training::RoomData;

use super::{Error, Found, Reproduction};
use crate::experiments::cross_room::{clipped_r2, or_worst};
use crate::experiments::layers::{LayerProtocol, LayerScores, score_layer};
use crate::probes::MutualKnn;
use crate::report::{Section, Table, fixed, room_difference_text};

/// The in-room rooms with the features of one layer.
pub struct LayerSet<'a> {
    /// The name of the features.
    pub features: String,
    /// The rooms.
    pub rooms: Vec<RoomData<'a>>,
}

/// A metric by which a layer is chosen: higher is better.
struct Metric {
    name: &'static str,
    of: fn(&LayerScores) -> f64,
}

/// The metrics for which the paper shows the best layer.
const METRICS: [Metric; 3] = [
    Metric {
        name: "M1",
        of: |scores| scores.m1.value,
    },
    Metric {
        name: "M3",
        of: |scores| clipped_r2(scores.m3.r2),
    },
    Metric {
        name: "M4",
        of: |scores| clipped_r2(scores.m4.r2),
    },
];

/// Builds the section on layers; it is empty if no layers are given.
pub fn section(given: &Reproduction<'_>) -> Result<Found<Vec<LayerScores>>, Error> {
    let mut section = Section::new("Layers, and the oracle layer");
    let mut by_layer: Vec<Vec<LayerScores>> = Vec::new();
    for layer in &given.layers {
        let scored = layer.rooms.par_iter().map(|room| scored(given, room));
        by_layer.push(scored.collect::<Result<_, Error>>()?);
    }

    if by_layer.is_empty() {
        section.text("No layers were given (--layers).");
    } else {
        section.table(table(&by_layer));
        section.text(format!(
            "Means over the {} in-room rooms: M1 at the smallest stride that spans the recording, M2 without a gap; M3 \
             and M4 at stride {}, split {}, as max(R², −1). {}",
            by_layer[0].len(),
            given.options.stride,
            Split::Blocks,
            given.training_words()
        ));
        section.table(oracle_table(&by_layer));
        section.text(
            "The paper selects each layer by the scores that it reports. Here the rooms at even places select a layer, and \
             the others score it. The best layer of the scoring rooms stands beside it; its advantage is biased upward.",
        );
    }

    let record = by_layer.into_iter().flatten().collect();
    Ok(Found::new(section, record))
}

fn scored(given: &Reproduction<'_>, room: &RoomData<'_>) -> Result<LayerScores, Error> {
    let protocol = LayerProtocol {
        mutual_knn: MutualKnn::spanning(room.room.frame_count()),
        gap: 0,
        plan: given.plan(Preset::Base, Split::Blocks, given.options.stride, 0, None),
        splits: vec![Split::Blocks],
        seeds: given.options.seeds,
    };
    score_layer(room, &protocol)
}

fn means(layer: &[LayerScores], of: impl Fn(&LayerScores) -> f64) -> f64 {
    mean_of_known(&layer.iter().map(of).collect::<Vec<f64>>())
}

fn table(by_layer: &[Vec<LayerScores>]) -> Table {
    let mut table = Table::new(
        "features | columns | M1 | TwoNN | MLE | M3 | M4 | of translation | of rotation | sd over seeds",
    );
    for layer in by_layer {
        let numbers = [
            means(layer, METRICS[0].of),
            means(layer, |scores| scores.m2.twonn),
            means(layer, |scores| scores.m2.mle),
            means(layer, METRICS[1].of),
            means(layer, METRICS[2].of),
            means(layer, |scores| clipped_r2(scores.m4.translation)),
            means(layer, |scores| clipped_r2(scores.m4.rotation)),
            means(layer, |scores| scores.m4.deviation),
        ];
        let columns = std::iter::once(layer[0].dim.to_string());
        table.row(&layer[0].features, columns.chain(fixed(numbers, 3)));
    }
    table
}

/// Every second room chooses the layer of each metric; the rooms between score it.
fn oracle_table(by_layer: &[Vec<LayerScores>]) -> Table {
    let mut table = Table::new(
        "metric | layer chosen in other rooms | score | best layer there | score | best minus chosen [95 %]",
    );
    for metric in &METRICS {
        let values = |layer: &[LayerScores], first: usize| -> Vec<f64> {
            let rooms = layer.iter().skip(first).step_by(2);
            rooms.map(metric.of).collect()
        };
        let best = |first: usize| {
            let mean = |layer: &&Vec<LayerScores>| or_worst(mean_of_known(&values(layer, first)));
            by_layer.iter().max_by(|a, b| mean(a).total_cmp(&mean(b)))
        };
        let (Some(chosen), Some(oracle)) = (best(0), best(1)) else {
            continue;
        };
        let [chosen_scores, oracle_scores] = [chosen, oracle].map(|layer| values(layer, 1));
        let cells = [
            chosen[0].features.clone(),
            format!("{:.3}", mean_of_known(&chosen_scores)),
            oracle[0].features.clone(),
            format!("{:.3}", mean_of_known(&oracle_scores)),
            room_difference_text(&paired_difference(&oracle_scores, &chosen_scores, 0)),
        ];
        table.row(metric.name, cells);
    }
    table
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiments::layers::{AdapterScores, LayerDimension, MutualKnnShare, RidgeScore};

    fn layer(features: &str, scores: [f64; 4]) -> Vec<LayerScores> {
        let of_room = |value: f64| LayerScores {
            features: features.to_owned(),
            encoder: "e".to_owned(),
            room: "r".to_owned(),
            dim: 4,
            m1: MutualKnnShare { value },
            m2: LayerDimension {
                twonn: value,
                mle: value,
                dropped_rows: 0,
            },
            m3: RidgeScore { r2: value },
            m4: AdapterScores {
                r2: value,
                translation: value,
                rotation: value,
                deviation: 0.0,
                runs: vec![value],
            },
            constant_r2: 0.0,
        };
        scores.map(of_room).to_vec()
    }

    /// Oracle: by hand. Layer a is best in the first and third room, which choose it; in the other
    /// rooms it has 0.1, and the best layer there 0.6.
    #[test]
    fn the_oracle_layer_is_the_best_where_it_is_scored() {
        let table = oracle_table(&[
            layer("a", [0.9, 0.1, 0.9, 0.1]),
            layer("b", [0.2, 0.5, 0.2, 0.7]),
        ]);
        let csv = table.csv();
        let first = csv.lines().nth(1).unwrap();
        assert!(
            first.starts_with("M1,a,0.100,b,0.600,\"+0.500 ["),
            "{first}"
        );
    }
}

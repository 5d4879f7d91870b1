//! Probe metrics M1 to M4 per encoder layer, for `seese3 sweep layers`.

use super::table::{Table, fixed, grouped};
use crate::experiments::layers::LayerScores;
use seese3_core::statistics::{deviation, mean};

/// What a column of the table shows of a layer, and whether more of it is better.
#[derive(Clone, Copy)]
struct Metric {
    value: fn(&LayerScores) -> f64,
    /// The larger, the better.
    merit: fn(f64) -> f64,
    /// The score of the simplest answer, which the best layer has to exceed; if there is one.
    baseline: Option<fn(&LayerScores) -> f64>,
    /// The deviation over seeds, if the metric depends on them.
    deviation: Option<fn(&LayerScores) -> f64>,
}

/// SE(3) has six dimensions: features that encode only the camera pose have an intrinsic dimension
/// near six. Larger and smaller values are both worse.
const METRICS: [Metric; 5] = [
    Metric {
        value: |score| score.m1.value,
        merit: |value| value,
        baseline: None,
        deviation: None,
    },
    Metric {
        value: |score| score.m2.twonn,
        merit: |value| -(value - 6.0).abs(),
        baseline: None,
        deviation: None,
    },
    Metric {
        value: |score| score.m2.mle,
        merit: |value| -(value - 6.0).abs(),
        baseline: None,
        deviation: None,
    },
    Metric {
        value: |score| score.m3.r2,
        merit: |value| value,
        baseline: Some(|score| score.constant_r2),
        deviation: None,
    },
    Metric {
        value: |score| score.m4.r2,
        merit: |value| value,
        baseline: Some(|score| score.constant_r2),
        deviation: Some(|score| score.m4.deviation),
    },
];

impl Metric {
    /// Whether a layer is the best of `layers`: it exceeds the simplest answer, and every other
    /// layer by more than the deviations of the difference over rooms and over seeds.
    fn is_best(&self, layer: &[&LayerScores], layers: &[Vec<&LayerScores>]) -> bool {
        let merit = |layer: &[&LayerScores]| (self.merit)(over(layer, self.value));
        let exceeds_baseline = self
            .baseline
            .is_none_or(|baseline| over(layer, self.value) > over(layer, baseline));

        let mut others = layers
            .iter()
            .filter(|other| other[0].features != layer[0].features);
        exceeds_baseline
            && others.all(|other| merit(layer) - merit(other) > self.uncertainty(layer, other))
    }

    /// The larger of the deviation over rooms of the difference of two layers, and their deviations
    /// over seeds; 0 if there is only one room and seeds do not matter.
    fn uncertainty(&self, layer: &[&LayerScores], other: &[&LayerScores]) -> f64 {
        let merit = |score: &LayerScores| (self.merit)((self.value)(score));
        let differences: Vec<f64> = layer
            .iter()
            .filter_map(|score| {
                let same_room = other.iter().find(|other| other.room == score.room)?;
                Some(merit(score) - merit(same_room))
            })
            .collect();

        let seeds = self.deviation.into_iter();
        let seeds = seeds.flat_map(|of| [over(layer, of), over(other, of)]);
        let known = seeds.chain([deviation(&differences)]);
        known.filter(|value| value.is_finite()).fold(0.0, f64::max)
    }
}

/// One line per layer with means over rooms. A star marks the best layer of each metric; for the
/// intrinsic dimension that is the layer nearest to 6. There is none if another layer is within the
/// deviation, or if the best R² is below that of the constant baseline, which always predicts the
/// mean training motion and is in the last column.
pub fn layers_table(scores: &[LayerScores]) -> Table {
    let layers = grouped(scores, |score| &score.features);

    let mut table = Table::new("features | columns | M1 | TwoNN | MLE | M3 R² | M4 R² | constant");
    for layer in &layers {
        let is_one_of_several = layers.len() > 1;
        let star = |metric: &Metric| match is_one_of_several && metric.is_best(layer, &layers) {
            true => "*",
            false => " ",
        };

        let mut cells = vec![layer[0].dim.to_string()];
        for metric in &METRICS {
            let value = over(layer, metric.value);
            let spread = metric.deviation.map(|of| over(layer, of));
            let spread = spread.filter(|spread| spread.is_finite());
            let spread = spread.map_or_else(String::new, |spread| format!(" ± {spread:.3}"));
            cells.push(format!("{value:.3}{spread}{}", star(metric)));
        }
        cells.push(format!("{:.3}", over(layer, |score| score.constant_r2)));

        table.row(&layer[0].features, cells);
    }

    table
}

/// One line per encoder, for its layer with the highest mean test R² of the adapters. It compares
/// checkpoints of one encoder. The layout follows the paper's ablation table (Sec. A.8).
pub fn encoders_table(scores: &[LayerScores]) -> Table {
    let mut table = Table::new("encoder | best layer | M1 | overall | transl. | rotation | sd");

    for encoder in grouped(scores, |score| &score.encoder) {
        let layers = grouped(encoder.iter().copied(), |score| &score.features);
        let r2 = |layer: &Vec<&LayerScores>| over(layer, |score| score.m4.r2);
        let Some(best) = layers.iter().max_by(|a, b| r2(a).total_cmp(&r2(b))) else {
            continue;
        };

        // In the column order, from `M1` on.
        let figures: [fn(&LayerScores) -> f64; 5] = [
            |score| score.m1.value,
            |score| score.m4.r2,
            |score| score.m4.translation,
            |score| score.m4.rotation,
            |score| score.m4.deviation,
        ];
        let figures = fixed(figures.map(|of| over(best, of)), 3);
        let features = std::iter::once(best[0].features.clone());
        table.row(&encoder[0].encoder, features.chain(figures));
    }

    table
}

/// The mean over the rooms of a layer.
fn over(layer: &[&LayerScores], of: fn(&LayerScores) -> f64) -> f64 {
    mean(&layer.iter().map(|score| of(score)).collect::<Vec<_>>())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiments::layers::{AdapterScores, LayerDimension, MutualKnnShare, RidgeScore};

    fn score(features: &str, room: &str, value: f64, dimension: f64, r2: f64) -> LayerScores {
        LayerScores {
            features: features.to_owned(),
            encoder: "e".to_owned(),
            room: room.to_owned(),
            dim: 4,
            m1: MutualKnnShare { value },
            m2: LayerDimension {
                twonn: dimension,
                mle: dimension,
                dropped_rows: 0,
            },
            m3: RidgeScore { r2 },
            m4: AdapterScores {
                r2,
                translation: r2,
                rotation: r2,
                deviation: 0.1,
                runs: vec![r2],
            },
            constant_r2: -3.0,
        }
    }

    fn lines(scores: &[LayerScores]) -> Vec<String> {
        let table = layers_table(scores).to_string();
        table.lines().skip(1).map(str::to_owned).collect()
    }

    /// Oracle: by hand. Means over two rooms. The best dimension is the nearest to 6, not the
    /// highest. In M1, b is better by 0.2 and 0.2 in the two rooms, a deviation of 0.
    #[test]
    fn the_best_of_each_metric_has_a_star() {
        let lines = lines(&[
            score("a", "r", 0.2, 5.5, -1.0),
            score("a", "s", 0.4, 5.5, 0.0),
            score("b", "r", 0.4, 9.0, -2.5),
            score("b", "s", 0.6, 9.0, -1.5),
        ]);
        assert_eq!(lines.len(), 2);
        for cell in ["0.300 ", "5.500*", "-0.500*", "-0.500 ± 0.100*"] {
            assert!(lines[0].contains(cell), "{cell}: {lines:?}");
        }
        for cell in ["0.500*", "9.000 "] {
            assert!(lines[1].contains(cell), "{cell}: {lines:?}");
        }
    }

    /// Oracle: by hand. In M1, b is better by 0.3 and worse by 0.1: 0.1 ± 0.28 over rooms. In M4, a
    /// is better by 0.05, with 0.1 over seeds.
    #[test]
    fn a_difference_within_the_deviation_has_no_star() {
        let lines = lines(&[
            score("a", "r", 0.2, 6.0, -1.0),
            score("a", "s", 0.4, 6.0, -1.0),
            score("b", "r", 0.5, 6.0, -1.05),
            score("b", "s", 0.3, 6.0, -1.05),
        ]);
        assert!(
            lines[0].contains("0.300 ") && lines[1].contains("0.400 "),
            "{lines:?}"
        );
        assert!(lines[0].contains("-1.000 ± 0.100 "), "{lines:?}");
        // The ridge probe has no seeds, and is better in both rooms by the same.
        assert!(lines[0].contains("-1.000*"), "{lines:?}");
    }

    /// Oracle: the definition: the best is the best of several.
    #[test]
    fn the_only_layer_has_no_star() {
        let lines = lines(&[score("a", "r", 0.2, 6.0, 0.5)]);
        assert!(!lines[0].contains('*'), "{lines:?}");
    }

    /// Oracle: by hand: −4 is below the −3 of the constant answer.
    #[test]
    fn what_is_worse_than_a_constant_has_no_star() {
        let lines = lines(&[
            score("a", "r", 0.2, 6.0, -4.0),
            score("b", "r", 0.3, 7.0, -5.0),
        ]);
        assert!(lines[1].contains("0.300*"), "{lines:?}");
        assert!(!lines[0].contains("-4.000*"), "{lines:?}");
        assert!(!lines[0].contains("0.100*"), "{lines:?}");
    }
}

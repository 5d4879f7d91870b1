//! Probe metrics M1 to M4 per encoder layer, for `seese3 sweep layers`.

use super::table::{Table, fixed, grouped};
use crate::experiments::layers::LayerScores;
use seese3_core::statistics::mean;

/// One line per layer with means over rooms. A star marks the best layer of each metric; for the
/// intrinsic dimension that is the layer nearest to 6. The last column is the R² of the constant
/// baseline, which always predicts the mean training motion.
pub fn layers_table(scores: &[LayerScores]) -> Table {
    let layers = grouped(scores, |score| &score.features);

    // SE(3) has six dimensions: features that encode only the camera pose have an intrinsic
    // dimension near six. Larger and smaller values are both worse.
    type Score = fn(&LayerScores) -> f64;
    type Merit = fn(f64) -> f64;
    let highest: Merit = |value| value;
    let near_six: Merit = |value| -(value - 6.0).abs();

    let metrics: [(Score, Merit); 5] = [
        (|score| score.m1.value, highest),
        (|score| score.m2.twonn, near_six),
        (|score| score.m2.mle, near_six),
        (|score| score.m3.r2, highest),
        (|score| score.m4.r2, highest),
    ];
    let best = metrics.map(|(of, merit)| {
        let merits = layers.iter().map(|layer| merit(over(layer, of)));
        merits.fold(f64::NEG_INFINITY, f64::max)
    });

    let mut table = Table::new("features | columns | M1 | TwoNN | MLE | M3 R² | M4 R² | constant");
    for layer in &layers {
        let star = |place: usize| {
            let (of, merit) = metrics[place];
            if merit(over(layer, of)) >= best[place] {
                "*"
            } else {
                " "
            }
        };

        let mut cells = vec![layer[0].dim.to_string()];
        cells.extend(
            (0..4).map(|place| format!("{:.3}{}", over(layer, metrics[place].0), star(place))),
        );

        // The deviation over seeds stands between the mean of M4 and its star.
        let m4 = over(layer, |score| score.m4.r2);
        let deviation = over(layer, |score| score.m4.deviation);
        let spread = deviation.is_finite().then(|| format!(" ± {deviation:.3}"));
        cells.push(format!("{m4:.3}{}{}", spread.unwrap_or_default(), star(4)));
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

    /// Oracle: by hand. Means over two rooms. The best dimension is the nearest to 6, not the
    /// highest.
    #[test]
    fn the_best_of_each_metric_has_a_star() {
        let score = |features: &str, value: f64, dimension: f64, r2: f64| LayerScores {
            features: features.to_owned(),
            encoder: "e".to_owned(),
            room: "r".to_owned(),
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
        };

        let scores = [
            score("a", 0.2, 5.5, -1.0),
            score("a", 0.4, 5.5, 0.0),
            score("b", 0.5, 9.0, -2.0),
        ];
        let table = layers_table(&scores).to_string();
        let lines: Vec<&str> = table.lines().collect();

        assert_eq!(lines.len(), 3);

        assert!(
            lines[1].contains("0.300 ")
                && lines[1].contains("5.500*")
                && lines[1].contains("-0.500*"),
            "{table}"
        );

        assert!(lines[1].contains("-0.500 ± 0.100*"), "{table}");

        assert!(
            lines[2].contains("0.500*") && lines[2].contains("9.000 "),
            "{table}"
        );
    }
}

//! Probe metrics M1 to M4 per encoder layer, for `seese3 sweep layers`.

use serde::Serialize;

use super::table::aligned;
use crate::experiments::layers::LayerScores;
use seese3_core::statistics::mean;

/// One line per layer with means over rooms. A star marks the best layer of each metric; for the
/// intrinsic dimension that is the layer nearest to 6. The last column is the R² of the constant
/// baseline, which always predicts the mean training motion.
pub fn layers_table(scores: &[LayerScores]) -> String {
    // A list instead of a set keeps the layers in the order of the scores.
    let mut layers: Vec<&str> = Vec::new();
    for score in scores {
        if !layers.contains(&score.features.as_str()) {
            layers.push(&score.features);
        }
    }

    let column = |of: fn(&LayerScores) -> f64| -> Vec<f64> {
        let by_layer = |layer: &&str| {
            mean(
                &scores
                    .iter()
                    .filter(|score| score.features == **layer)
                    .map(of)
                    .collect::<Vec<_>>(),
            )
        };

        layers.iter().map(by_layer).collect()
    };

    // SE(3) has six dimensions: features that encode only the camera pose have an intrinsic
    // dimension near six. Larger and smaller values are both worse.
    let highest = |value: f64| value;
    let near_six = |value: f64| -(value - 6.0).abs();
    type Merit = fn(f64) -> f64;

    let columns: [(Vec<f64>, Merit); 5] = [
        (column(|score| score.m1), highest),
        (column(|score| score.m2_two_nn), near_six),
        (column(|score| score.m2_mle), near_six),
        (column(|score| score.m3_r2), highest),
        (column(|score| score.m4_r2), highest),
    ];

    let spread = column(|score| score.m4_deviation);
    let constant = column(|score| score.constant_r2);

    let mut lines = vec![
        [
            "features", "columns", "M1", "TwoNN", "MLE", "M3 R²", "M4 R²", "constant",
        ]
        .map(str::to_owned)
        .to_vec(),
    ];

    for (row, layer) in layers.iter().enumerate() {
        let dim = scores
            .iter()
            .find(|score| score.features == **layer)
            .map_or(0, |score| score.dim);
        let mut cells = vec![(*layer).to_owned(), dim.to_string()];

        for (values, merit) in &columns {
            let best = values
                .iter()
                .copied()
                .map(merit)
                .fold(f64::NEG_INFINITY, f64::max);
            let star = if merit(values[row]) >= best { "*" } else { " " };
            cells.push(format!("{:.3}{star}", values[row]));
        }

        // Insert the deviation between the mean of M4 and its star, the last character of the cell.
        if spread[row].is_finite() {
            let last = cells.pop().unwrap_or_default();
            cells.push(format!(
                "{} ± {:.3}{}",
                last[..last.len() - 1].trim(),
                spread[row],
                &last[last.len() - 1..]
            ));
        }

        cells.push(format!("{:.3}", constant[row]));
        lines.push(cells);
    }

    aligned(&lines)
}

/// One line per encoder, for its layer with the highest mean test R² of the adapters. It compares
/// checkpoints of one encoder. The layout follows the paper's ablation table (Sec. A.8).
pub fn encoders_table(scores: &[LayerScores]) -> String {
    type Layer<'a> = (&'a str, Vec<&'a LayerScores>);

    // Group scores by encoder, then by features, both in order of first appearance.
    let mut by_encoder: Vec<(&str, Vec<Layer<'_>>)> = Vec::new();
    for score in scores {
        let at = match by_encoder
            .iter()
            .position(|(encoder, _)| *encoder == score.encoder)
        {
            Some(at) => at,
            None => {
                by_encoder.push((&score.encoder, Vec::new()));
                by_encoder.len() - 1
            }
        };

        let layers = &mut by_encoder[at].1;
        match layers
            .iter_mut()
            .find(|(features, _)| *features == score.features)
        {
            Some((_, rooms)) => rooms.push(score),
            None => layers.push((&score.features, vec![score])),
        }
    }

    let over = |rooms: &[&LayerScores], of: fn(&LayerScores) -> f64| {
        mean(&rooms.iter().map(|score| of(score)).collect::<Vec<_>>())
    };

    let head = [
        "encoder",
        "best layer",
        "M1",
        "overall",
        "transl.",
        "rotation",
        "sd",
    ];

    let mut lines = vec![head.map(str::to_owned).to_vec()];
    for (encoder, layers) in &by_encoder {
        let best = layers
            .iter()
            .max_by(|a, b| over(&a.1, |s| s.m4_r2).total_cmp(&over(&b.1, |s| s.m4_r2)));
        let Some((features, rooms)) = best else {
            continue;
        };

        // In the column order, from `M1` on.
        let figures: [fn(&LayerScores) -> f64; 5] = [
            |s| s.m1,
            |s| s.m4_r2,
            |s| s.m4_translation,
            |s| s.m4_rotation,
            |s| s.m4_deviation,
        ];

        let cells = figures.map(|of| format!("{:.3}", over(rooms, of)));
        lines.push(
            [(*encoder).to_owned(), (*features).to_owned()]
                .into_iter()
                .chain(cells)
                .collect(),
        );
    }

    aligned(&lines)
}

/// The JSON record of `seese3 sweep layers`, one entry per layer and room.
#[derive(Debug, Serialize)]
pub struct LayersJson {
    layers: Vec<LayerJson>,
}

#[derive(Debug, Serialize)]
struct LayerJson {
    features: String,
    encoder: String,
    room: String,
    columns: usize,
    m1: M1Json,
    m2: M2Json,
    m3: M3Json,
    m4: M4Json,
    /// R² of the constant baseline, the mean training motion.
    constant_r2: f64,
}

#[derive(Debug, Serialize)]
struct M1Json {
    value: f64,
}

#[derive(Debug, Serialize)]
struct M2Json {
    twonn: f64,
    mle: f64,
    dropped_rows: usize,
}

#[derive(Debug, Serialize)]
struct M3Json {
    r2: f64,
}

#[derive(Debug, Serialize)]
struct M4Json {
    r2: f64,
    translation: f64,
    rotation: f64,
    deviation: f64,
    /// R² of each seed.
    runs: Vec<f64>,
}

/// Builds the JSON record of layer scores.
pub fn layers_json(scores: &[LayerScores]) -> LayersJson {
    let entry = |score: &LayerScores| LayerJson {
        features: score.features.clone(),
        encoder: score.encoder.clone(),
        room: score.room.clone(),
        columns: score.dim,
        m1: M1Json { value: score.m1 },
        m2: M2Json {
            twonn: score.m2_two_nn,
            mle: score.m2_mle,
            dropped_rows: score.m2_dropped,
        },
        m3: M3Json { r2: score.m3_r2 },
        m4: M4Json {
            r2: score.m4_r2,
            translation: score.m4_translation,
            rotation: score.m4_rotation,
            deviation: score.m4_deviation,
            runs: score.m4_runs.clone(),
        },
        constant_r2: score.constant_r2,
    };

    LayersJson {
        layers: scores.iter().map(entry).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand. Means over two rooms. The best dimension is the nearest to 6, not the
    /// highest.
    #[test]
    fn the_best_of_each_metric_has_a_star() {
        let score = |features: &str, m1: f64, dimension: f64, r2: f64| LayerScores {
            features: features.to_owned(),
            room: "r".to_owned(),
            dim: 4,
            m1,
            m2_two_nn: dimension,
            m2_mle: dimension,
            m2_dropped: 0,
            constant_r2: -3.0,
            m3_r2: r2,
            encoder: "e".to_owned(),
            m4_r2: r2,
            m4_translation: r2,
            m4_rotation: r2,
            m4_deviation: 0.1,
            m4_runs: vec![r2],
        };

        let scores = [
            score("a", 0.2, 5.5, -1.0),
            score("a", 0.4, 5.5, 0.0),
            score("b", 0.5, 9.0, -2.0),
        ];
        let table = layers_table(&scores);
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

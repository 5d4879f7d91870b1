//! M1 to M4 by layer.

use serde_json::{Value, json};

use super::table::aligned;
use crate::scores::mean;

/// M1 to M4 of one set of features in one room.
#[derive(Debug, Clone, PartialEq)]
pub struct LayerScores {
    /// The features' name.
    pub features: String,
    /// The room's.
    pub room: String,
    /// Columns.
    pub dim: usize,
    /// Mutual k-NN, 0 to 1.
    pub m1: f64,
    /// TwoNN, linear.
    pub m2_two_nn: f64,
    /// MLE over 20 neighbours, harmonic, divided by K − 1.
    pub m2_mle: f64,
    /// Duplicate rows that M2 dropped.
    pub m2_dropped: usize,
    /// Test R² of the ridge.
    pub m3_r2: f64,
    /// What made the features, for instance `dinov2@SHA`.
    pub encoder: String,
    /// Mean test R² of the adapters.
    pub m4_r2: f64,
    /// The same over the components of v.
    pub m4_translation: f64,
    /// The same over the components of ω.
    pub m4_rotation: f64,
    /// Its sample deviation over seeds; NaN for one seed.
    pub m4_deviation: f64,
    /// Test R² by seed.
    pub m4_runs: Vec<f64>,
}

/// A line a layer, means over rooms, a star at the best of each metric.
pub fn layers_table(scores: &[LayerScores]) -> String {
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

    let mut lines = vec![
        [
            "features", "columns", "M1", "TwoNN", "MLE", "M3 R²", "M4 R²",
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

        if spread[row].is_finite() {
            let last = cells.pop().unwrap_or_default();
            cells.push(format!(
                "{} ± {:.3}{}",
                last[..last.len() - 1].trim(),
                spread[row],
                &last[last.len() - 1..]
            ));
        }

        lines.push(cells);
    }

    aligned(&lines)
}

/// A line an encoder, by its layer of the highest mean test R² of the adapters: what becomes of
/// checkpoints of one encoder. The shape of the paper's ablation table (sec. 2.7).
pub fn encoders_table(scores: &[LayerScores]) -> String {
    type Layer<'a> = (&'a str, Vec<&'a LayerScores>);

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

/// One entry a layer and room.
pub fn layers_json(scores: &[LayerScores]) -> Value {
    let entry = |score: &LayerScores| {
        json!({
            "features": score.features,
            "room": score.room,
            "columns": score.dim,
            "m1": { "value": score.m1 },
            "m2": { "twonn": score.m2_two_nn, "mle": score.m2_mle, "dropped_rows": score.m2_dropped },
            "m3": { "r2": score.m3_r2 },
            "encoder": score.encoder,
            "m4": { "r2": score.m4_r2, "translation": score.m4_translation, "rotation": score.m4_rotation, "deviation": score.m4_deviation, "runs": score.m4_runs },
        })
    };

    json!({ "layers": scores.iter().map(entry).collect::<Vec<_>>() })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand. Means over two rooms; the dimension nearest to 6 is the best, not the
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

//! The probe metrics M1 to M4 of features in rooms, for `seese3 probe`.

use serde_json::{Map, Value, json};

use super::json::{motion_json, parts_json};
use super::table::aligned;
use crate::experiments::probe::{AtStride, DimensionProtocol, ProbeScores};
use crate::probes::{Bound, Counted, Duplicates, IntrinsicDimension, Mle, MutualKnn};
use seese3_core::motion_scores::MotionScores;
use seese3_core::statistics::{deviation, mean_of_known};

/// The scores as `{"m1": {"value": …}, "m2": {"twonn": …, "mle": …}, "m3": {"r2": …}, "m4":
/// {"r2": …}}`, each metric with its settings.
pub fn probe_json(scores: &ProbeScores) -> Value {
    let mut object = Map::new();
    object.insert("room".to_owned(), json!(scores.room));
    if let Some((value, options)) = &scores.m1 {
        object.insert("m1".to_owned(), m1_json(*value, options));
    }
    if let Some((dimension, options)) = &scores.m2 {
        object.insert("m2".to_owned(), m2_json(dimension, *options));
    }

    for (name, strides) in [("m3", &scores.m3), ("m4", &scores.m4)] {
        // The first stride also stands at the top of the entry, so that a probe of a single
        // stride can be read without looking into `strides`.
        if let Some(first) = strides.first() {
            let mut entry = stride_json(first);

            let all: Vec<Value> = strides
                .iter()
                .map(|at| Value::Object(stride_json(at)))
                .collect();
            entry.insert("strides".to_owned(), json!(all));

            object.insert(name.to_owned(), Value::Object(entry));
        }
    }

    Value::Object(object)
}

fn m1_json(value: f64, options: &MutualKnn) -> Value {
    let &MutualKnn {
        frames,
        stride,
        k,
        exclusion,
        counted,
        bound,
    } = options;

    json!({
        "value": value,
        "frames": frames,
        "stride": stride,
        "k": k,
        "exclusion": exclusion,
        "exclusion_counts": match counted { Counted::Sampled => "sampled frames", Counted::Native => "room frames" },
        "exclusion_is": match bound { Bound::Inclusive => "inclusive", Bound::Exclusive => "exclusive" },
    })
}

fn m2_json(dimension: &IntrinsicDimension, options: DimensionProtocol) -> Value {
    let DimensionProtocol { gap, duplicates } = options;

    let mle =
        |mle: &Mle| json!({ "harmonic": mle.harmonic, "mean": mle.mean, "median": mle.median });

    json!({
        "twonn": dimension.two_nn.linear,
        "mle": dimension.mle_biased.harmonic,
        "twonn_censored": dimension.two_nn.censored,
        "twonn_likelihood": dimension.two_nn.likelihood,
        "mle_biased": mle(&dimension.mle_biased),
        "mle_unbiased": mle(&dimension.mle_unbiased),
        "gap": gap,
        "duplicates": match duplicates { Duplicates::DropRows => "dropped", Duplicates::KeepFirst => "first kept" },
        "used_rows": dimension.used,
        "dropped_rows": dimension.dropped,
    })
}

fn stride_json(at: &AtStride) -> Map<String, Value> {
    let overall: Vec<f64> = at.runs.iter().map(|run| run.overall).collect();
    let mut entry = Map::new();
    entry.insert("stride".to_owned(), json!(at.stride));
    entry.insert("r2".to_owned(), json!(mean_of_known(&overall)));

    // A single run has no standard deviation.
    if at.runs.len() > 1 {
        entry.insert("sd".to_owned(), json!(deviation(&overall)));
        entry.insert("by_part".to_owned(), parts_json(&at.runs));
    }

    entry.insert(
        "n".to_owned(),
        json!(at.runs.first().map_or(0, |run| run.n)),
    );

    entry.insert(
        "runs".to_owned(),
        json!(at.runs.iter().map(motion_json).collect::<Vec<_>>()),
    );

    entry
}

/// One line per room and metric, for M3 and M4 per stride.
pub fn probe_table(scores: &[ProbeScores]) -> String {
    let head = [
        "room", "metric", "value", "sd", "transl.", "rotation", "direct.", "magnit.", "n",
    ];
    let mut lines = vec![head.map(str::to_owned).to_vec()];

    for score in scores {
        let mut line = |metric: String, values: &[String]| {
            lines.push(
                [score.room.clone(), metric]
                    .into_iter()
                    .chain(values.iter().cloned())
                    .collect(),
            );
        };

        if let Some((value, options)) = &score.m1 {
            // M1 has only a value and a number of frames: empty cells keep the latter in the
            // column `n`.
            let absent = || "".to_owned();
            let cells = [
                format!("{value:.3}"),
                absent(),
                absent(),
                absent(),
                absent(),
                absent(),
            ];

            line(
                "M1".to_owned(),
                &[cells.as_slice(), &[options.frames.to_string()]].concat(),
            );
        }

        if let Some((dimension, ..)) = &score.m2 {
            line(
                "M2 TwoNN".to_owned(),
                &[format!("{:.3}", dimension.two_nn.linear)],
            );

            line(
                "M2 MLE".to_owned(),
                &[format!("{:.3}", dimension.mle_biased.harmonic)],
            );
        }

        for (name, strides) in [("M3", &score.m3), ("M4", &score.m4)] {
            for at in strides.iter() {
                line(format!("{name} s{}", at.stride), &stride_cells(at));
            }
        }
    }

    aligned(&lines)
}

fn stride_cells(at: &AtStride) -> Vec<String> {
    let column = |figure: fn(&MotionScores) -> f64| at.runs.iter().map(figure).collect::<Vec<_>>();
    let overall = column(|run| run.overall);
    let spread = if at.runs.len() > 1 {
        format!("{:.3}", deviation(&overall))
    } else {
        String::new()
    };

    let parts = [
        column(|run| run.translation),
        column(|run| run.rotation),
        column(|run| run.direction),
        column(|run| run.magnitude),
    ];

    let mut cells = vec![format!("{:.3}", mean_of_known(&overall)), spread];
    cells.extend(
        parts
            .iter()
            .map(|part| format!("{:.3}", mean_of_known(part))),
    );

    cells.push(at.runs.first().map_or(0, |run| run.n).to_string());
    cells
}

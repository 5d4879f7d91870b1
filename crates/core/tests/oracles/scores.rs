//! R² by component and ridge regression against scikit-learn.

use std::path::PathBuf;

use ndarray::{Array2, ArrayView2};
use seese3_core::geometry::{Twist, body_twist};
use seese3_core::motion_scores::{MotionScores, constant_r2};
use seese3_core::ridge::{Intercept, Ridge};
use seese3_core::room::Timeline;
use seese3_core::splits::Split;

use seese3_testing::{Tensors, features, golden, json, near_each, number, poses, worst};

fn twists(value: &serde_json::Value) -> Vec<Twist> {
    let row = |row: &serde_json::Value| {
        Twist::from_vector(&nalgebra::Vector6::from_fn(|c, _| number(&row[c])))
    };
    value.as_array().unwrap().iter().map(row).collect()
}

fn compare(scores: &MotionScores, expected: &serde_json::Value) {
    let numbers = [
        ("overall", scores.overall, 1e-9),
        ("translation", scores.translation, 1e-9),
        ("rotation", scores.rotation, 1e-9),
        ("direction", scores.direction, 1e-9),
        ("magnitude", scores.magnitude, 1e-9),
    ];
    near_each("scores", expected, &numbers);

    let count = |key: &str| expected[key].as_u64().unwrap();
    assert_eq!(
        scores.direction_pairs_dropped as u64,
        count("direction_pairs_dropped")
    );
    assert_eq!(scores.n as u64, count("n_pairs"));
}

/// Oracle: scikit-learn's `r2_score` on twelve pairs of which three hardly move.
#[test]
fn components_match_scikit_learn() {
    let case = &json(&golden().join("m3_ridge/expected.json"))["component_case"];
    compare(
        &MotionScores::of(&twists(&case["target"]), &twists(&case["prediction"])),
        &case["expected"],
    );
}

/// Oracle: scikit-learn's `Ridge(alpha=1)` on feature differences, its coefficients, its test R²,
/// and the R² of predicting the training mean.
fn ridge_and_its_scores_match_scikit_learn(room: &str, folder: PathBuf) {
    let expected = json(&folder.join("m3_ridge/expected.json"));
    let tensors = Tensors::open(&folder.join("m3_ridge/expected.safetensors"));
    let z = features(&folder, room).mapv(f64::from);
    let poses = poses(&folder.join(format!("rooms/{room}/poses.npy")));

    for stride in [10u32, 20, 40] {
        let expected = &expected[room][format!("stride_{stride}")];

        let sides = [
            Split::Time.train_pairs(&Timeline::unbroken(poses.len()), stride),
            Split::Time.test_pairs(&Timeline::unbroken(poses.len()), stride),
        ];

        let [(train_x, train_y), (test_x, test_y)] = sides.map(|pairs| {
            let pairs = pairs.unwrap();
            let twists: Vec<Twist> = pairs
                .iter()
                .map(|p| body_twist(&poses[p.source.row()], &poses[p.target.row()]))
                .collect();

            let rows = |end: fn(&seese3_core::splits::Pair) -> usize| {
                z.select(ndarray::Axis(0), &pairs.iter().map(end).collect::<Vec<_>>())
            };

            (rows(|p| p.target.row()) - rows(|p| p.source.row()), twists)
        });

        let scale = seese3_core::adapter::TargetScale::of(&train_y);
        let targets =
            Array2::from_shape_fn((train_y.len(), 6), |(r, c)| scale.normalized(train_y[r])[c]);
        let fit = Ridge::fit(train_x.view(), targets.view(), 1.0, Intercept::Fitted).unwrap();
        let off = worst(
            &fit.coefficients,
            &tensors.rows(&format!("{room}_s{stride}_coef")),
        );

        assert!(off < 1e-9, "{room} {stride}: coefficients off by {off}");

        let predict = |x: ArrayView2<'_, f64>| -> Vec<Twist> {
            let row = |x| scale.twist(&nalgebra::Vector6::from_fn(|c, _| fit.predict(x)[c]));
            x.outer_iter().map(row).collect()
        };
        let scores = MotionScores::of(&test_y, &predict(test_x.view()));
        compare(&scores, &expected["test"]);

        let baseline = constant_r2(&test_y, &scale.mean);
        let numbers = [("baseline_predict_train_mean_r2", baseline, 1e-9)];
        near_each("train mean", expected, &numbers);
    }
}

seese3_testing::on_oracle_rooms!(ridge_and_its_scores_match_scikit_learn);

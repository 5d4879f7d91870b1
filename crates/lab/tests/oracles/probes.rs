//! M1, M2 and M3 against NumPy, scikit-learn, scikit-dimension and DADApy.

use std::path::PathBuf;

use ndarray::{Array2, Axis};
use seese3_core::room::{Frames, Provenance, Room, RoomId};
use seese3_core::splits::Split;
use seese3_lab::probes::{
    Error, IntrinsicDimension, MutualKnn, feature_neighbors, intrinsic_dimension, mutual_knn,
    pose_neighbors, ridge_probe,
};
use serde_json::Value;

use seese3_testing::{Tensors, features, golden, json, near, npy, number, poses};

fn options(row: &Value) -> MutualKnn {
    let integer = |key: &str| row[key].as_u64().unwrap() as usize;
    MutualKnn {
        frames: 256,
        stride: integer("stride"),
        k: integer("k"),
        exclusion: integer("exclusion"),
        ..MutualKnn::default()
    }
}

/// Oracle: brute force in NumPy, the same as scikit-learn's in all settings.
fn mutual_neighbors_match_brute_force(room: &str, folder: PathBuf) {
    let expected = json(&folder.join("m1_mutual_knn/expected.json"));
    let lists = Tensors::open(&folder.join("m1_mutual_knn/neighbours.safetensors"));
    let z = features(&folder, room);
    let poses = poses(&folder.join(format!("rooms/{room}/poses.npy")));

    for row in expected[room].as_array().unwrap() {
        let options = options(row);
        let found = mutual_knn(z.view(), &poses, &options).unwrap();

        near(
            &format!("{room} {options:?}"),
            found,
            number(&row["score"]),
            1e-12,
        );

        if (options.k, options.exclusion) == (10, 10) {
            let stored = |what: &str| lists.rows(&format!("{room}_s{}_{what}", options.stride));

            let flat = |lists: Vec<Vec<usize>>| {
                Array2::from_shape_vec(
                    (256, 10),
                    lists.concat().into_iter().map(|i| i as f64).collect(),
                )
                .unwrap()
            };

            assert_eq!(
                flat(feature_neighbors(z.view(), &options).unwrap()),
                stored("feature")
            );

            assert_eq!(
                flat(pose_neighbors(&poses, &options).unwrap()),
                stored("pose")
            );
        }
    }
}

seese3_testing::on_oracle_rooms!(mutual_neighbors_match_brute_force);

/// Oracle: six frames by hand (the oracle's README), with ties, and an exclusion that leaves too
/// few.
#[test]
fn six_frames_by_hand() {
    let folder = golden().join("m1_mutual_knn");
    let expected = json(&folder.join("expected.json"));

    let z = npy::<f64>(&folder.join("tiny_features.npy"))
        .mapv(|x| x as f32)
        .into_dimensionality::<ndarray::Ix2>()
        .unwrap();

    let poses = poses(&folder.join("tiny_poses.npy"));
    for row in expected["tiny"].as_array().unwrap() {
        let integer = |key: &str| row[key].as_u64().unwrap() as usize;
        let options = MutualKnn {
            frames: 6,
            stride: 1,
            k: integer("k"),
            exclusion: integer("exclusion"),
            ..MutualKnn::default()
        };

        let found = mutual_knn(z.view(), &poses, &options).unwrap();
        near(&format!("{options:?}"), found, number(&row["score"]), 1e-12);
        let neighbors = feature_neighbors(z.view(), &options).unwrap();

        assert_eq!(serde_json::json!(neighbors), row["feature_neighbours"]);
    }

    let too_few = MutualKnn {
        frames: 6,
        stride: 1,
        k: 2,
        exclusion: 3,
        ..MutualKnn::default()
    };

    assert!(matches!(
        mutual_knn(z.view(), &poses, &too_few),
        Err(Error::TooFewCandidates { .. })
    ));

    let too_long = MutualKnn {
        frames: 7,
        ..too_few
    };

    assert!(matches!(
        mutual_knn(z.view(), &poses, &too_long),
        Err(Error::TooFewFrames {
            needed: 7,
            have: 6,
            ..
        })
    ));
}

fn agrees(what: &str, found: &IntrinsicDimension, expected: &Value) {
    let close = |name: &str, found: f64, expected: &Value| {
        let expected = number(expected);
        near(
            &format!("{what} {name}"),
            found,
            expected,
            1e-9 * expected.abs(),
        );
    };

    let two = &expected["twonn_formula"];
    close("linear", found.two_nn.linear, &two["linear"]);
    close("censored", found.two_nn.censored, &two["censored_ml"]);
    close("likelihood", found.two_nn.likelihood, &two["ml"]);

    for (name, mle) in [
        ("biased", &found.mle_biased),
        ("unbiased", &found.mle_unbiased),
    ] {
        let mles = &expected["mle_formula"];
        close(name, mle.harmonic, &mles[format!("mle_{name}")]);
        close(name, mle.mean, &mles[format!("mean_{name}")]);
        close(name, mle.median, &mles[format!("median_{name}")]);
    }

    assert_eq!(found.used as u64, two["used"].as_u64().unwrap(), "{what}");
}

/// Oracle: scikit-dimension on exact distances, and the formulas on SciPy's, for known shapes,
/// duplicates and rooms.
#[test]
fn intrinsic_dimensions_match_scikit_dimension() {
    let folder = golden().join("m2_intrinsic_dimension");
    let expected = json(&folder.join("expected.json"));
    for name in ["gaussian6_in_64", "swiss_roll", "duplicates"] {
        let points: Array2<f32> = npy(&folder.join(format!("{name}.npy")))
            .into_dimensionality()
            .unwrap();
        let found = intrinsic_dimension(points.view(), 0).unwrap();
        let expected = &expected[name];
        let distinct = expected.get("unique_rows_policy");
        agrees(
            name,
            &found,
            distinct.unwrap_or(&expected["temporal_gap_0"]),
        );

        let removed = distinct.map_or(0, |policy| policy["removed"].as_u64().unwrap());
        assert_eq!(found.dropped as u64, removed, "{name}");
    }

    let few = Array2::from_shape_fn((20, 2), |(r, c)| (r * r + c) as f32);
    assert!(intrinsic_dimension(few.view(), 0).is_err());
}

/// Oracle: two ways to one number: every row filmed twice, with twice the gap and the copy, is the
/// room filmed once.
#[test]
fn copies_are_no_points_and_gaps_count_rows() {
    let points: Array2<f32> = npy(&golden().join("m2_intrinsic_dimension/swiss_roll.npy"))
        .into_dimensionality()
        .unwrap();
    let twice: Vec<usize> = (0..2 * points.nrows()).map(|row| row / 2).collect();
    let copied = points.select(Axis(0), &twice);
    let once = intrinsic_dimension(points.view(), 5).unwrap();
    let found = intrinsic_dimension(copied.view(), 11).unwrap();
    assert_eq!(
        (found.two_nn, found.mle_biased),
        (once.two_nn, once.mle_biased)
    );
    assert_eq!(
        (found.used, found.dropped),
        (points.nrows(), points.nrows())
    );
}

/// Oracle: scikit-dimension on the rooms' features.
fn intrinsic_dimensions_of_rooms_match_scikit_dimension(room: &str, folder: PathBuf) {
    let expected = json(&folder.join("m2_intrinsic_dimension/expected.json"));
    let z = features(&folder, room);
    let expected = &expected[format!("{room}_all")];
    let distinct = expected.get("unique_rows_policy");
    let found = intrinsic_dimension(z.view(), 0).unwrap();
    agrees(
        room,
        &found,
        distinct.unwrap_or(&expected["temporal_gap_0"]),
    );

    // The oracle has no value of distinct rows with a gap.
    if distinct.is_none() {
        let found = intrinsic_dimension(z.view(), 10).unwrap();
        agrees(room, &found, &expected["temporal_gap_10"]);
    }
}

seese3_testing::on_oracle_rooms!(intrinsic_dimensions_of_rooms_match_scikit_dimension);

/// Oracle: scikit-learn's Ridge and r2_score on the same pairs.
fn the_ridge_probe_matches_scikit_learn(name: &str, folder: PathBuf) {
    let expected = json(&folder.join("m3_ridge/expected.json"));
    let poses = poses(&folder.join(format!("rooms/{name}/poses.npy")));
    let frames = Frames {
        poses,
        ..Frames::default()
    };
    let room = Room::new(RoomId::new(name).unwrap(), frames, Provenance::default()).unwrap();

    let z = features(&folder, name);
    for stride in [10, 20, 40] {
        let found = ridge_probe(z.view(), &room, Split::Time, stride)
            .unwrap()
            .scores();
        let expected = &expected[name][format!("stride_{stride}")]["test"];
        near("overall", found.overall, number(&expected["overall"]), 1e-9);

        near(
            "translation",
            found.translation,
            number(&expected["translation"]),
            1e-9,
        );

        near(
            "rotation",
            found.rotation,
            number(&expected["rotation"]),
            1e-9,
        );
    }
}

seese3_testing::on_oracle_rooms!(the_ridge_probe_matches_scikit_learn);

//! Paths against evo: association, alignment, APE, RPE and their statistics, to 1e-9.

use std::path::{Path, PathBuf};

use seese3_core::trajectory::{
    Alignment, Error, Relation, RpePairs, Similarity, Statistics, Trajectory, ape, associate, rpe,
};
use seese3_data::datasets::read_tum_trajectory;

use seese3_testing::{Tensors, json, near, number};

const TOLERANCE: f64 = 1e-9;

fn path(folder: &Path, room: &str, what: &str) -> Trajectory {
    read_tum_trajectory(&folder.join(format!("trajectory/{room}_{what}.txt"))).unwrap()
}

#[track_caller]
fn compare(what: &str, errors: &[f64], expected: &serde_json::Value) {
    let found = Statistics::of(errors);
    for (name, value) in [
        ("rmse", found.rmse),
        ("mean", found.mean),
        ("median", found.median),
        ("std", found.deviation),
        ("min", found.least),
        ("max", found.largest),
        ("sse", found.sum_of_squares),
    ] {
        near(
            &format!("{what} {name}"),
            value,
            number(&expected[name]),
            TOLERANCE,
        );
    }
}

/// Every figure of a pair of paths.
fn compare_all(
    what: &str,
    reference: &Trajectory,
    estimate: &Trajectory,
    expected: &serde_json::Value,
) {
    let relations = [
        (Relation::Translation, "translation_part"),
        (Relation::Rotation, "rotation_angle_rad"),
        (Relation::Full, "full_transformation"),
    ];

    let alignments = [
        (Alignment::None, "none"),
        (Alignment::Origin, "origin"),
        (Alignment::Se3, "se3_umeyama"),
        (Alignment::Sim3, "sim3_umeyama"),
    ];

    for (alignment, alignment_name) in alignments {
        let aligned = alignment.apply(reference, estimate).unwrap();
        for (relation, name) in relations {
            let key = format!("ape_{name}_{alignment_name}");
            compare(
                &format!("{what} {key}"),
                &ape(reference, &aligned, relation).unwrap(),
                &expected[&key],
            );
        }
    }

    let scale = Similarity::umeyama(reference, estimate, true)
        .unwrap()
        .scale;

    near(
        "scale",
        scale,
        number(&expected["sim3_umeyama_transform"]["s"]),
        TOLERANCE,
    );

    for delta in [1, 5] {
        for (pairs, pairs_name) in [
            (RpePairs::Consecutive, "consecutive"),
            (RpePairs::All, "all_pairs"),
        ] {
            for (relation, name) in &relations[..2] {
                let key = format!("rpe_{name}_delta{delta}_{pairs_name}");
                let errors = rpe(reference, estimate, *relation, delta, pairs).unwrap();
                assert_eq!(
                    errors.len() as f64,
                    number(&expected[&key]["n"]),
                    "{what} {key}"
                );

                compare(&format!("{what} {key}"), &errors, &expected[&key]);
            }
        }
    }
}

/// Oracle: evo 1.38.1 on the same files.
fn errors_of_paths_are_those_of_evo(room: &str, folder: PathBuf) {
    let expected = json(&folder.join(format!("trajectory/{room}_expected.json")));
    let reference = path(&folder, room, "groundtruth");
    let estimate = path(&folder, room, "odometry");
    compare_all(room, &reference, &estimate, &expected["all_frames"]);

    let held_out = expected["test_frames_only"]["n_poses"].as_u64().unwrap() as usize;
    let places: Vec<usize> = (reference.len() - held_out..reference.len()).collect();

    compare_all(
        room,
        &reference.select(&places),
        &estimate.select(&places),
        &expected["test_frames_only"],
    );

    let tensors = Tensors::open(&folder.join(format!("trajectory/{room}_expected.safetensors")));
    let errors = ape(&reference, &estimate, Relation::Translation).unwrap();
    let theirs = tensors.rows("all.ape_translation_part_none");

    assert_eq!(errors.len(), theirs.len());

    for (ours, theirs) in errors.iter().zip(theirs) {
        near("one error", *ours, theirs, TOLERANCE);
    }
}

seese3_testing::on_oracle_rooms!(errors_of_paths_are_those_of_evo);

/// Oracle: evo 1.38.1: which poses of a path with jitter, two late ones and three missing belong to
/// which.
fn poses_are_associated_as_evo_does(room: &str, folder: PathBuf) {
    let expected = &json(&folder.join(format!("trajectory/{room}_expected.json")))["jittered"];
    let reference = path(&folder, room, "groundtruth");
    let estimate = path(&folder, room, "odometry_jittered");
    let found = associate(&reference, &estimate, 10_000_000).unwrap();

    let places = |key: &str| {
        expected[key]
            .as_array()
            .unwrap()
            .iter()
            .map(|x| x.as_u64().unwrap() as usize)
            .collect::<Vec<_>>()
    };

    assert_eq!(found.reference, places("reference_index"));
    assert_eq!(found.estimate, places("estimate_index"));

    compare_all(
        room,
        &reference.select(&found.reference),
        &estimate.select(&found.estimate),
        expected,
    );

    // The longer path is the one that is searched, whichever it is.
    let other = associate(&estimate, &reference, 10_000_000).unwrap();
    assert_eq!(
        (other.reference, other.estimate),
        (found.estimate, found.reference)
    );
}

seese3_testing::on_oracle_rooms!(poses_are_associated_as_evo_does);

/// Oracle: by hand: what has no answer.
#[test]
fn paths_that_cannot_be_compared_are_refused() {
    let at = |x: f64| seese3_core::geometry::Pose::translation(x, 0.0, 0.0);
    let line = |n: usize| Trajectory {
        times_ns: (0..n as i64).collect(),
        poses: (0..n).map(|i| at(i as f64)).collect(),
    };

    assert_eq!(
        ape(&line(3), &line(2), Relation::Full),
        Err(Error::Unequal {
            reference: 3,
            estimate: 2
        })
    );

    assert_eq!(
        Alignment::Se3.apply(&line(5), &line(5)),
        Err(Error::Degenerate { have: 5 })
    );

    let pairs = RpePairs::Consecutive;
    assert_eq!(
        rpe(&line(3), &line(3), Relation::Full, 3, pairs),
        Err(Error::NoPairs { have: 3, delta: 3 })
    );

    let later = Trajectory {
        times_ns: vec![100],
        poses: vec![at(0.0)],
    };

    assert_eq!(
        associate(&line(3), &later, 10),
        Err(Error::NothingMatches {
            max_difference_ns: 10
        })
    );
}

//! The researchers' commands as they are run: probe, cross-room, sweeps, theory.

use std::path::Path;

use crate::program::{refuses, succeeds, text};
use seese3_testing::{golden, json, near, number};

/// A store with the oracle's two rooms, `a` and `b`.
fn stored(folder: &Path) -> String {
    let store = text(&folder.join("store")).to_owned();
    for (room, golden_room) in [("a", "synthetic"), ("b", "synthetic_b")] {
        let poses = golden().join(format!("rooms/{golden_room}/poses.npy"));

        let features = format!(
            "fourier={}",
            text(&golden().join(format!("rooms/{golden_room}/features.npy")))
        );

        succeeds(&[
            "import",
            "numpy",
            "--room",
            room,
            "--poses",
            text(&poses),
            "--features",
            &features,
            "--store",
            &store,
        ]);
    }

    store
}

/// Oracle: NumPy, scikit-dimension and scikit-learn on the same room; the shape that the manual
/// promises to scripts.
#[test]
fn probe_writes_the_oracles_figures() {
    let folder = tempfile::tempdir().unwrap();
    let store = stored(folder.path());
    let file = folder.path().join("probe.json");

    let fixed = [
        "probe",
        "--store",
        &store,
        "--room",
        "a",
        "--features",
        "fourier",
        "--json",
        text(&file),
    ];

    let printed = succeeds(&[&fixed[..], &["--epochs", "1", "--seeds", "2"]].concat());
    assert!(
        printed.contains("M2 TwoNN") && printed.contains("M4 s40"),
        "{printed}"
    );

    let found = json(&file);
    let m2 = json(&golden().join("m2_intrinsic_dimension/expected.json"));
    let formula = &m2["synthetic_all"]["temporal_gap_0"];

    near(
        "twonn",
        number(&found["m2"]["twonn"]),
        number(&formula["twonn_formula"]["linear"]),
        1e-9,
    );

    near(
        "mle",
        number(&found["m2"]["mle"]),
        number(&formula["mle_formula"]["mle_biased"]),
        1e-9,
    );

    let m3 = json(&golden().join("m3_ridge/expected.json"));
    near(
        "m3",
        number(&found["m3"]["r2"]),
        number(&m3["synthetic"]["stride_40"]["test"]["overall"]),
        1e-9,
    );

    assert!(
        number(&found["m1"]["value"]) > 0.0 && found["m4"]["runs"].as_array().unwrap().len() == 2
    );

    assert_eq!(found["m2"]["dropped_rows"], 0);

    let two = [
        &fixed[..],
        &[
            "--metrics",
            "m1,m3",
            "--sweep-strides",
            "10,40",
            "--m1-stride",
            "2",
        ],
    ]
    .concat();

    succeeds(&two);
    let found = json(&file);
    assert!(found.get("m2").is_none() && found.get("m4").is_none());
    assert_eq!(found["m3"]["strides"].as_array().unwrap().len(), 2);

    assert_eq!(
        (&found["m1"]["stride"], &found["m3"]["stride"]),
        (&2.into(), &10.into())
    );

    refuses(
        &[
            "probe",
            "--store",
            &store,
            "--room",
            "a",
            "--m1-frames",
            "9999",
        ],
        &["room 'a'", "M1", "9999"],
    );

    refuses(
        &["probe", "--store", &store, "--room", "nothing*"],
        &["nothing*"],
    );
}

/// Oracle: the definitions. What is held out is not learned from, the calibrated navigator is there
/// when rooms are kept aside, and what cannot be answered is refused before anything is trained.
#[test]
fn cross_room_compares_with_identity_room_by_room() {
    let folder = tempfile::tempdir().unwrap();
    let store = stored(folder.path());
    let file = folder.path().join("c.json");

    let fixed = [
        "cross-room",
        "--store",
        &store,
        "--train",
        "a",
        "--test",
        "b",
        "--split",
        "whole",
        "--epochs",
        "3",
    ];

    let printed = succeeds(&[&fixed[..], &["--rooms", "--json", text(&file)]].concat());
    assert!(
        printed.contains("beats Identity in")
            && printed.lines().any(|line| line.starts_with("b  ")),
        "{printed}"
    );

    let run = json(&file)["runs"][0].clone();
    let identity = &run["navigators"][0];
    assert_eq!(
        (&identity["name"], &identity["beats_identity"]["rate"]),
        (&"identity".into(), &0.0.into())
    );

    assert_eq!(run["rooms"][0]["motion"]["n"], 360);
    assert_eq!(run["rooms"][0]["candidates"], 400);

    refuses(
        &[
            "cross-room",
            "--store",
            &store,
            "--train",
            "a",
            "--test",
            "*",
        ],
        &["is in both --train and --test"],
    );

    refuses(
        &[&fixed[..], &["--calibration-rooms", "1"]].concat(),
        &["--calibration-rooms"],
    );

    for navigator in [
        "corrector-linear",
        "inverse-poincare-homogeneous+calibrated",
        "ridge-refit",
    ] {
        refuses(
            &[&fixed[..], &["--navigators", navigator]].concat(),
            &["--navigators"],
        );
    }

    refuses(
        &[&fixed[..], &["--threshold", "nan"]].concat(),
        &["threshold"],
    );

    let poses = golden().join("rooms/synthetic/poses.npy");

    let features = format!(
        "fourier={}",
        text(&golden().join("rooms/synthetic/features.npy"))
    );

    succeeds(&[
        "import",
        "numpy",
        "--room",
        "c",
        "--poses",
        text(&poses),
        "--features",
        &features,
        "--store",
        &store,
    ]);

    let aside = succeeds(
        &[
            &fixed[..],
            &[
                "--train",
                "c",
                "--calibration-rooms",
                "1",
                "--json",
                text(&file),
            ],
        ]
        .concat(),
    );

    assert!(
        aside.contains("inverse-poincare-homogeneous+calibrated"),
        "{aside}"
    );

    let run = json(&file)["runs"][0].clone();
    assert_eq!(
        (
            run["learned_rooms"].as_array().unwrap().len(),
            run["calibration_rooms"].as_array().unwrap().len()
        ),
        (1, 1)
    );

    refuses(
        &[&fixed[..], &["--baseline", "best"]].concat(),
        &["--baseline", "best"],
    );
}

fn sweep<'a>(store: &'a str, out: &'a str, shard: &'a str) -> Vec<&'a str> {
    let grid = [
        "--geo-dims",
        "8,20",
        "--chart-counts",
        "1,2",
        "--lrs",
        "1e-3",
        "--losses",
        "mse,rotation",
    ];

    let fixed = [
        "sweep", "adapters", "--store", store, "--room", "a", "--seeds", "2", "--epochs", "2",
    ];
    [&fixed[..], &grid, &["--out", out, "--shard", shard]].concat()
}

/// The rows of a sweep by key, without their times.
fn rows(out: &Path) -> Vec<String> {
    let mut rows: Vec<String> = std::fs::read_dir(out)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| text(path).ends_with(".jsonl"))
        .flat_map(|path| {
            std::fs::read_to_string(path)
                .unwrap()
                .lines()
                .map(str::to_owned)
                .collect::<Vec<_>>()
        })
        .map(|line| line.split("\"seconds\"").next().unwrap().to_owned())
        .collect();

    rows.sort();
    rows
}

/// Oracle: a sweep that was never cut. 2 · 2 · 1 · 2 configurations, two seeds: 16 runs, each once,
/// however they are cut.
#[test]
fn a_cut_or_sharded_sweep_gives_the_same_rows() {
    let folder = tempfile::tempdir().unwrap();
    let store = stored(folder.path());
    let [whole, cut, shards] = ["whole", "cut", "shards"].map(|name| folder.path().join(name));
    let printed = succeeds(&sweep(&store, text(&whole), "1/1"));

    assert!(
        printed.contains("16 runs, 16 of them to be done here"),
        "{printed}"
    );

    let expected = rows(&whole);
    assert_eq!(expected.len(), 16);

    std::fs::create_dir(&cut).unwrap();
    let journal = "shard-1-of-1.runs.jsonl";
    let lines = std::fs::read_to_string(whole.join(journal)).unwrap();
    let kept: Vec<&str> = lines.lines().take(5).collect();
    std::fs::write(
        cut.join(journal),
        format!("{}\n{}", kept.join("\n"), &kept[0][..40]),
    )
    .unwrap();

    let printed = succeeds(&sweep(&store, text(&cut), "1/1"));
    assert!(
        printed.contains("16 runs, 11 of them to be done here"),
        "{printed}"
    );

    assert_eq!(rows(&cut), expected);

    for shard in ["2/3", "1/3", "3/3"] {
        succeeds(&sweep(&store, text(&shards), shard));
    }

    assert_eq!(rows(&shards), expected);

    let printed = succeeds(&sweep(&store, text(&shards), "1/1"));
    assert!(printed.contains("0 of them to be done here"), "{printed}");

    let parquet = std::fs::read(shards.join("runs.parquet")).unwrap();
    assert!(parquet.starts_with(b"PAR1") && parquet.ends_with(b"PAR1"));

    refuses(&sweep(&store, text(&shards), "4/3"), &["--shard", "4/3"]);

    refuses(
        &[&sweep(&store, text(&shards), "1/1")[..], &["--lr", "0.1"]].concat(),
        &["--lr", "--lrs"],
    );

    refuses(
        &[
            &sweep(&store, text(&shards), "1/1")[..],
            &["--split", "whole"],
        ]
        .concat(),
        &["--split whole"],
    );

    // Another protocol in the same folder is another table.
    let other = [
        &sweep(&store, text(&shards), "1/1")[..],
        &["--split", "pairs"],
    ]
    .concat();
    let printed = succeeds(&other);

    assert!(
        printed.contains("16 of them to be done here") && printed.contains("split pairs"),
        "{printed}"
    );

    assert!(
        printed.contains("over 16 runs") && printed.contains("(32 rows"),
        "{printed}"
    );

    std::fs::write(cut.join(journal), "{}\n").unwrap();

    refuses(
        &sweep(&store, text(&cut), "1/1"),
        &["shard-1-of-1.runs.jsonl", "line 1"],
    );
}

/// Oracle: the number of formulations and the order of the paper's table; the adapter's row is what
/// `train` says.
#[test]
fn formulations_stand_beside_the_adapter() {
    let folder = tempfile::tempdir().unwrap();
    let store = stored(folder.path());
    let file = folder.path().join("f.json");
    let trained = folder.path().join("t.json");

    let common = ["--store", &store, "--room", "a", "--epochs", "3"];
    let printed = succeeds(
        &[
            &[
                "sweep",
                "formulations",
                "--seeds",
                "1",
                "--json",
                text(&file),
            ][..],
            &common,
        ]
        .concat(),
    );

    let names: Vec<&str> = printed
        .lines()
        .skip(2)
        .filter_map(|line| line.split_whitespace().next())
        .take(5)
        .collect();

    assert_eq!(
        names,
        [
            "poincare",
            "a-unanchored",
            "b-absolute",
            "c-se3-mlp",
            "d-difference-input"
        ]
    );

    succeeds(&[&["train", "--json", text(&trained)][..], &common].concat());
    let found = json(&file);
    let trained = json(&trained);

    assert_eq!(
        found["formulations"][0]["runs"][0]["r2"],
        trained["runs"][0]["test"]["r2"]
    );
}

/// Oracle: the theorems.
#[test]
fn theory_keeps_its_bounds() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("t.json");

    let printed = succeeds(&[
        "theory",
        "--poses",
        "400",
        "--samples",
        "16",
        "--json",
        text(&file),
    ]);

    assert!(!printed.contains("NOT KEPT"), "{printed}");

    let found = json(&file);
    assert!(
        found["checks"]
            .as_array()
            .unwrap()
            .iter()
            .all(|check| check["holds"] == true)
    );
}

/// Oracle: by hand: charts, correctors and calibration are asked for, published, and listed by
/// evaluate's table.
#[test]
fn what_is_trained_is_evaluated() {
    let folder = tempfile::tempdir().unwrap();
    let store = stored(folder.path());
    let fixed = [
        "train", "--store", &store, "--room", "a", "--epochs", "2", "--stride", "20",
    ];

    succeeds(
        &[
            &fixed[..],
            &[
                "--correctors",
                "all",
                "--calibrate-on",
                "b",
                "--name",
                "all",
            ],
        ]
        .concat(),
    );

    let evaluate = [
        "evaluate",
        "--store",
        &store,
        "--room",
        "a",
        "--adapter",
        "all",
    ];

    let printed = succeeds(&evaluate);
    for row in [
        "corrector-attention",
        "inverse-poincare-affine+row-space",
        "inverse-poincare-homogeneous+calibrated",
    ] {
        assert!(printed.contains(row), "{printed}");
    }

    let chosen = [
        "--navigators",
        "identity,corrector-mlp-2+whitened",
        "--steps",
        "3",
        "--mode",
        "closed-loop",
    ];

    let printed = succeeds(&[&evaluate[..], &chosen].concat());
    assert!(
        printed.contains("corrector-mlp-2+whitened") && !printed.contains("ridge-refit"),
        "{printed}"
    );

    refuses(
        &[&evaluate[..], &["--navigators", "best"]].concat(),
        &["--navigators", "best", "ridge-refit"],
    );

    refuses(
        &[
            &evaluate[..],
            &["--split", "whole", "--navigators", "ridge-refit"],
        ]
        .concat(),
        &["in-sample"],
    );

    let printed = succeeds(&[
        "evaluate",
        "--store",
        &store,
        "--room",
        "b",
        "--adapter",
        "all",
    ]);

    assert!(
        printed.contains("LEAK") && printed.contains("errors were measured in this room"),
        "{printed}"
    );

    refuses(
        &[&fixed[..], &["--calibrate-on", "a"]].concat(),
        &["'a'", "learned from"],
    );

    refuses(&[&fixed[..], &["--charts", "0"]].concat(), &["charts"]);

    refuses(
        &[&fixed[..], &["--geo-dim", "5"]].concat(),
        &["geo_dim", "5"],
    );

    refuses(&[&fixed[..], &["--lr", "nan"]].concat(), &["learning rate"]);
    refuses(&[&fixed[..], &["--strides", "40"]].concat(), &["--strides"]);

    refuses(
        &[&fixed[..], &["--preset", "steady", "--charts", "2"]].concat(),
        &["gate"],
    );

    refuses(
        &[&fixed[..], &["--correctors", "mlp-9"]].concat(),
        &["mlp-9", "mlp-3"],
    );
}

/// Oracle: the keys that the manual promises to scripts; what stands still has the true motion for
/// its error; a view is located no worse than by the nearest frame; a name that is taken is kept.
#[test]
fn an_adapter_is_fitted_and_its_views_are_located() {
    let folder = tempfile::tempdir().unwrap();
    let store = stored(folder.path());
    let file = folder.path().join("found.json");
    let in_room = |words: &[&str]| {
        let common = ["--store", &store, "--room", "a", "--json", text(&file)];
        succeeds(&[words, &common[..]].concat());
        json(&file)
    };

    let found = in_room(&["evaluate", "localization", "--fit", "--map-every", "5"]);
    for row in ["ours", "nearest_frame", "nearest_pose", "fitted"] {
        for part in ["translation_m", "rotation_deg"] {
            let errors = &found[row][part];
            assert!(
                number(&errors["median"]) <= number(&errors["p90"]),
                "{row} {part}"
            );
        }
    }
    assert_eq!(
        found["n"].as_u64().unwrap() + found["mapped"].as_u64().unwrap(),
        600
    );
    let median = |row: &str| number(&found[row]["translation_m"]["median"]);
    assert!(median("ours") <= median("nearest_frame"));

    succeeds(&[
        "train", "--store", &store, "--room", "b", "--epochs", "5", "--name", "b",
    ]);
    let motion = in_room(&["evaluate", "motion", "--adapter", "b", "--stride", "10"]);
    assert_eq!(motion["n"].as_u64(), Some(590));
    assert!(number(&motion["no_motion"]["translation_m"]["median"]) > 0.0);
    assert!(number(&motion["ours"]["rotation_deg"]["median"]).is_finite());

    let evaluated = in_room(&["evaluate", "--adapter", "b"]);
    let baselines = &evaluated["baselines"];
    assert!(number(&baselines["constant_r2"]) < 1.0 && number(&baselines["variance_ratio"]) > 0.0);
    assert!(
        baselines["nearest_pose"].is_null(),
        "the adapter never saw the room"
    );
    assert!(baselines["optimiser_steps"].as_u64().unwrap() > 0);

    let fit = ["fit", "--store", &store, "--room", "a", "--name", "fitted"];
    let printed = succeeds(&fit);
    assert!(
        printed.contains("published adapter 'fitted' revision 1"),
        "{printed}"
    );
    assert!(succeeds(&fit).contains("unchanged"));

    refuses(
        &["evaluate", "localization", "--store", &store, "--room", "a"],
        &["--adapter", "--fit"],
    );
    refuses(&["fit", "--store", &store, "--room", "c"], &["'c'"]);

    // What would be measured too well, or replace another adapter, is refused before it is fitted.
    let from_b = ["fit", "--store", &store, "--adapter", "b"];
    refuses(
        &[&from_b[..], &["--room", "b"]].concat(),
        &["'b'", "was trained on"],
    );
    refuses(
        &["fit", "--store", &store, "--room", "a", "--name", "b"],
        &["'b'", "taken"],
    );
    refuses(
        &["fit", "--store", &store, "--room", "a", "--name", "a/b"],
        &["\"a/b\" cannot name an adapter"],
    );
}

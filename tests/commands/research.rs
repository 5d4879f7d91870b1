//! The researchers' commands as they are run: probe, cross-room, sweeps, theory.

use std::fs;

use seese3_testing::{golden, json, near, number};

use crate::program::Place;

/// A place with the oracle's two rooms, `a` and `b`, in its store.
fn stored() -> Place {
    let here = Place::new();
    here.succeeds(&Place::import("a", "synthetic"));
    here.succeeds(&Place::import("b", "synthetic_b"));
    here
}

/// Oracle: NumPy, scikit-dimension and scikit-learn on the same room; the shape that the manual
/// promises to scripts.
#[test]
fn probe_writes_the_oracles_figures() {
    let here = stored();

    let fixed = "probe --store store --room a --features fourier --m2-gap 0 --json found.json";
    let short = format!("{fixed} --epochs 1 --seeds 2");
    here.prints(&short, &["M2 TwoNN", "M4 s40"]);

    let found = here.json("found.json");
    let expected = |folder: &str| json(&golden().join(folder).join("expected.json"));
    let m2 = expected("m2_intrinsic_dimension");
    let formula = &m2["synthetic_all"]["temporal_gap_0"];
    let m3 = expected("m3_ridge");
    let ridge = &m3["synthetic"]["stride_40"]["test"];
    for (metric, key, expected) in [
        ("m2", "twonn", &formula["twonn_formula"]["linear"]),
        ("m2", "mle", &formula["mle_formula"]["mle_biased"]),
        ("m3", "r2", &ridge["overall"]),
    ] {
        near(key, number(&found[metric][key]), number(expected), 1e-9);
    }

    assert!(number(&found["m1"]["value"]) > 0.0);
    assert_eq!(found["m4"]["runs"].as_array().unwrap().len(), 2);
    assert_eq!(found["m2"]["dropped_rows"], 0);

    let two = format!("{fixed} --metrics m1,m3 --sweep-strides 10,40 --m1-stride 2");
    here.succeeds(&two);
    let found = here.json("found.json");
    assert!(found.get("m2").is_none() && found.get("m4").is_none());
    assert_eq!(found["m3"]["strides"].as_array().unwrap().len(), 2);

    assert_eq!(
        (&found["m1"]["stride"], &found["m3"]["stride"]),
        (&2.into(), &10.into())
    );

    here.refuses(
        "probe --store store --room a --m1-frames 9999",
        &["room 'a'", "M1", "9999"],
    );

    here.refuses("probe --store store --room nothing*", &["nothing*"]);
}

/// Oracle: the definitions. What is held out is not learned from, the calibrated navigator is there
/// when rooms are kept aside, and what cannot be answered is refused before anything is trained.
#[test]
fn cross_room_compares_with_identity_room_by_room() {
    let here = stored();

    let fixed = "cross-room --store store --train a --test b --split whole --epochs 3";
    let by_room = format!("{fixed} --rooms --json found.json");
    let printed = here.prints(&by_room, &["beats Identity in"]);
    let is_there = printed.lines().any(|line| line.starts_with("b  "));
    assert!(is_there, "{printed}");

    let run = here.json("found.json")["runs"][0].clone();
    let identity = &run["navigators"][0];
    assert_eq!(
        (&identity["name"], &identity["beats_identity"]["rate"]),
        (&"identity".into(), &0.0.into())
    );

    assert_eq!(run["rooms"][0]["motion"]["n"], 360);
    assert_eq!(run["rooms"][0]["candidates"], 400);

    let in_both = "cross-room --store store --train a --test *";
    here.refuses(in_both, &["is in both --train and --test"]);
    here.refuses_each(
        fixed,
        &[
            ("--calibration-rooms 1", &["--calibration-rooms"]),
            ("--navigators corrector-linear", &["--navigators"]),
            (
                "--navigators inverse-poincare-homogeneous+calibrated",
                &["--navigators"],
            ),
            ("--navigators ridge-refit", &["--navigators"]),
            ("--threshold nan", &["threshold"]),
        ],
    );

    here.succeeds(&Place::import("c", "synthetic"));
    let aside = format!("{fixed} --train c --calibration-rooms 1 --json found.json");
    here.prints(&aside, &["inverse-poincare-homogeneous+calibrated"]);

    let run = here.json("found.json")["runs"][0].clone();
    for rooms in ["learned_rooms", "calibration_rooms"] {
        assert_eq!(run[rooms].as_array().unwrap().len(), 1, "{rooms}");
    }

    here.refuses(&format!("{fixed} --baseline best"), &["--baseline", "best"]);
}

/// A sweep into the folder `out`.
fn sweep(out: &str, shard: &str) -> String {
    let fixed = "sweep adapters --store store --room a --seeds 2 --epochs 2";
    let grid = "--geo-dims 8,20 --chart-counts 1,2 --lrs 1e-3 --losses mse,rotation";
    format!("{fixed} {grid} --out {out} --shard {shard}")
}

/// The rows of a sweep by key, without their times.
fn rows(here: &Place, out: &str) -> Vec<String> {
    let mut rows = Vec::new();
    for entry in fs::read_dir(here.file(out)).unwrap() {
        let path = entry.unwrap().path();
        if path
            .extension()
            .is_some_and(|extension| extension == "jsonl")
        {
            let text = fs::read_to_string(path).unwrap();
            let timeless = text
                .lines()
                .map(|line| line.split("\"seconds\"").next().unwrap());
            rows.extend(timeless.map(str::to_owned));
        }
    }

    rows.sort();
    rows
}

/// Oracle: a sweep that was never cut. 2 · 2 · 1 · 2 configurations, two seeds: 16 runs, each once,
/// however they are cut.
#[test]
fn a_cut_or_sharded_sweep_gives_the_same_rows() {
    let here = stored();
    let whole = sweep("whole", "1/1");
    here.prints(&whole, &["16 runs, 16 of them to be done here"]);

    let expected = rows(&here, "whole");
    assert_eq!(expected.len(), 16);

    fs::create_dir(here.file("cut")).unwrap();
    let journal = |out: &str| here.file(&format!("{out}/shard-1-of-1.runs.jsonl"));
    let lines = fs::read_to_string(journal("whole")).unwrap();
    let kept: Vec<&str> = lines.lines().take(5).collect();
    let kept = format!("{}\n{}", kept.join("\n"), &kept[0][..40]);
    fs::write(journal("cut"), kept).unwrap();

    let cut = sweep("cut", "1/1");
    here.prints(&cut, &["16 runs, 11 of them to be done here"]);
    assert_eq!(rows(&here, "cut"), expected);

    for shard in ["2/3", "1/3", "3/3"] {
        here.succeeds(&sweep("shards", shard));
    }
    assert_eq!(rows(&here, "shards"), expected);

    let shards = sweep("shards", "1/1");
    here.prints(&shards, &["0 of them to be done here"]);

    let parquet = fs::read(here.file("shards/runs.parquet")).unwrap();
    assert!(parquet.starts_with(b"PAR1") && parquet.ends_with(b"PAR1"));

    let beyond = here.run(&sweep("shards", "4/3"));
    assert_eq!(beyond.status.code(), Some(2), "a wrong option");
    here.refuses(&format!("{shards} --lr 0.1"), &["--lr", "--lrs"]);
    here.refuses(&format!("{shards} --split whole"), &["--split whole"]);

    // Another protocol in the same folder is another table.
    let other = format!("{shards} --split pairs");
    let words = [
        "16 of them to be done here",
        "split pairs",
        "over 16 runs",
        "(32 rows",
    ];
    here.prints(&other, &words);

    fs::write(journal("cut"), "{}\n").unwrap();
    here.refuses(&cut, &["shard-1-of-1.runs.jsonl", "line 1"]);
}

/// Oracle: the number of formulations and the order of the paper's table; the adapter's row is what
/// `train` says.
#[test]
fn formulations_stand_beside_the_adapter() {
    let here = stored();

    let common = "--store store --room a --epochs 3";
    let sweep = format!("sweep formulations --seeds 1 --json found.json {common}");
    let printed = here.succeeds(&sweep);
    let lines = printed.lines().skip(2);
    let names = lines.filter_map(|line| line.split_whitespace().next());
    let names: Vec<&str> = names.take(5).collect();
    let expected = "poincare a-unanchored b-absolute c-se3-mlp d-difference-input";
    assert_eq!(names.join(" "), expected);

    here.succeeds(&format!("train --json t.json {common}"));
    let [found, trained] = ["found.json", "t.json"].map(|name| here.json(name));

    assert_eq!(
        found["formulations"][0]["runs"][0]["r2"],
        trained["runs"][0]["test"]["r2"]
    );
}

/// Oracle: the theorems.
#[test]
fn theory_keeps_its_bounds() {
    let here = Place::new();

    let printed = here.succeeds("theory --poses 400 --samples 16 --json found.json");
    assert!(
        printed.contains("≤ 7.0000") && !printed.contains("NOT KEPT"),
        "{printed}"
    );

    let found = here.json("found.json");
    let mut checks = found["checks"].as_array().unwrap().iter();
    assert!(checks.all(|check| check["holds"] == true));
}

/// Oracle: by hand: charts, correctors and calibration are asked for, published, and listed by
/// evaluate's table.
#[test]
fn what_is_trained_is_evaluated() {
    let here = stored();
    let fixed = "train --store store --room a --epochs 2 --stride 20";

    let all = "--correctors all --calibrate-on b --name all";
    here.succeeds(&format!("{fixed} {all}"));

    let evaluate = "evaluate --store store --room a --adapter all";
    let rows = [
        "corrector-attention",
        "inverse-poincare-affine+row-space",
        "inverse-poincare-homogeneous+calibrated",
    ];
    here.prints(evaluate, &rows);

    let chosen = "--navigators identity,corrector-mlp-2+whitened --steps 3 --mode closed-loop";
    let printed = here.prints(
        &format!("{evaluate} {chosen}"),
        &["corrector-mlp-2+whitened"],
    );
    assert!(!printed.contains("ridge-refit"), "{printed}");

    here.refuses_each(
        evaluate,
        &[
            (
                "--navigators best",
                &["--navigators", "best", "ridge-refit"],
            ),
            ("--split whole --navigators ridge-refit", &["in-sample"]),
        ],
    );

    let in_b = "evaluate --store store --room b --adapter all";
    here.prints(in_b, &["LEAK", "errors were measured in this room"]);

    here.refuses_each(
        fixed,
        &[
            ("--calibrate-on a", &["'a'", "was trained on"]),
            ("--charts 0", &["charts"]),
            ("--geo-dim 5", &["geo_dim", "5"]),
            ("--lr nan", &["learning rate"]),
            ("--strides 40", &["--strides"]),
            ("--preset steady --charts 2", &["gate"]),
            ("--correctors mlp-9", &["mlp-9", "mlp-3"]),
        ],
    );
}

/// Oracle: the keys that the manual promises to scripts; what stands still has the true motion for
/// its error; a view is located no worse than by the nearest frame; a name that is taken is kept.
#[test]
fn an_adapter_is_fitted_and_its_views_are_located() {
    let here = stored();
    let in_room = |words: &str| {
        let common = "--store store --room a --json found.json";
        here.succeeds(&format!("{words} {common}"));
        here.json("found.json")
    };

    let found = in_room("evaluate localization --fit --map-every 5");
    for row in ["ours", "nearest_frame", "nearest_pose", "fitted"] {
        for part in ["translation_m", "rotation_deg"] {
            let errors = &found[row][part];
            let [median, p90] = ["median", "p90"].map(|quantile| number(&errors[quantile]));
            assert!(median <= p90, "{row} {part}");
        }
    }
    let [n, mapped] = ["n", "mapped"].map(|key| found[key].as_u64().unwrap());
    assert_eq!(n + mapped, 600);
    let median = |row: &str| number(&found[row]["translation_m"]["median"]);
    assert!(median("ours") <= median("nearest_frame"));

    here.succeeds("train --store store --room b --epochs 5 --name b");
    let motion = in_room("evaluate motion --adapter b --stride 10");
    assert_eq!(motion["n"].as_u64(), Some(590));
    assert!(number(&motion["no_motion"]["translation_m"]["median"]) > 0.0);
    assert!(number(&motion["ours"]["rotation_deg"]["median"]).is_finite());

    let evaluated = in_room("evaluate --adapter b");
    let baselines = &evaluated["baselines"];
    assert!(number(&baselines["constant_r2"]) < 1.0 && number(&baselines["variance_ratio"]) > 0.0);
    let nearest = &baselines["nearest_pose"];
    assert!(nearest.is_null(), "the adapter never saw the room");
    assert!(baselines["optimizer_steps"].as_u64().unwrap() > 0);

    let fit = "fit --store store --room a --name fitted";
    here.prints(fit, &["published adapter 'fitted' revision 1"]);
    here.prints(fit, &["unchanged"]);

    here.refuses(
        "evaluate localization --store store --room a",
        &["--adapter", "--fit"],
    );
    here.refuses(
        "evaluate localization --store store --room a --peer no-such-python",
        &["--peer: cannot run no-such-python", "Python interpreter"],
    );
    here.refuses("fit --store store --room c", &["'c'"]);

    // What would be measured too well, or replace another adapter, is refused before it is fitted.
    here.refuses(
        "fit --store store --adapter b --room b",
        &["'b'", "was trained on"],
    );
    here.refuses("fit --store store --room a --name b", &["'b'", "taken"]);
    here.refuses(
        "fit --store store --room a --name a/b",
        &["\"a/b\" cannot name an adapter"],
    );
}

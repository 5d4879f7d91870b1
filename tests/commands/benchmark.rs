//! Benchmarks: frozen, answered, checked and scored.

use crate::program::Place;

/// Oracle: two ways to one number: the submission of a stored adapter has the Hit@ε that `evaluate`
/// gives the same navigator in the same room. A changed submission is refused by its field.
#[test]
fn submissions_are_scored_as_evaluate_scores() {
    let here = Place::new();
    here.succeeds(&Place::import("r", "synthetic"));
    here.succeeds(&Place::import("r2", "synthetic_b"));
    here.succeeds("train --store store --room r2 --epochs 2 --split whole --stride 20 --name base");
    here.succeeds("train --store store --room r --epochs 2 --split whole --stride 20 --name seen");
    let frozen = here.prints(
        "benchmark freeze --store store --room r --stride 20 --name small --out small.json",
        &["benchmark 'small': 1 rooms, 580 pairs"],
    );
    assert!(frozen.contains("SHA-256"), "{frozen}");

    let answer =
        "benchmark answer --benchmark small.json --store store --adapter base --name paper --about";
    here.succeeds(&format!("{answer} affine --out paper.json"));
    let seen = "benchmark answer --benchmark small.json --store store --adapter seen --name x --about x --out x.json";
    here.refuses(seen, &["'seen' was trained", "'r'"]);
    let oracle = format!("{answer} x --out x.json --navigator oracle");
    here.refuses(&oracle, &["'oracle' uses the targets"]);
    let check = "benchmark check --benchmark small.json";
    here.prints(
        &format!("{check} --submission paper.json"),
        &["'paper' is valid"],
    );
    here.prints(
        "benchmark score --benchmark small.json --store store --submission paper.json --page page.md --json scores.json",
        &["paper", "identity", "over Identity"],
    );
    here.succeeds(
        "evaluate --store store --room r --adapter base --split whole --stride 20 \
         --navigators identity,inverse-poincare-affine --json table.json",
    );

    let [scores, table] = ["scores.json", "table.json"].map(|file| here.json(file));
    let rows = table["navigators"].as_array().unwrap();
    for (method, navigator) in [
        ("identity", "identity"),
        ("paper", "inverse-poincare-affine"),
    ] {
        let submissions = scores["submissions"].as_array().unwrap();
        let ours = submissions
            .iter()
            .find(|one| one["name"] == method)
            .unwrap();
        let theirs = rows.iter().find(|row| row["name"] == navigator).unwrap();
        assert_eq!(
            ours["hits"][0]["hit"]["mean"], theirs["hit"]["0.1"]["rate"],
            "{method}"
        );
        assert_eq!(ours["median_m"], theirs["median_translation_m"], "{method}");
    }
    let page = std::fs::read_to_string(here.file("page.md")).unwrap();
    assert!(
        page.starts_with("# Benchmark small") && page.contains("**paper**: affine"),
        "{page}"
    );

    let text = std::fs::read_to_string(here.file("paper.json")).unwrap();
    std::fs::write(here.file("wrong.json"), text.replace("\"affine\"", "\"\"")).unwrap();
    here.refuses(
        &format!("{check} --submission wrong.json"),
        &["wrong.json", "about: must not be empty"],
    );
    here.refuses(
        &format!("{check} --submission small.json"),
        &["small.json", "unknown field `sha256`"],
    );
    let mut submission = here.json("paper.json");
    submission["frames"]["r"][5] = (-1).into();
    std::fs::write(here.file("wrong.json"), submission.to_string()).unwrap();
    here.refuses(
        &format!("{check} --submission wrong.json"),
        &[
            "wrong.json",
            "frames.r[5]",
            "-1",
            "a whole number from 0 on",
        ],
    );
    here.refuses(
        "benchmark score --benchmark small.json --store store --submission paper.json --submission paper.json",
        &["'paper' is in two submissions"],
    );
}

/// Oracle: two ways to one number: `probe` with the same protocol. A changed file is refused by its
/// field.
#[test]
fn features_are_measured_as_probe_measures() {
    let here = Place::new();
    here.succeeds(&Place::import("r", "synthetic"));
    here.succeeds(
        "benchmark freeze --store store --room r --stride 20 --name small --out small.json",
    );
    let measure = "benchmark probe --benchmark small.json --store store --features fourier";
    here.succeeds(&format!(
        "{measure} --name mine --about Waves. --out mine.json"
    ));
    here.succeeds(
        "probe --store store --room r --features fourier --stride 20 --split folds --preset base \
         --m1-stride 3 --m1-frames 200 --m2-gap 0 --json probe.json -q",
    );

    let [ours, theirs] = ["mine.json", "probe.json"].map(|file| here.json(file));
    let ours = &ours["rooms"]["r"];
    for (key, expected) in [
        ("m1", &theirs["m1"]["value"]),
        ("m2_twonn", &theirs["m2"]["twonn"]),
        ("m2_mle", &theirs["m2"]["mle"]),
        ("m3", &theirs["m3"]["r2"]),
        ("m4", &theirs["m4"]["r2"]),
        ("constant", &theirs["m3"]["baselines"]["constant_r2"]),
    ] {
        assert_eq!(&ours[key], expected, "{key}");
    }

    let compare = "benchmark encoders --benchmark small.json --metrics mine.json";
    here.prints(
        &format!("{compare} --page page.md --json means.json"),
        &["mine", "M4 R² over the constant"],
    );
    let means = here.json("means.json");
    assert_eq!(means["features"][0]["m1"]["mean"], ours["m1"]);
    let page = std::fs::read_to_string(here.file("page.md")).unwrap();
    assert!(page.contains("**mine**: Waves."), "{page}");

    let text = std::fs::read_to_string(here.file("mine.json")).unwrap();
    let wrong = text.replacen("\"m1\": 0", "\"m1\": 7", 1);
    std::fs::write(here.file("wrong.json"), wrong).unwrap();
    let compare_wrong = "benchmark encoders --benchmark small.json --metrics wrong.json";
    here.refuses(
        compare_wrong,
        &["wrong.json", "rooms.r.m1: must be from 0 to 1"],
    );
    here.refuses(
        &format!("{compare} --metrics mine.json"),
        &["'mine' is in two files"],
    );
    let m4 = format!("\"m4\": {}", ours["m4"]);
    assert!(text.contains(&m4), "{text}");
    std::fs::write(here.file("wrong.json"), text.replace(&m4, "\"m4\": 9.5")).unwrap();
    here.refuses(
        compare_wrong,
        &["rooms.r.m4: must be an R² from -1000000 to 1"],
    );
}

/// Oracle: every output is whole JSON, or the command is refused.
#[test]
fn outputs_do_not_mix() {
    let here = Place::new();
    here.succeeds(&Place::import("r", "synthetic"));
    let freeze = "benchmark freeze --store store --room r --stride 20 --name small --out";
    let written = here.succeeds(&format!("{freeze} -"));
    assert!(
        serde_json::from_str::<serde_json::Value>(&written).is_ok(),
        "{written}"
    );

    here.refuses(
        "card --store store --room r --features fourier --table both.md --json ./both.md",
        &["both.md: two outputs cannot have the same file"],
    );
    assert!(!here.file("both.md").exists());

    // Inputs, and files of the store, stay as they are.
    here.succeeds(&format!("{freeze} small.json"));
    let frozen = std::fs::read(here.file("small.json")).unwrap();
    here.refuses(
        "benchmark probe --benchmark small.json --store store --features fourier --about x --out ./small.json",
        &["small.json", "would replace this input"],
    );
    assert_eq!(std::fs::read(here.file("small.json")).unwrap(), frozen);
    here.refuses(
        "card --store store --room r --features fourier --json store/rooms/r/revisions/000001.json",
        &["is a file of a store"],
    );
}

/// Oracle: the rules of docs/benchmark.md: every committed submission is valid and on the page of
/// results, and the page of encoders is what the committed files give.
#[test]
fn the_benchmark_of_the_repository_is_whole() {
    let here = Place::new();
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/benchmark");
    std::os::unix::fs::symlink(&folder, here.file("docs")).unwrap();
    let files = |of: &str| -> Vec<String> {
        let entries = std::fs::read_dir(folder.join(of)).unwrap();
        let name = |entry: std::io::Result<std::fs::DirEntry>| {
            format!("docs/{of}/{}", entry.unwrap().file_name().to_str().unwrap())
        };
        let mut names: Vec<String> = entries.map(name).collect();
        names.sort();
        names
    };

    let results = std::fs::read_to_string(folder.join("results.md")).unwrap();
    for submission in files("submissions") {
        let check = "benchmark check --benchmark docs/visits-4719.json";
        here.prints(&format!("{check} --submission {submission}"), &["is valid"]);
        let name = here.json(&submission)["name"].as_str().unwrap().to_owned();
        assert!(results.contains(&format!("- **{name}**: ")), "{name}");
    }

    let metrics: Vec<String> = files("encoders")
        .iter()
        .map(|file| format!("--metrics {file}"))
        .collect();
    let compare = "benchmark encoders --benchmark docs/visits-4719.json --page page.md";
    here.succeeds(&format!("{compare} {}", metrics.join(" ")));
    let [page, committed] = [here.file("page.md"), folder.join("encoders.md")]
        .map(|file| std::fs::read_to_string(file).unwrap());
    assert_eq!(page, committed);
}

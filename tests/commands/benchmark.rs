//! Benchmarks: frozen, answered, checked and scored.

use crate::program::Place;

/// Oracle: two ways to one number: the submission of a stored adapter has the Hit@ε that `evaluate`
/// gives the same navigator in the same room. A changed submission is refused by its field.
#[test]
fn submissions_are_scored_as_evaluate_scores() {
    let here = Place::new();
    here.succeeds(&Place::import("r", "synthetic"));
    here.succeeds("train --store store --room r --epochs 2 --split whole --stride 20 --name base");
    let frozen = here.prints(
        "benchmark freeze --store store --room r --stride 20 --name small --out small.json",
        &["benchmark 'small': 1 rooms, 580 pairs"],
    );
    assert!(frozen.contains("SHA-256"), "{frozen}");

    let answer =
        "benchmark answer --benchmark small.json --store store --adapter base --name paper --about";
    here.succeeds(&format!("{answer} affine --out paper.json"));
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
        &["small.json", "submission"],
    );
    here.refuses(
        "benchmark score --benchmark small.json --store store --submission paper.json --submission paper.json",
        &["'paper' is in two submissions"],
    );
}

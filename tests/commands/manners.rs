//! What every command keeps to: JSON on standard output stands alone, `--quiet` is quiet, and files of
//! results are what their names say.

use crate::basics::imported;
use crate::program::{seese3, succeeds, text};

/// A store with a room and an adapter trained in it.
fn trained(store: &str) {
    imported(store);
    let training = ["--preset", "paper-base", "--stride", "20", "--epochs", "1"];
    succeeds(&[&["train", "--store", store, "--room", "r"], &training[..]].concat());
}

/// Oracle: a JSON parser, which takes nothing before or after the value.
#[test]
fn json_on_standard_output_stands_alone() {
    let folder = tempfile::tempdir().unwrap();
    let store = folder.path().join("store");
    let store = text(&store);
    trained(store);

    let exported = folder.path().join("exported");
    let cases: [&[&str]; 7] = [
        &["evaluate", "--store", store, "--room", "r"],
        &["store", "list", "--store", store],
        &["store", "verify", "--store", store],
        &["check", "room", "--store", store, "--room", "r"],
        &["fit", "--store", store, "--room", "r"],
        &["encoders"],
        &[
            "export",
            "kitti",
            "--store",
            store,
            "--room",
            "r",
            "--out",
            text(&exported),
        ],
    ];
    for case in cases {
        let printed = succeeds(&[case, &["--json", "-"]].concat());
        let value: Result<serde_json::Value, _> = serde_json::from_str(&printed);
        assert!(
            value.is_ok_and(|value| !value.is_null()),
            "{case:?}: {printed}"
        );

        // Alone, it means the same.
        let again = succeeds(&[case, &["--json"]].concat());
        assert!(
            serde_json::from_str::<serde_json::Value>(&again).is_ok(),
            "{case:?}: {again}"
        );
        assert_eq!(succeeds(&[&["--quiet"], case].concat()), "", "{case:?}");
    }
}

#[test]
fn output_that_cannot_be_written_is_an_error() {
    let program = || std::process::Command::new(env!("CARGO_BIN_EXE_seese3"));
    for arguments in [["encoders", "--json"], ["completions", "bash"]] {
        let full = std::fs::OpenOptions::new().write(true).open("/dev/full");
        let output = program()
            .args(arguments)
            .stdout(full.unwrap())
            .output()
            .unwrap();
        let error = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(1), "{error}");
        assert!(
            error.contains("standard output cannot be written"),
            "{error}"
        );
    }

    // A reader that has seen enough is no error.
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    let output = program()
        .args(["encoders", "--json"])
        .stdout(writer)
        .output();
    assert!(output.unwrap().status.success());
}

#[test]
fn tables_and_plots_are_what_their_names_say() {
    let folder = tempfile::tempdir().unwrap();
    let store = folder.path().join("store");
    let store = text(&store);
    trained(store);

    let evaluate = [
        "evaluate",
        "--store",
        store,
        "--room",
        "r",
        "--thresholds",
        "0.2,0.5",
    ];
    let file = |name: &str| folder.path().join(name);
    let (csv, tex, svg, json) = (file("t.csv"), file("t.tex"), file("p.svg"), file("t.json"));
    succeeds(
        &[
            &evaluate[..],
            &[
                "--table",
                text(&csv),
                "--plot",
                text(&svg),
                "--json",
                text(&json),
            ],
        ]
        .concat(),
    );
    succeeds(&[&evaluate[..], &["--table", text(&tex)]].concat());

    // Oracle: the JSON of the same evaluation.
    let record = seese3_testing::json(&json);
    let table = std::fs::read_to_string(csv).unwrap();
    let mut lines = table
        .lines()
        .map(|line| line.split(',').collect::<Vec<_>>());
    let head = lines.next().unwrap();
    let column = |name: &str| head.iter().position(|cell| *cell == name).unwrap();
    assert_eq!(
        head.iter().filter(|cell| cell.starts_with("hit@")).count(),
        6
    );
    for (line, row) in lines.zip(record["navigators"].as_array().unwrap()) {
        assert_eq!(line.len(), head.len());
        assert_eq!(line[0], row["name"].as_str().unwrap());
        let hit = line[column("hit@0.5")].parse::<f64>().unwrap();
        assert_eq!(hit, row["hit"]["0.5"]["rate"].as_f64().unwrap());
    }

    let latex = std::fs::read_to_string(tex).unwrap();
    let rows = latex.lines().filter(|line| line.ends_with("\\\\")).count();
    assert_eq!(rows, 1 + record["navigators"].as_array().unwrap().len());

    // A curve of 50 thresholds: points of the identity, which no suffix follows.
    let plot = std::fs::read_to_string(svg).unwrap();
    assert!(plot.starts_with("<svg") && plot.matches("<circle").count() > 50 * 5);
    assert!(plot.contains("identity") && !plot.contains("in-sample"));

    let other = seese3(&[&evaluate[..], &["--table", "table.xlsx"]].concat());
    assert_eq!(other.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&other.stderr).contains(".csv or .tex"));
}

#[test]
fn shells_and_man_know_the_program() {
    let script = succeeds(&["completions", "bash"]);
    assert!(
        script.contains("relocalize") && script.contains("complete -F"),
        "{script}"
    );

    let folder = tempfile::tempdir().unwrap();
    succeeds(&["man", "--out", text(folder.path())]);
    let page = std::fs::read_to_string(folder.path().join("seese3-evaluate-odometry.1")).unwrap();
    assert!(
        page.contains(".TH") && page.contains("hold\\-out"),
        "{page}"
    );
}

/// Exit codes as the program's help states them.
#[test]
fn exit_codes_are_those_of_the_help() {
    let help = succeeds(&["--help"]);
    assert!(help.contains("130  stopped by Ctrl-C"), "{help}");
    assert_eq!(
        seese3(&["evaluate", "--store", "nowhere", "--room", "r"])
            .status
            .code(),
        Some(1)
    );
    assert_eq!(
        seese3(&["evaluate", "--no-such-option"]).status.code(),
        Some(2)
    );
}

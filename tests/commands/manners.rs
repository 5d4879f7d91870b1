//! What every command keeps to: JSON on standard output stands alone, `--quiet` is quiet, and files
//! of results are what their names say.

use crate::basics::imported;
use crate::program::{Place, said};

/// A place with a room in its store, and an adapter trained in it.
fn trained() -> Place {
    let here = imported();
    let training = "--preset paper-base --stride 20 --epochs 1";
    here.succeeds(&format!("train --store store --room r {training}"));
    here
}

/// Oracle: a JSON parser, which takes nothing before or after the value.
#[test]
fn json_on_standard_output_stands_alone() {
    let here = trained();
    for case in [
        "evaluate --store store --room r",
        "store list --store store",
        "store verify --store store",
        "check --store store --room r",
        "fit --store store --room r",
        "encoders",
        "export kitti --store store --room r --out exported",
    ] {
        // Alone, the option means the same as with a dash.
        for json in ["--json -", "--json"] {
            let printed = here.succeeds(&format!("{case} {json}"));
            let value: Result<serde_json::Value, _> = serde_json::from_str(&printed);
            assert!(
                value.is_ok_and(|value| !value.is_null()),
                "{case}: {printed}"
            );
        }
        assert_eq!(here.succeeds(&format!("--quiet {case}")), "", "{case}");
    }
}

#[test]
fn output_that_cannot_be_written_is_an_error() {
    let here = Place::new();
    let written = |arguments: &str, to: std::process::Stdio| {
        here.program(arguments).stdout(to).output().unwrap()
    };
    for arguments in ["encoders --json", "completions bash"] {
        let full = std::fs::OpenOptions::new().write(true).open("/dev/full");
        let output = written(arguments, full.unwrap().into());
        let error = said(&output);
        assert_eq!(output.status.code(), Some(1), "{error}");
        assert!(
            error.contains("standard output cannot be written"),
            "{error}"
        );
    }

    // A reader that has seen enough is no error.
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    assert!(written("encoders --json", writer.into()).status.success());
}

#[test]
fn tables_and_plots_are_what_their_names_say() {
    let here = trained();
    let evaluate = "evaluate --store store --room r --thresholds 0.2,0.5";
    let read = |name: &str| std::fs::read_to_string(here.file(name)).unwrap();
    here.succeeds(&format!(
        "{evaluate} --table t.csv --plot p.svg --json t.json"
    ));
    here.succeeds(&format!("{evaluate} --table t.tex"));

    // Oracle: the JSON of the same evaluation.
    let record = here.json("t.json");
    let navigators = record["navigators"].as_array().unwrap();
    let table = read("t.csv");
    let mut lines = table
        .lines()
        .map(|line| line.split(',').collect::<Vec<_>>());
    let head = lines.next().unwrap();
    let column = |name: &str| head.iter().position(|cell| *cell == name).unwrap();
    let hits = head.iter().filter(|cell| cell.starts_with("hit@"));
    assert_eq!(hits.count(), 6);
    for (line, row) in lines.zip(navigators) {
        assert_eq!(line.len(), head.len());
        assert_eq!(line[0], row["name"].as_str().unwrap());
        let hit = line[column("hit@0.5")].parse::<f64>().unwrap();
        assert_eq!(hit, row["hit"]["0.5"]["rate"].as_f64().unwrap());
    }

    let latex = read("t.tex");
    let rows = latex.lines().filter(|line| line.ends_with("\\\\")).count();
    assert_eq!(rows, 1 + navigators.len());

    // A curve of 50 thresholds: points of the identity, which no suffix follows.
    let plot = read("p.svg");
    assert!(plot.starts_with("<svg") && plot.matches("<circle").count() > 50 * 5);
    assert!(plot.contains("identity") && !plot.contains("in-sample"));

    here.succeeds(&format!("{evaluate} --plot p.pdf"));
    let bytes = std::fs::read(here.file("p.pdf")).unwrap();
    assert!(bytes.starts_with(b"%PDF-1."));
    here.succeeds("theory --poses 400 --samples 16 --plot p.png");
    assert_eq!(
        image::guess_format(&std::fs::read(here.file("p.png")).unwrap()).unwrap(),
        image::ImageFormat::Png
    );
    let other = here.run("theory --plot p.gif");
    assert!(said(&other).contains(".svg or .pdf or .png"));

    let other = here.run(&format!("{evaluate} --table table.xlsx"));
    assert_eq!(other.status.code(), Some(2));
    assert!(said(&other).contains(".csv or .tex or .md"));
}

#[test]
fn shells_and_man_know_the_program() {
    let here = Place::new();
    here.prints("completions bash", &["relocalize", "complete -F"]);

    here.succeeds("man --out .");
    let page = std::fs::read_to_string(here.file("seese3-evaluate-odometry.1")).unwrap();
    assert!(
        page.contains(".TH") && page.contains("hold\\-out"),
        "{page}"
    );
}

/// Exit codes as the program's help states them.
#[test]
fn exit_codes_are_those_of_the_help() {
    let here = Place::new();
    here.prints("--help", &["130  stopped by Ctrl-C"]);
    let code = |arguments: &str| here.run(arguments).status.code();
    assert_eq!(code("evaluate --store nowhere --room r"), Some(1));
    assert_eq!(code("evaluate --no-such-option"), Some(2));
}

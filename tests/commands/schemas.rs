//! The JSON of the commands against `docs/json-schemas.json`.

use boon::{Compiler, Schemas};
use serde_json::{Value, json};

use crate::program::Place;

/// Where the schemas are for the validator. It is not opened.
const URL: &str = "http://localhost/json-schemas.json";

/// Checks the JSON that a command wrote. Commands that ask a server for an answer write the
/// message of the protocol, which `buf` checks; those of research promise nothing but `made_by`.
#[track_caller]
pub fn check(arguments: &str, written: &Value) {
    let words: Vec<&str> = arguments.split_whitespace().collect();
    let schemas = closed_schemas();
    let commands = &schemas["$defs"]["commands"];
    let names = [words[..words.len().min(2)].join(" "), words[0].to_owned()];
    let place = match names.iter().find(|name| commands.get(name).is_some()) {
        Some(name) => format!("commands/{}", name.replace(' ', "%20")),
        None => {
            assert!(
                OTHERS.contains(&words[0]),
                "{arguments}: no schema in docs/json-schemas.json"
            );
            return check_against("made_by", schemas, arguments, &written["made_by"]);
        }
    };
    check_against(&place, schemas, arguments, written);
}

/// Checks JSON against the schema at a place below `$defs`.
#[track_caller]
fn check_against(place: &str, schemas: Value, arguments: &str, written: &Value) {
    let mut compiler = Compiler::new();
    compiler.add_resource(URL, schemas).unwrap();
    let mut compiled = Schemas::new();
    let place = format!("{URL}#/$defs/{place}");
    let schema = compiler.compile(&place, &mut compiled).unwrap();
    if let Err(error) = compiled.validate(written, schema) {
        panic!("{arguments}: {error}");
    }
}

/// The commands without a schema.
const OTHERS: [&str; 17] = [
    "benchmark",
    "card",
    "catalog",
    "cross-room",
    "demo",
    "evaluate",
    "fit-tracking",
    "localize",
    "motion",
    "navigate",
    "plan",
    "probe",
    "relocalize",
    "reproduce",
    "studio",
    "sweep",
    "theory",
];

/// The documented schemas, without room for other keys: a new key has to be documented.
fn closed_schemas() -> Value {
    let file = concat!(env!("CARGO_MANIFEST_DIR"), "/docs/json-schemas.json");
    let mut schemas = seese3_testing::json(file.as_ref());
    close(&mut schemas["$defs"]);
    schemas
}

fn close(schema: &mut Value) {
    match schema {
        Value::Object(entries) => {
            entries.values_mut().for_each(close);
            if entries.get("properties").is_some_and(Value::is_object) {
                entries.insert("additionalProperties".to_owned(), json!(false));
            }
        }
        Value::Array(items) => items.iter_mut().for_each(close),
        _ => (),
    }
}

/// Oracle: the documented schemas.
#[test]
fn commands_write_the_documented_json() {
    let here = Place::new();
    let writes = |arguments: &str| here.succeeds(&format!("{arguments} --json written.json"));

    writes("encoders");
    here.succeeds("studio --store store --rooms 1 --frames 24 --seed 3 --keep-images");
    writes("check --store store --room studio3-0000");
    writes("encode --store store --room studio3-0000 --encoder pixels");
    writes("encode --store store --room studio3-* --encoder pixels --prefix again");
    writes(&Place::import("r", "synthetic"));
    writes("train --store store --room r --epochs 2 --name base");
    writes("train --store store --room r --epochs 1 --seeds 2");
    writes("fit --store store --room r");

    std::fs::write(
        here.file("moved.txt"),
        "0 -2 0 1\n2 0 0 2\n0 0 2 3\n0 0 0 1\n",
    )
    .unwrap();
    writes("map crop --store store --room r --rows 0..60 --name c");
    writes("map transform --store store --room c --matrix moved.txt --name m");
    writes("map merge --store store --room c --add m --name both");
    writes("export numpy --store store --room c --out o");
    writes("import bundle o --store store --name again");

    writes("store list --store store");
    writes("store show --store store rooms/r");
    writes("store default --store store rooms/r adapters/base");
    writes("store rm --store store rooms/both");
    writes("store gc --store store --dry-run");
    writes("store verify --store store");

    let server = here.serve("--writable");
    let to = format!("--server {}", server.address);
    writes(&format!("health {to}"));
    writes(&format!(
        "push rooms/c --as there --store store {to} --dry-run"
    ));
    writes(&format!("push rooms/c --as there --store store {to} --fit"));
    writes(&format!("pull adapters/base --store copy {to}"));
}

/// Oracle: by hand: a key that no schema has, a missing key and another type are seen.
#[test]
fn wrong_json_is_seen() {
    let made_by = json!({
        "version": "0.1.0", "commit": null, "command": "seese3 health", "seed": null,
        "time": "2026-11-28T07:15:35Z",
        "machine": {"os": "linux", "arch": "x86_64", "cpu": null, "cores": 2},
        "runtime": {"seconds": 0.1, "encoder": null},
    });
    let is_right = |written: Value| std::panic::catch_unwind(|| check("health", &written)).is_ok();
    assert!(is_right(json!({"serving": true, "made_by": made_by})));
    assert!(!is_right(json!({"serving": true})));
    assert!(!is_right(
        json!({"serving": true, "made_by": {"version": "0.1.0"}})
    ));
    assert!(!is_right(
        json!({"serving": true, "made_by": made_by, "extra": 1})
    ));
    assert!(!is_right(json!({"made_by": made_by})));
    assert!(!is_right(json!({"serving": 1, "made_by": made_by})));
}

//! The program as a user runs it: what it prints, what it writes, and how it says no.

use std::process::Command;

use seese3_testing::{features, golden, near, number};

use crate::program::Place;

/// A place with the oracle's room `r` in its store.
pub fn imported() -> Place {
    let here = Place::new();
    let import = Place::import("r", "synthetic");
    here.prints(&import, &["600 frames", "published revision 1"]);
    here.prints(&import, &["already there, unchanged: revision 1"]);
    here
}

/// Oracle: the keys that scripts rely on, and the definition of each that has one.
#[test]
fn import_train_and_evaluate_write_what_scripts_read() {
    let here = imported();

    let train = "train --store store --room r --features fourier --preset paper-base";
    let more = "--stride 20 --epochs 30 --seeds 2 --json t.json";
    let published = "published adapter 'r.fourier.paper-base.s20.time' revision 1";
    here.prints(&format!("{train} {more}"), &[published]);

    let trained = here.json("t.json");
    let runs = trained["runs"].as_array().unwrap();
    assert_eq!(runs.len(), 2);

    for (seed, run) in runs.iter().enumerate() {
        assert_eq!(run["seed"], seed);
        assert_eq!(run["test"]["n"], 100);

        let [test, train] = ["test", "train"].map(|pairs| &run[pairs]["r2"]);
        let keys = [
            "overall",
            "translation",
            "rotation",
            "direction",
            "magnitude",
        ];
        for key in keys {
            assert!(test[key].is_number() && train[key].is_number(), "{key}");
        }

        let parts = number(&test["translation"]) + number(&test["rotation"]);
        near("overall", number(&test["overall"]), parts / 2.0, 1e-12);
        assert!(run["train_mean_r2"].is_number() && run["seconds"].is_number());
    }

    let evaluate = "evaluate --store store --room r --json e.json";
    here.prints(evaluate, &["inverse-poincare-affine"]);

    let table = here.json("e.json");
    let navigators = table["navigators"].as_array().unwrap();
    let names = navigators.iter().map(|row| row["name"].as_str().unwrap());
    let names: Vec<&str> = names.collect();

    for name in [
        "identity",
        "random",
        "oracle",
        "inverse-poincare-affine",
        "inverse-poincare-homogeneous",
        "inverse-poincare-literal",
        "ridge-refit",
    ] {
        assert!(names.contains(&name), "{names:?}");
    }

    for row in navigators {
        assert_eq!(row["n"], 100);
        assert!(
            row["latent_mse"].is_number()
                && row["latent_r2"].is_number()
                && row["top1"].is_number()
        );

        for epsilon in ["0.1", "0.2", "0.3", "0.5"] {
            let hit = |key: &str| number(&row["hit"][epsilon][key]);
            assert!(hit("low") <= hit("rate") && hit("rate") <= hit("high"));
        }
    }

    assert_eq!(
        (&table["protocol"]["split"], &table["protocol"]["stride"]),
        (&"time".into(), &20.into())
    );
}

/// Oracle: the definition of deterministic by seed.
#[test]
fn a_seed_gives_the_same_adapter_again() {
    let here = imported();

    let train = "train --store store --room r --preset paper-range --epochs 1";
    here.prints(&format!("{train} --seed 5"), &["published adapter"]);

    // The same bits make no revision.
    here.prints(&format!("{train} --seed 5"), &["already there, unchanged"]);
    here.prints(&format!("{train} --seed 6"), &["revision 2"]);
}

/// Oracle: by hand, a fifth of 600 frames has four pairs of frames that are 116 apart.
#[test]
fn too_few_test_pairs_are_said_to_be() {
    let here = imported();

    let train = "train --store store --room r --epochs 1 --stride 116";
    here.prints(train, &["4 test pairs are too few"]);
}

/// Oracle: a frame is its own place, and standing still is no motion; SIGTERM ends the server with
/// success.
#[test]
fn a_served_room_is_asked_and_the_server_stops_when_told() {
    let here = imported();

    here.succeeds("train --store store --room r --epochs 5");
    let mut server = here.serve("--log-format json");
    let to = format!("--server {}", server.address);
    here.prints(
        &format!("catalog {to}"),
        &["room 'r' revision 1: 600 frames"],
    );

    let health = format!("health {to} rooms");
    assert_eq!(here.succeeds(&format!("{health}/r")), "serving\n");
    here.refuses(&format!("{health}/x"), &["NOT_FOUND"]);

    let still = "navigate --room r --from 7 --twist 0,0,0,0,0,0 --steps 2";
    here.prints(
        &format!("{still} {to}"),
        &["step 2  frame     7  distance 0.0000"],
    );

    let feature = "--feature-file golden/rooms/synthetic/features.npy";
    let place = format!("localize --room r {feature} --row 11 --top-k 1 {to}");
    here.prints(&place, &["frame    11  distance 0.0000"]);

    // Oracle: the definition: a route that is found ends within 0.25 m of the goal.
    let plan = format!("plan --room r --from 7 --json - {to}");
    let route: serde_json::Value =
        serde_json::from_str(&here.succeeds(&format!("{plan} --to 43"))).unwrap();
    assert_eq!(route["outcome"], "ROUTE_OUTCOME_FOUND");
    let last = route["hops"].as_array().unwrap().last().unwrap();
    assert!(
        last["distance_remaining_m"].as_f64().unwrap() <= 0.25,
        "{last}"
    );
    let unmapped = format!("plan --room r --from 7 --to-pose 90,0,0,0,0,0,1 {to}");
    here.prints(&unmapped, &["goal-not-mapped"]);
    here.refuses(
        &format!("plan --room r --from 7 --to-pose 1,2 {to}"),
        &["seven numbers"],
    );

    // The same two views, as rows of the file and as frames of the room that was made of it.
    let of_rows = format!("motion {feature} --rows 3,43");
    let of_frames = "motion --room r --from 3 --to 43";
    let motion = |arguments: &str| {
        let printed = here.succeeds(&format!("{arguments} {to}"));
        let line = printed.lines().find(|line| line.contains("motion v ("));
        line.unwrap().to_owned()
    };
    assert_eq!(motion(&of_rows), motion(of_frames));

    let elsewhere = format!("navigate --room x --from 7 --to 9 {to}");
    here.refuses(&elsewhere, &["NOT_FOUND", "room"]);

    let again = format!("serve --store store --listen {}", server.address);
    here.refuses(&again, &["cannot listen on", &server.address]);

    let process = server.process.id().to_string();
    let terminated = Command::new("kill").args(["-TERM", &process]).status();
    assert!(terminated.unwrap().success());
    assert!(
        server.process.wait().unwrap().success(),
        "SIGTERM is no failure"
    );
}

/// Oracle: a list of bad input; each gets one line that names what to change, and leaves
/// no room behind.
#[test]
fn bad_input_gets_one_line() {
    let here = Place::new();
    let mut rows = features(&golden(), "synthetic");
    rows[(4, 2)] = f32::NAN;
    ndarray_npy::write_npy(here.file("nan.npy"), &rows).unwrap();

    for (room, features, words) in [
        (
            "r",
            "f=golden/rooms/synthetic_b/features.npy",
            &["400 rows", "600"][..],
        ),
        ("r", "f=nan.npy", &["row 4, column 2", "NaN"]),
        ("r", "f=/no/such/file.npy", &["/no/such/file.npy"]),
        ("r", "noequals", &["NAME=FILE"]),
        ("../r", "f=golden/rooms/synthetic/features.npy", &["../r"]),
    ] {
        let poses = "--poses golden/rooms/synthetic/poses.npy";
        let import = format!("import numpy --name {room} {poses} --features {features}");
        here.refuses(&format!("{import} --store store"), words);
    }

    let is_there = here.file("store").exists();
    assert!(!is_there, "a refused import leaves no store behind");

    let train = "train --store store --room r";
    let evaluate = "evaluate --store store --room r";
    here.refuses(train, &["does not exist", "import"]);
    let here = imported();

    here.refuses("train --store store --room x", &["room 'x'", "it has r"]);
    here.refuses_each(
        train,
        &[
            ("--features x", &["features 'x'", "fourier"]),
            ("--stride 0", &["stride"]),
            ("--stride 5000", &["stride 5000"]),
            ("--epochs 0", &["epochs"]),
            ("--seeds 0", &["--seeds"]),
        ],
    );

    here.refuses(evaluate, &["no adapter serves room 'r'", "seese3 train"]);
    here.refuses(
        "evaluate --store store --room NOPE",
        &["room 'NOPE'", "it has r"],
    );
    here.succeeds(&format!("{train} --epochs 1"));
    here.refuses(&format!("{evaluate} --thresholds 0.1,0"), &["threshold 0"]);
    here.refuses(&format!("{evaluate} --split pairs"), &["this split"]);

    let navigate = "navigate --room r --from 1";
    let nobody = format!("{navigate} --server 127.0.0.1:1 --to 2");
    here.refuses(&nobody, &["cannot connect"]);
    here.refuses(&format!("{navigate} --twist 1,2"), &["six numbers"]);
}

/// Oracle: the contract: nothing is uploaded before the feature set to fit is known.
#[test]
fn a_pushed_room_is_fitted_with_the_named_feature_set() {
    let here = Place::new();
    here.succeeds(
        "import numpy --name kept --poses golden/rooms/synthetic_b/poses.npy --store store",
    );
    let both = Place::import("r", "synthetic").replace("--store store", "--store source");
    let second = "--features second=golden/rooms/synthetic/features.npy";
    here.succeeds(&format!("{both} {second}"));

    let server = here.serve("--writable");
    let push = format!(
        "push rooms/r --store source --server {} --fit",
        server.address
    );
    here.refuses(&push, &["--features: one of fourier, second"]);
    here.refuses(
        &format!("{push} --features third"),
        &["one of fourier, second"],
    );
    here.refuses(
        &format!("localize --room r --frame 0 --server {}", server.address),
        &["'r' is not served"],
    );
    here.prints(
        &format!("{push} --features second --json pushed.json"),
        &["adapters/r.second.fitted/revisions/1"],
    );
    let fitted = &here.json("pushed.json")["fitted_adapter"];
    assert_eq!(fitted["name"], "r.second.fitted");
}

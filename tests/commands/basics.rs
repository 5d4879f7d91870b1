//! The program as a user runs it: what it prints, what it writes, and how it says no.

use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};

use crate::program::{refuses, seese3, succeeds, text};
use seese3_testing::golden;

/// Imports the oracle's room, and trains on it for a moment.
pub fn imported(store: &str) {
    let poses = golden().join("rooms/synthetic/poses.npy");

    let features = format!(
        "fourier={}",
        text(&golden().join("rooms/synthetic/features.npy"))
    );

    let import = [
        "import",
        "numpy",
        "--room",
        "r",
        "--poses",
        text(&poses),
        "--features",
        &features,
        "--store",
        store,
    ];

    let printed = succeeds(&import);
    assert!(
        printed.contains("600 frames") && printed.contains("published revision 1"),
        "{printed}"
    );

    let again = succeeds(&import);
    assert!(
        again.contains("already there, unchanged: revision 1"),
        "{again}"
    );
}

/// Oracle: the keys that scripts rely on, and the definition of each that has one.
#[test]
fn import_train_and_evaluate_write_what_scripts_read() {
    let folder = tempfile::tempdir().unwrap();
    let store = folder.path().join("store");
    let store = text(&store);
    imported(store);

    let train_json = folder.path().join("t.json");
    let table_json = folder.path().join("e.json");

    let train = [
        "train",
        "--store",
        store,
        "--room",
        "r",
        "--features",
        "fourier",
        "--preset",
        "paper-base",
    ];

    let more = [
        "--stride",
        "20",
        "--epochs",
        "30",
        "--seeds",
        "2",
        "--json",
        text(&train_json),
    ];

    let printed = succeeds(&[&train[..], &more].concat());
    assert!(
        printed.contains("published adapter 'r.fourier.paper-base.s20.time' revision 1"),
        "{printed}"
    );

    let runs = seese3_testing::json(&train_json);
    assert_eq!(runs["runs"].as_array().unwrap().len(), 2);

    for (seed, run) in runs["runs"].as_array().unwrap().iter().enumerate() {
        assert_eq!(run["seed"], seed);
        assert_eq!(run["test"]["n"], 100);

        for key in [
            "overall",
            "translation",
            "rotation",
            "direction",
            "magnitude",
        ] {
            assert!(
                run["test"]["r2"][key].is_number() && run["train"]["r2"][key].is_number(),
                "{key}"
            );
        }

        let parts = seese3_testing::number(&run["test"]["r2"]["translation"])
            + seese3_testing::number(&run["test"]["r2"]["rotation"]);

        seese3_testing::near(
            "overall",
            seese3_testing::number(&run["test"]["r2"]["overall"]),
            parts / 2.0,
            1e-12,
        );

        assert!(run["train_mean_r2"].is_number() && run["seconds"].is_number());
    }

    let printed = succeeds(&[
        "evaluate",
        "--store",
        store,
        "--room",
        "r",
        "--json",
        text(&table_json),
    ]);

    assert!(printed.contains("inverse-poincare-affine"), "{printed}");

    let table = seese3_testing::json(&table_json);
    let names: Vec<&str> = table["navigators"]
        .as_array()
        .unwrap()
        .iter()
        .map(|row| row["name"].as_str().unwrap())
        .collect();

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

    for row in table["navigators"].as_array().unwrap() {
        assert_eq!(row["n"], 100);
        assert!(row["mse"].is_number() && row["r2"].is_number() && row["top1"].is_number());

        for epsilon in ["0.1", "0.2", "0.3", "0.5"] {
            let hit = |key: &str| seese3_testing::number(&row["hit"][epsilon][key]);
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
    let folder = tempfile::tempdir().unwrap();
    let store = folder.path().join("store");
    let store = text(&store);
    imported(store);

    let train = [
        "train",
        "--store",
        store,
        "--room",
        "r",
        "--preset",
        "paper-range",
        "--epochs",
        "1",
        "--seed",
        "5",
    ];

    assert!(succeeds(&train).contains("published adapter"));

    assert!(
        succeeds(&train).contains("already there, unchanged"),
        "the same bits make no revision"
    );

    let other = [
        "train",
        "--store",
        store,
        "--room",
        "r",
        "--preset",
        "paper-range",
        "--epochs",
        "1",
        "--seed",
        "6",
    ];

    assert!(succeeds(&other).contains("revision 2"));
}

/// A server process; killed when the test is over.
struct Server(Child, String);

impl Server {
    fn start(store: &str) -> Self {
        let mut child = Command::new(env!("CARGO_BIN_EXE_seese3"))
            .args([
                "serve",
                "--store",
                store,
                "--listen",
                "127.0.0.1:0",
                "--log-format",
                "json",
            ])
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();

        let mut line = String::new();
        BufReader::new(child.stdout.as_mut().unwrap())
            .read_line(&mut line)
            .unwrap();

        let address = line
            .trim()
            .strip_prefix("listening on ")
            .unwrap()
            .to_owned();

        Self(child, address)
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Oracle: by hand, a fifth of 600 frames has four pairs of frames that are 116 apart.
#[test]
fn too_few_test_pairs_are_said_to_be() {
    let folder = tempfile::tempdir().unwrap();
    let store = folder.path().join("store");
    let store = text(&store);
    imported(store);

    let train = ["train", "--store", store, "--room", "r", "--epochs", "1"];
    let printed = succeeds(&[&train[..], &["--stride", "116"]].concat());
    assert!(printed.contains("4 test pairs are too few"), "{printed}");
}

/// Oracle: a frame is its own place, and standing still is no motion; SIGTERM ends the server with
/// success.
#[test]
fn a_served_room_is_asked_and_the_server_stops_when_told() {
    let folder = tempfile::tempdir().unwrap();
    let store = folder.path().join("store");
    let store = text(&store);
    imported(store);

    succeeds(&["train", "--store", store, "--room", "r", "--epochs", "5"]);
    let mut server = Server::start(store);
    let address = server.1.clone();
    let to = ["--server", address.as_str()];
    let mut catalog = seese3(&[&["catalog"][..], &to].concat());

    for _ in 0..100 {
        if catalog.status.success() {
            break;
        }

        std::thread::sleep(std::time::Duration::from_millis(50));
        catalog = seese3(&[&["catalog"][..], &to].concat());
    }

    assert!(String::from_utf8_lossy(&catalog.stdout).contains("room 'r' revision 1: 600 frames"));

    assert_eq!(
        succeeds(&[&["health", "--name", "rooms/r"][..], &to].concat()),
        "serving\n"
    );

    refuses(
        &[&["health", "--name", "rooms/x"][..], &to].concat(),
        &["NotFound"],
    );

    let still = [
        "navigate",
        "--room",
        "r",
        "--from",
        "7",
        "--twist",
        "0,0,0,0,0,0",
        "--steps",
        "2",
    ];

    let printed = succeeds(&[&still[..], &to].concat());
    assert!(
        printed.contains("step 2  frame     7  distance 0.0000"),
        "{printed}"
    );

    let features = golden().join("rooms/synthetic/features.npy");
    let place = [
        "localize",
        "--room",
        "r",
        "--feature",
        text(&features),
        "--row",
        "11",
        "--top-k",
        "1",
    ];

    let printed = succeeds(&[&place[..], &to].concat());
    assert!(
        printed.contains("frame    11  distance 0.0000"),
        "{printed}"
    );

    // The same two views, as rows of the file and as frames of the room that was made of it.
    let of_rows = ["motion", "--feature", text(&features), "--rows", "3,43"];
    let of_frames = ["motion", "--room", "r", "--from", "3", "--to", "43"];
    let motion = |arguments: &[&str]| {
        let printed = succeeds(&[arguments, &to].concat());
        let line = printed.lines().find(|line| line.contains("motion v ("));
        line.unwrap().to_owned()
    };
    assert_eq!(motion(&of_rows), motion(&of_frames));

    refuses(
        &[
            &["navigate", "--room", "x", "--from", "7", "--to", "9"][..],
            &to,
        ]
        .concat(),
        &["NotFound", "room"],
    );

    refuses(
        &["serve", "--store", store, "--listen", &address],
        &["cannot listen on", &address],
    );

    let terminated = Command::new("kill")
        .args(["-TERM", &server.0.id().to_string()])
        .status()
        .unwrap();

    assert!(terminated.success());
    assert!(server.0.wait().unwrap().success(), "SIGTERM is no failure");
}

/// Oracle: a list of bad input; each gets one line that names what to change, and leaves
/// no room behind.
#[test]
fn bad_input_gets_one_line() {
    let folder = tempfile::tempdir().unwrap();
    let store_path = folder.path().join("store");
    let store = text(&store_path);
    let poses = golden().join("rooms/synthetic/poses.npy");

    let other = format!(
        "f={}",
        text(&golden().join("rooms/synthetic_b/features.npy"))
    );

    let good = format!("f={}", text(&golden().join("rooms/synthetic/features.npy")));
    let nan = folder.path().join("nan.npy");
    let mut rows = seese3_testing::features(&golden(), "synthetic");
    rows[(4, 2)] = f32::NAN;

    ndarray_npy::write_npy(&nan, &rows).unwrap();
    let nan = format!("f={}", text(&nan));

    let import = |features: &str, room: &str| {
        [
            "import",
            "numpy",
            "--room",
            room,
            "--poses",
            text(&poses),
            "--features",
            features,
            "--store",
            store,
        ]
        .map(str::to_owned)
    };

    let refuse = |arguments: [String; 10], words: &[&str]| {
        refuses(
            &arguments.iter().map(String::as_str).collect::<Vec<_>>(),
            words,
        );
    };
    refuse(import(&other, "r"), &["400 rows", "600"]);

    refuse(import(&nan, "r"), &["row 4, column 2", "NaN"]);
    refuse(import("f=/no/such/file.npy", "r"), &["/no/such/file.npy"]);
    refuse(import("noequals", "r"), &["NAME=FILE"]);
    refuse(import(&good, "../r"), &["../r"]);

    assert!(
        !store_path.exists(),
        "a refused import leaves no store behind"
    );

    refuses(
        &["train", "--store", store, "--room", "r"],
        &["does not exist", "import"],
    );

    imported(store);

    refuses(
        &["train", "--store", store, "--room", "x"],
        &["room 'x'", "it has r"],
    );

    refuses(
        &["train", "--store", store, "--room", "r", "--features", "x"],
        &["features 'x'", "fourier"],
    );

    refuses(
        &["train", "--store", store, "--room", "r", "--stride", "0"],
        &["stride"],
    );

    refuses(
        &["train", "--store", store, "--room", "r", "--stride", "5000"],
        &["stride 5000"],
    );

    refuses(
        &["train", "--store", store, "--room", "r", "--epochs", "0"],
        &["epochs"],
    );

    refuses(
        &["train", "--store", store, "--room", "r", "--seeds", "0"],
        &["--seeds"],
    );

    refuses(
        &["evaluate", "--store", store, "--room", "r"],
        &["no adapter was trained on room 'r'"],
    );

    succeeds(&["train", "--store", store, "--room", "r", "--epochs", "1"]);

    refuses(
        &[
            "evaluate",
            "--store",
            store,
            "--room",
            "r",
            "--thresholds",
            "0.1,0",
        ],
        &["threshold 0"],
    );

    refuses(
        &[
            "evaluate", "--store", store, "--room", "r", "--split", "pairs",
        ],
        &["this split"],
    );

    refuses(
        &[
            "navigate",
            "--server",
            "127.0.0.1:1",
            "--room",
            "r",
            "--from",
            "1",
            "--to",
            "2",
        ],
        &["cannot connect"],
    );

    refuses(
        &["navigate", "--room", "r", "--from", "1", "--twist", "1,2"],
        &["six numbers"],
    );
}

//! Rooms and eyes from the command line: import, export, studio, encode, sweep.

use std::path::Path;

use crate::program::{Place, said};
use ndarray::{Array2, Array3};
use seese3_core::image::RgbImage;
use seese3_encoder::encode_png;
use seese3_testing::npy;

/// Oracle: what the oracle keeps and drops, counted; importing again changes nothing; refusing
/// leaves nothing behind.
#[test]
fn recordings_are_imported_once_and_given_back() {
    let here = Place::new();
    for (format, place, room, frames, dropped) in [
        ("tum", "tum", "tum", 6, 1),
        ("7scenes", "sevenscenes/chess", "chess", 8, 4),
        (
            "12scenes",
            "twelvescenes/apt1/kitchen",
            "apt1-kitchen",
            6,
            1,
        ),
        ("scannet", "scannet/scene0000_00", "scene0000_00", 6, 4),
        ("scannet", "scannet_sens/tiny.sens", "tiny", 6, 2),
        ("arkitscenes", "arkit/40000001", "40000001", 6, 3),
    ] {
        let import = format!("import {format} golden/datasets/{place} --store store");
        here.refuses(&format!("{import} --strict"), &["--strict"]);
        let published = here.file(&format!("store/rooms/{room}"));
        assert!(!published.exists(), "nothing is left of a refused import");

        let counted = format!("room '{room}': {frames} frames");
        let dropped = format!("dropped {dropped} frames in all");
        here.prints(&import, &[&counted, &dropped]);
        here.prints(&import, &["already there, unchanged: revision 1"]);
    }

    let tum = "import tum golden/datasets/tum --store store";
    here.refuses(&format!("{tum} --name chess"), &["--replace"]);

    here.succeeds("encode --store store --room tiny --encoder pixels");

    // An encoded room is the same room.
    let tiny = "import scannet golden/datasets/scannet_sens/tiny.sens --store store";
    here.prints(tiny, &["already there, unchanged: revision 2"]);

    let thinned = format!("{tum} --name thin --every 4 --license CC-BY");
    here.prints(
        &thinned,
        &["room 'thin': 2 frames with timestamps, every 4 of 6"],
    );

    here.succeeds("export numpy --store store --room thin --out out");

    let timestamps = npy::<i64>(&here.file("out/timestamps.npy"));
    assert_eq!(timestamps[1], 1_700_000_000_233_400_000);

    here.prints(
        "import bundle out --store store --name copy",
        &["room 'copy': 2 frames with timestamps"],
    );
    assert_eq!(here.json("out/bundle.json")["license"], "CC-BY");

    here.succeeds("export tum --store store --room tum --out tum.txt");

    let text = std::fs::read_to_string(here.file("tum.txt")).unwrap();
    let second = text.lines().nth(1).unwrap();
    assert!(
        second.starts_with("1700000000.100000000 0.5 -0.2 1 "),
        "{text}"
    );

    here.refuses(
        "export tum --store store --room chess --out tum.txt",
        &["--rate"],
    );

    here.succeeds("export kitti --store store --room chess --out tum.txt");

    let text = std::fs::read_to_string(here.file("tum.txt")).unwrap();
    assert_eq!(text.lines().count(), 8);

    here.refuses("import tum nowhere --store store", &["nowhere"]);

    std::fs::create_dir(here.file("short")).unwrap();
    for (from, to) in [
        ("golden/m1_mutual_knn/tiny_poses.npy", "short/poses.npy"),
        ("out/timestamps.npy", "short/timestamps.npy"),
    ] {
        std::fs::copy(here.file(from), here.file(to)).unwrap();
    }

    here.refuses(
        "import numpy short --store store --every 2",
        &["6 poses but 2 timestamps", "short"],
    );

    // Frames are appended to a room, once; and only to one that is there.
    std::fs::remove_file(here.file("short/timestamps.npy")).unwrap();
    std::fs::create_dir(here.file("more")).unwrap();
    std::fs::copy(here.file("out/poses.npy"), here.file("more/poses.npy")).unwrap();
    let extend = "import numpy more --store store --name short --extend";
    here.refuses(extend, &["short"]);
    here.succeeds("import numpy short --store store");
    here.refuses(
        "import numpy more --store store --name short",
        &["--replace", "--extend"],
    );
    here.prints(extend, &["published revision 2"]);
    here.prints(extend, &["already there, unchanged: revision 2"]);
    here.prints("store list --store store", &["8 frames"]);
}

fn features(here: &Place, store: &str, room: &str, name: &str) -> Array2<f32> {
    let to = format!("features-{store}-{name}");
    here.succeeds(&format!(
        "export numpy --store {store} --room {room} --out {to}"
    ));
    let rows = npy(&here.file(&format!("{to}/features_{name}.npy")));
    rows.into_dimensionality().unwrap()
}

/// Draws a room with its images.
fn draw(here: &Place, frames: usize) {
    let studio = "studio --store store --rooms 1 --seed 4 --keep-images";
    here.succeeds(&format!("{studio} --frames {frames}"));
}

/// Encodes the room that was drawn.
const ENCODE: &str = "encode --store store --room studio4-0000 --encoder pixels";

/// Oracle: PNG is lossless, so encoding the kept images gives the features that were encoded as
/// they were drawn; and a second run finds all of it there.
#[test]
fn a_suite_is_drawn_once_and_encodes_as_its_images_do() {
    let here = Place::new();

    let studio = "studio --store store --rooms 2 --frames 24 --seed 3 --keep-images";
    here.prints(studio, &["2 rooms drawn, 0 were there already"]);
    here.prints(studio, &["0 rooms drawn, 2 were there already"]);

    let streamed = features(&here, "store", "studio3-0001", "builtin");
    assert_eq!(streamed.dim(), (24, 528));

    let encode = "encode --store store --room studio3-0001 --encoder builtin --prefix kept";
    here.prints(encode, &["encoded 24 frames"]);
    assert_eq!(features(&here, "store", "studio3-0001", "kept"), streamed);
    here.prints(encode, &["already there"]);

    let pixels = "studio --store store --rooms 2 --frames 24 --seed 3 --encoder pixels";
    here.refuses(pixels, &["was kept at 64×48", "another store"]);

    here.succeeds("studio --store other --rooms 2 --frames 24 --seed 3 --threads 1");

    assert_eq!(
        features(&here, "other", "studio3-0001", "builtin"),
        streamed,
        "the same rooms on one thread"
    );

    here.refuses(
        "studio --store store --rooms 1 --frames 25 --seed 3",
        &["other frames"],
    );

    here.succeeds("studio --rooms 3 --frames 10 --sheet sheet.png");

    let picture = image::open(here.file("sheet.png")).unwrap();
    assert_eq!((picture.width(), picture.height()), (480, 120));
}

/// Oracle: the definition of shards, which divide the rooms; a room that fails is named, and the
/// others are encoded.
#[test]
fn shards_encode_all_rooms_and_a_failure_stops_only_its_room() {
    let here = Place::new();
    here.succeeds("studio --store store --rooms 3 --frames 24 --seed 3 --keep-images");
    let encode = "encode --store store --room studio3-* --encoder pixels";

    let beyond = here.run(&format!("{encode} --shard 3/2"));
    assert_eq!(beyond.status.code(), Some(2), "a wrong option");
    here.refuses(&format!("{encode} --images ."), &["--images", "3 rooms"]);
    here.prints(
        &format!("{encode} --shard 2/2"),
        &["1 rooms to encode here"],
    );
    let names = ["studio3-0000", "studio3-0001", "studio3-0002"];
    let stored = |name: &str| here.succeeds(&format!("store show --store store rooms/{name}"));
    assert_eq!(
        names.map(|name| stored(name).contains("pixels")),
        [false, true, false]
    );

    let bad = here.file("store/images/studio3-0000/frame-000003.png");
    std::fs::write(&bad, "no image").unwrap();
    let all = format!("{encode} --json encoded.json");
    here.refuses(&all, &["1 of 3 rooms failed"]);
    assert!(stored(names[2]).contains("pixels"));
    let written = here.json("encoded.json");
    assert_eq!(written["failed"][0]["room"], names[0]);
    let problem = written["failed"][0]["problem"].as_str().unwrap();
    assert!(problem.contains("frame-000003.png"), "{problem}");
    let counts: Vec<u64> = written["rooms"]
        .as_array()
        .unwrap()
        .iter()
        .map(|room| room["encoded_count"].as_u64().unwrap())
        .collect();
    assert_eq!(counts, [0, 24], "the other shard had encoded one of them");
}

/// Oracle: the promise of the help: a corrupt image is named and stops; it is skipped and counted
/// when asked; what was done before stays done.
#[test]
fn a_corrupt_image_is_named_or_left_out() {
    let here = Place::new();

    draw(&here, 40);
    let bad = here.file("store/images/studio4-0000/frame-000030.png");
    let whole = std::fs::read(&bad).unwrap();
    std::fs::write(&bad, &whole[..whole.len() / 2]).unwrap();

    here.refuses(ENCODE, &["frame-000030.png", "again to resume"]);
    let skipping = here.prints(
        &format!("{ENCODE} --skip-bad"),
        &["left out frame 30", "left out 1 frames in all"],
    );

    assert!(
        !skipping.contains(", 0 were done before"),
        "it went on: {skipping}"
    );

    assert_eq!(
        features(&here, "store", "studio4-0000", "pixels").nrows(),
        39
    );

    assert_eq!(
        features(&here, "store", "studio4-0000", "builtin").nrows(),
        39,
        "the room lost the frame with all its features"
    );

    let mut unfinished = std::fs::read_dir(here.file("store/unfinished")).unwrap();
    assert!(unfinished.next().is_none(), "no journal is left");

    std::fs::remove_dir_all(here.file("store/images")).unwrap();
    here.refuses(&format!("{ENCODE} --again"), &["--images DIR"]);

    here.refuses(
        &format!("{ENCODE} --resize 64x48"),
        &["'pixels' is a fixed encoder"],
    );

    let long = "x".repeat(101);
    here.refuses(&format!("{ENCODE} --prefix {long}"), &["--prefix PREFIX"]);
}

/// Oracle: what was encoded before an image was written anew is not taken for it.
#[test]
fn a_run_does_not_go_on_from_rows_of_other_images() {
    let here = Place::new();

    draw(&here, 40);

    let images = here.file("store/images/studio4-0000");
    let last = images.join("frame-000039.png");
    let whole = std::fs::read(&last).unwrap();
    std::fs::write(&last, &whole[..100]).unwrap();

    here.refuses(ENCODE, &["frame-000039.png"]);
    std::fs::write(&last, &whole).unwrap();

    let frame = |number: u32| images.join(format!("frame-{number:06}.png"));
    std::fs::copy(frame(20), frame(0)).unwrap();

    here.prints(ENCODE, &[", 0 were done before"]);

    let rows = features(&here, "store", "studio4-0000", "pixels");
    assert_eq!(rows.row(0), rows.row(20), "frame 0 was encoded anew");
}

/// Oracle: the keys that scripts read, and that every layer of the room is scored.
#[test]
fn layers_are_swept() {
    let here = Place::new();

    draw(&here, 120);
    here.succeeds(ENCODE);

    let sweep = "sweep layers --store store --room studio4-0000";
    let short = "--stride 10 --epochs 2 --seeds 2 --m1-frames 100 --json layers.json";
    here.prints(&format!("{sweep} {short}"), &["builtin", "pixels", "±"]);

    let layers = here.json("layers.json")["layers"].clone();
    assert_eq!(layers.as_array().unwrap().len(), 2);

    for layer in layers.as_array().unwrap() {
        for key in ["/m1/value", "/m2/twonn", "/m2/mle", "/m3/r2", "/m4/r2"] {
            assert!(layer.pointer(key).unwrap().is_number(), "{key} of {layer}");
        }
    }

    here.refuses("sweep layers --store store --room nowhere", &["nowhere"]);
    here.refuses_each(
        sweep,
        &[
            ("--room studio4-0000", &["given twice"]),
            ("--features dino", &["no such features", "builtin, pixels"]),
            ("--m1-frames 300", &["300 frames"]),
        ],
    );
}

/// Oracle: the promise of the manual: a lean build answers with the exact line to build it; recipes
/// are listed in both.
#[test]
fn models_need_a_build_that_can_run_them() {
    let here = Place::new();
    let models = [
        "dinov2-b", "dinov2-s", "dinov3-b", "clip-b16", "dust3r", "croco", "vjepa2.1", "pixels",
        "builtin",
    ];
    here.prints("encoders", &models);
    here.prints("encoders dinov2-b", &["torch.onnx.export"]);

    here.refuses("encoders nothing", &["dinov2-b"]);
    let room = "encode --store . --room r";
    let encode = format!("{room} --encoder golden/encoder/image.onnx");

    if cfg!(feature = "onnx") {
        here.refuses(&encode, &["--recipe NAME"]);

        here.refuses(
            &format!("{encode} --recipe resnet"),
            &["resnet", "dinov2-b"],
        );

        here.refuses(&format!("{room} --encoder nowhere.onnx"), &["nowhere.onnx"]);

        here.refuses(&format!("{encode} --divisor 255 --pool max"), &["max"]);
    } else {
        here.refuses(&encode, &["cargo install --path . --features full"]);
    }

    if !cfg!(feature = "onnxruntime") {
        here.refuses(
            &format!("{encode} --runtime onnxruntime"),
            &["--features full"],
        );
    }
}

/// A folder of one's own: images of a far wall of waves that a camera turns before, and poses that
/// say so, or their inverse.
fn looking_about(folder: &Path, is_inverted: bool) {
    std::fs::create_dir_all(folder.join("images")).unwrap();
    let mut poses = Array3::zeros((60, 4, 4));
    for row in 0..60 {
        let time = row as f64;
        let right = 0.3 * (time / 5.0).sin();
        let up = 0.2 * (time / 7.0).cos();
        let turn =
            nalgebra::UnitQuaternion::from_scaled_axis(nalgebra::Vector3::new(up, right, 0.0));

        // A wall far away: its directions in the world are all that counts.
        let mut bytes = Vec::new();
        for y in 0..96 {
            for x in 0..128 {
                let seen = nalgebra::Vector3::new(f64::from(x) - 63.5, f64::from(y) - 47.5, 100.0);
                let wall = turn * seen;
                let [x, y] = [wall.x / wall.z, wall.y / wall.z];
                let wave = (21.0 * x).sin() * (17.0 * y).cos() + (9.0 * x + 7.0 * y).sin();
                bytes.extend([(120.0 + 50.0 * wave) as u8; 3]);
            }
        }
        let picture = RgbImage {
            width: 128,
            height: 96,
            bytes,
        };
        let file = folder.join(format!("images/{row}.png"));
        std::fs::write(file, encode_png(&picture).unwrap()).unwrap();

        let stated = if is_inverted { turn.inverse() } else { turn };
        let matrix = stated.to_homogeneous();
        for (at, value) in poses
            .index_axis_mut(ndarray::Axis(0), row)
            .indexed_iter_mut()
        {
            *value = matrix[at];
        }
    }
    ndarray_npy::write_npy(folder.join("poses.npy"), &poses).unwrap();
}

/// Oracle: the poses by which the images were drawn, and their inverse.
#[test]
fn inverted_poses_are_named_at_import_and_by_check() {
    let here = Place::new();
    for (name, is_inverted) in [("right", false), ("wrong", true)] {
        looking_about(&here.file(name), is_inverted);
    }

    let import = |room: &str, more: &str| {
        let output = here.run(&format!(
            "import folder {room} --store store --replace {more}"
        ));
        assert!(output.status.success());
        said(&output)
    };
    let check = |room: &str| here.run(&format!("check --store store --room {room} --json"));

    // The camera is on a tripod, which is said, and nothing else.
    let is_clean = |warned: &str| {
        warned.starts_with("warning: all positions are the same") && warned.lines().count() == 1
    };
    assert!(is_clean(&import("right", "--strict")));
    assert!(check("right").status.success());

    let refused = || {
        let output = here.run("import folder wrong --store store");
        assert_eq!(output.status.code(), Some(1));
        said(&output)
    };
    let remedy = "nothing was published. Remedy: import again with: --poses camera_from_world";
    assert!(refused().contains(remedy), "{}", refused());
    assert!(!here.file("store/rooms/wrong").exists());

    let warned = import("wrong", "--allow-contradicted");
    assert!(warned.contains("contradict the poses"), "{warned}");
    assert!(warned.contains("--poses camera_from_world"), "{warned}");

    let checked = check("wrong");
    assert!(!checked.status.success());
    let said: serde_json::Value = serde_json::from_slice(&checked.stdout).unwrap();
    assert_eq!(said["images"]["verdict"], "other_convention");
    assert_eq!(said["images"]["sizes"][0]["count"], 60);

    // The room is there now: its correction replaces it.
    let again = refused();
    assert!(
        again.contains(remedy) && again.contains("add --replace"),
        "{again}"
    );

    // Read as the warning says, all is well.
    let read_right = import("wrong", "--poses camera_from_world");
    assert!(is_clean(&read_right));
    assert!(check("wrong").status.success());
}

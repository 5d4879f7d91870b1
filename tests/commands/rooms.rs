//! Rooms and eyes from the command line: import, export, studio, encode, sweep.

use std::path::Path;

use crate::program::{refuses, seese3, succeeds};
use ndarray::{Array2, Array3};
use seese3_core::image::RgbImage;
use seese3_encoder::encode_png;
use seese3_testing::{golden, json, npy};

fn path(folder: &Path, name: &str) -> String {
    folder.join(name).to_str().unwrap().to_owned()
}

/// Oracle: what the oracle keeps and drops, counted; importing again changes nothing; refusing
/// leaves nothing behind.
#[test]
fn recordings_are_imported_once_and_given_back() {
    let folder = tempfile::tempdir().unwrap();
    let store = path(folder.path(), "store");
    let datasets = golden().join("datasets");
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
        let place = path(&datasets, place);
        refuses(
            &["import", format, &place, "--store", &store, "--strict"],
            &["--strict"],
        );

        assert!(
            !Path::new(&store).join("rooms").join(room).exists(),
            "nothing is left of a refused import"
        );

        let said = succeeds(&["import", format, &place, "--store", &store]);
        assert!(
            said.contains(&format!("room '{room}': {frames} frames")),
            "{said}"
        );

        assert!(
            said.contains(&format!("dropped {dropped} frames in all")),
            "{said}"
        );

        let again = succeeds(&["import", format, &place, "--store", &store]);
        assert!(
            again.contains("already there, unchanged: revision 1"),
            "{again}"
        );
    }

    refuses(
        &[
            "import",
            "tum",
            &path(&datasets, "tum"),
            "--store",
            &store,
            "--name",
            "chess",
        ],
        &["--replace"],
    );

    succeeds(&[
        "encode", "--store", &store, "--room", "tiny", "--model", "pixels",
    ]);

    let tiny = path(&datasets, "scannet_sens/tiny.sens");
    let again = succeeds(&["import", "scannet", &tiny, "--store", &store]);
    assert!(
        again.contains("already there, unchanged: revision 2"),
        "an encoded room is the same room: {again}"
    );

    let thinned = succeeds(&[
        "import",
        "tum",
        &path(&datasets, "tum"),
        "--store",
        &store,
        "--name",
        "thin",
        "--every",
        "4",
        "--licence",
        "CC-BY",
    ]);

    assert!(
        thinned.contains("room 'thin': 2 frames with timestamps, every 4 of 6"),
        "{thinned}"
    );

    let out = path(folder.path(), "out");
    let trajectory = path(folder.path(), "tum.txt");
    succeeds(&[
        "export", "numpy", "--store", &store, "--room", "thin", "--out", &out,
    ]);

    assert_eq!(
        npy::<i64>(&Path::new(&out).join("timestamps.npy"))[1],
        1_700_000_000_233_400_000
    );

    let copied = succeeds(&[
        "import", "bundle", &out, "--store", &store, "--name", "copy",
    ]);

    assert!(
        copied.contains("room 'copy': 2 frames with timestamps"),
        "{copied}"
    );

    assert_eq!(
        json(&Path::new(&out).join("bundle.json"))["licence"],
        "CC-BY"
    );

    succeeds(&[
        "export",
        "tum",
        "--store",
        &store,
        "--room",
        "tum",
        "--out",
        &trajectory,
    ]);

    let text = std::fs::read_to_string(&trajectory).unwrap();
    assert!(
        text.lines()
            .nth(1)
            .unwrap()
            .starts_with("1700000000.100000000 0.5 -0.2 1 "),
        "{text}"
    );

    refuses(
        &[
            "export",
            "tum",
            "--store",
            &store,
            "--room",
            "chess",
            "--out",
            &trajectory,
        ],
        &["--rate"],
    );

    succeeds(&[
        "export",
        "kitti",
        "--store",
        &store,
        "--room",
        "chess",
        "--out",
        &trajectory,
    ]);

    assert_eq!(
        std::fs::read_to_string(&trajectory)
            .unwrap()
            .lines()
            .count(),
        8
    );

    refuses(
        &["import", "tum", "nowhere", "--store", &store],
        &["nowhere"],
    );

    let short = path(folder.path(), "short");
    std::fs::create_dir(&short).unwrap();

    for file in ["poses.npy", "timestamps.npy"] {
        let from = if file == "poses.npy" {
            golden().join("m1_mutual_knn/tiny_poses.npy")
        } else {
            Path::new(&out).join(file)
        };
        std::fs::copy(from, Path::new(&short).join(file)).unwrap();
    }

    refuses(
        &["import", "numpy", &short, "--store", &store, "--every", "2"],
        &["6 poses but 2 timestamps", "short"],
    );
}

fn features(store: &str, room: &str, name: &str) -> Array2<f32> {
    let out = tempfile::tempdir().unwrap();
    let to = path(out.path(), "out");
    succeeds(&[
        "export", "numpy", "--store", store, "--room", room, "--out", &to,
    ]);

    npy(&Path::new(&to).join(format!("features_{name}.npy")))
        .into_dimensionality()
        .unwrap()
}

/// Oracle: PNG is lossless, so encoding the kept images gives the features that were encoded as
/// they were drawn; and a second run finds all of it there.
#[test]
fn a_suite_is_drawn_once_and_encodes_as_its_images_do() {
    let folder = tempfile::tempdir().unwrap();
    let store = path(folder.path(), "store");

    let studio = [
        "studio",
        "--out",
        &store,
        "--rooms",
        "2",
        "--frames",
        "24",
        "--seed",
        "3",
        "--keep-images",
    ];

    assert!(succeeds(&studio).contains("2 rooms drawn, 0 were there already"));
    assert!(succeeds(&studio).contains("0 rooms drawn, 2 were there already"));

    let streamed = features(&store, "studio3-0001", "builtin");
    assert_eq!(streamed.dim(), (24, 528));

    let encode = [
        "encode",
        "--store",
        &store,
        "--room",
        "studio3-0001",
        "--model",
        "builtin",
        "--as",
        "kept",
    ];

    assert!(succeeds(&encode).contains("encoded 24 frames"));
    assert_eq!(features(&store, "studio3-0001", "kept"), streamed);
    assert!(succeeds(&encode).contains("already there"));

    let pixels = [
        "studio", "--out", &store, "--rooms", "2", "--frames", "24", "--seed", "3", "--encode",
        "pixels",
    ];
    refuses(&pixels, &["was kept at 64×48", "another store"]);

    let other = path(folder.path(), "other");
    succeeds(&[
        "studio",
        "--out",
        &other,
        "--rooms",
        "2",
        "--frames",
        "24",
        "--seed",
        "3",
        "--threads",
        "1",
    ]);

    assert_eq!(
        features(&other, "studio3-0001", "builtin"),
        streamed,
        "the same rooms on one thread"
    );

    refuses(
        &[
            "studio", "--out", &store, "--rooms", "1", "--frames", "25", "--seed", "3",
        ],
        &["other frames"],
    );

    let sheet = path(folder.path(), "sheet.png");
    succeeds(&[
        "studio", "--rooms", "3", "--frames", "10", "--sheet", &sheet,
    ]);

    let picture = image::open(&sheet).unwrap();
    assert_eq!((picture.width(), picture.height()), (480, 120));
}

/// Oracle: the promise of the help: a corrupt image is named and stops; it is skipped and counted
/// when asked; what was done before stays done.
#[test]
fn a_corrupt_image_is_named_or_left_out() {
    let folder = tempfile::tempdir().unwrap();
    let store = path(folder.path(), "store");

    let suite = [
        "studio",
        "--out",
        &store,
        "--rooms",
        "1",
        "--frames",
        "40",
        "--seed",
        "4",
        "--keep-images",
    ];

    succeeds(&suite);
    let bad = Path::new(&store).join("images/studio4-0000/frame-000030.png");
    let whole = std::fs::read(&bad).unwrap();
    std::fs::write(&bad, &whole[..whole.len() / 2]).unwrap();

    let encode = [
        "encode",
        "--store",
        &store,
        "--room",
        "studio4-0000",
        "--model",
        "pixels",
    ];

    refuses(&encode, &["frame-000030.png", "again to resume"]);
    let skipping = succeeds(&[&encode[..], &["--skip-bad"]].concat());
    assert!(
        skipping.contains("left out frame 30") && skipping.contains("left out 1 frames in all"),
        "{skipping}"
    );

    assert!(
        !skipping.contains(", 0 were done before"),
        "it went on: {skipping}"
    );

    assert_eq!(features(&store, "studio4-0000", "pixels").nrows(), 39);

    assert_eq!(
        features(&store, "studio4-0000", "builtin").nrows(),
        39,
        "the room lost the frame with all its features"
    );

    assert!(
        std::fs::read_dir(Path::new(&store).join("unfinished"))
            .unwrap()
            .next()
            .is_none(),
        "no journal is left"
    );

    std::fs::remove_dir_all(Path::new(&store).join("images")).unwrap();
    refuses(&[&encode[..], &["--again"]].concat(), &["--images DIR"]);

    refuses(
        &[&encode[..], &["--resize", "64x48"]].concat(),
        &["'pixels' is one fixed encoder"],
    );

    refuses(
        &[&encode[..], &["--as", &"x".repeat(101)]].concat(),
        &["--as PREFIX"],
    );
}

/// Oracle: what was encoded before an image was written anew is not taken for it.
#[test]
fn a_run_does_not_go_on_from_rows_of_other_images() {
    let folder = tempfile::tempdir().unwrap();
    let store = path(folder.path(), "store");

    succeeds(&[
        "studio",
        "--out",
        &store,
        "--rooms",
        "1",
        "--frames",
        "40",
        "--seed",
        "4",
        "--keep-images",
    ]);

    let images = Path::new(&store).join("images/studio4-0000");
    let last = images.join("frame-000039.png");
    let whole = std::fs::read(&last).unwrap();
    std::fs::write(&last, &whole[..100]).unwrap();

    let encode = [
        "encode",
        "--store",
        &store,
        "--room",
        "studio4-0000",
        "--model",
        "pixels",
    ];

    refuses(&encode, &["frame-000039.png"]);
    std::fs::write(&last, &whole).unwrap();

    std::fs::copy(
        images.join("frame-000020.png"),
        images.join("frame-000000.png"),
    )
    .unwrap();

    assert!(succeeds(&encode).contains(", 0 were done before"));

    let rows = features(&store, "studio4-0000", "pixels");
    assert_eq!(rows.row(0), rows.row(20), "frame 0 was encoded anew");
}

/// Oracle: the keys that scripts read, and that every layer of the room is scored.
#[test]
fn layers_are_swept() {
    let folder = tempfile::tempdir().unwrap();
    let store = path(folder.path(), "store");
    let file = path(folder.path(), "layers.json");

    succeeds(&[
        "studio",
        "--out",
        &store,
        "--rooms",
        "1",
        "--frames",
        "120",
        "--seed",
        "4",
        "--keep-images",
    ]);

    succeeds(&[
        "encode",
        "--store",
        &store,
        "--room",
        "studio4-0000",
        "--model",
        "pixels",
    ]);

    let sweep = [
        "sweep",
        "layers",
        "--store",
        &store,
        "--room",
        "studio4-0000",
        "--stride",
        "10",
        "--epochs",
        "2",
        "--seeds",
        "2",
        "--m1-frames",
        "100",
        "--json",
        &file,
    ];

    let said = succeeds(&sweep);
    assert!(
        said.contains("builtin") && said.contains("pixels") && said.contains('±'),
        "{said}"
    );

    let layers = json(Path::new(&file))["layers"].clone();
    assert_eq!(layers.as_array().unwrap().len(), 2);

    for layer in layers.as_array().unwrap() {
        for key in ["/m1/value", "/m2/twonn", "/m2/mle", "/m3/r2", "/m4/r2"] {
            assert!(layer.pointer(key).unwrap().is_number(), "{key} of {layer}");
        }
    }

    refuses(&[&sweep[..5], &["nowhere"]].concat(), &["nowhere"]);

    refuses(
        &[&sweep[..6], &["--room", "studio4-0000"]].concat(),
        &["given twice"],
    );

    refuses(
        &[&sweep[..6], &["--features", "dino"]].concat(),
        &["no such features", "builtin, pixels"],
    );

    refuses(
        &[&sweep[..6], &["--m1-frames", "300"]].concat(),
        &["300 frames"],
    );
}

/// Oracle: the promise of the manual: a lean build answers with the exact line to build it; recipes
/// are listed in both.
#[test]
fn models_need_a_build_that_can_run_them() {
    let said = succeeds(&["encoders"]);
    for word in [
        "dinov2-b", "dinov2-s", "dinov3-b", "clip-b16", "dust3r", "croco", "vjepa2.1", "pixels",
        "builtin",
    ] {
        assert!(said.contains(word), "{word}");
    }

    assert!(succeeds(&["encoders", "dinov2-b"]).contains("torch.onnx.export"));

    refuses(&["encoders", "nothing"], &["dinov2-b"]);
    let model = golden().join("encoder/image.onnx");

    let encode = [
        "encode",
        "--store",
        ".",
        "--room",
        "r",
        "--model",
        model.to_str().unwrap(),
    ];

    if cfg!(feature = "onnx") {
        refuses(&encode, &["--recipe NAME"]);

        refuses(
            &[&encode[..], &["--recipe", "resnet"]].concat(),
            &["resnet", "dinov2-b"],
        );

        refuses(
            &[&encode[..6], &["nowhere.onnx"]].concat(),
            &["nowhere.onnx"],
        );

        refuses(
            &[&encode[..], &["--divisor", "255", "--pool", "max"]].concat(),
            &["max"],
        );
    } else {
        refuses(&encode, &["cargo install --path . --features full"]);
    }

    if !cfg!(feature = "onnxruntime") {
        refuses(
            &[&encode[..], &["--runtime", "onnxruntime"]].concat(),
            &["--features full"],
        );
    }
}

/// A folder of one's own: images of a far wall of waves that a camera turns before, and poses that say
/// so, or their inverse.
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
    let folder = tempfile::tempdir().unwrap();
    let store = path(folder.path(), "store");
    for (name, is_inverted) in [("right", false), ("wrong", true)] {
        looking_about(&folder.path().join(name), is_inverted);
    }

    let import = |room: &str, more: &[&str]| {
        let place = path(folder.path(), room);
        let arguments = ["import", "folder", &place, "--store", &store, "--replace"];
        let output = seese3(&[&arguments, more].concat());
        assert!(output.status.success());
        String::from_utf8(output.stderr).unwrap()
    };
    let check =
        |room: &str| seese3(&["check", "room", "--store", &store, "--room", room, "--json"]);

    // The camera is on a tripod, which is said, and nothing else.
    let is_clean = |warned: &str| {
        warned.starts_with("warning: all positions are identical") && warned.lines().count() == 1
    };
    assert!(is_clean(&import("right", &["--strict"])));
    assert!(check("right").status.success());

    let wrong = path(folder.path(), "wrong");
    let strict = ["import", "folder", &wrong, "--store", &store, "--strict"];
    let refused = seese3(&strict);
    assert_eq!(refused.status.code(), Some(1));
    let refused = String::from_utf8(refused.stderr).unwrap();
    assert!(refused.contains("nothing was published"), "{refused}");
    assert!(!Path::new(&store).join("rooms/wrong").exists());

    let warned = import("wrong", &[]);
    assert!(warned.contains("contradict the poses"), "{warned}");
    assert!(warned.contains("--poses camera_from_world"), "{warned}");

    let checked = check("wrong");
    assert!(!checked.status.success());
    let said: serde_json::Value = serde_json::from_slice(&checked.stdout).unwrap();
    assert_eq!(said["images"]["verdict"], "other_convention");
    assert_eq!(said["images"]["sizes"][0]["count"], 60);

    // Read as the warning says, all is well.
    assert!(is_clean(&import(
        "wrong",
        &["--poses", "camera_from_world"]
    )));
    assert!(check("wrong").status.success());
}

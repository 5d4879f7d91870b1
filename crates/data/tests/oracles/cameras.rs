//! The cameras that COLMAP models and `transforms.json` state, in hand-made files of one image.

use std::path::Path;

use seese3_core::geometry::{CameraIntrinsics, Distortion, PixelCamera};
use seese3_data::datasets::{ImageTimes, read_colmap, read_transforms};

use super::more_datasets::lenient;

fn intrinsics(focal: [f64; 2], distortion: Distortion) -> CameraIntrinsics {
    let camera = PixelCamera {
        width: 640.0,
        height: 480.0,
        focal: focal.into(),
        center: Some([330.0, 250.0].into()),
        distortion,
    };
    CameraIntrinsics::new(camera).unwrap()
}

fn write(folder: &Path, name: &str, text: &str) {
    std::fs::write(folder.join(name), text).unwrap();
}

/// The camera of a COLMAP model whose `cameras.txt` has this model and these parameters.
fn of_colmap(model: &str) -> Option<CameraIntrinsics> {
    let folder = tempfile::tempdir().unwrap();
    let (name, parameters) = model.split_once(' ').unwrap();
    let cameras = format!("1 {name} 640 480 {parameters}\n");
    write(folder.path(), "cameras.txt", &cameras);
    write(folder.path(), "images.txt", "1 1 0 0 0 0 0 0 1 a.png\n\n");
    write(folder.path(), "a.png", "");

    let found = lenient(|reader| read_colmap(folder.path(), None, &ImageTimes::Unknown, reader));
    found.unwrap().stated.camera
}

/// Oracle: the parameters of each model in COLMAP's documentation, by hand.
#[test]
fn colmap_cameras_have_their_focal_lengths_and_distortion() {
    let brown = Distortion::BrownConrady;
    for (model, focal, distortion) in [
        (
            "SIMPLE_PINHOLE 525 330 250",
            [525.0, 525.0],
            Distortion::None,
        ),
        ("PINHOLE 525 530 330 250", [525.0, 530.0], Distortion::None),
        (
            "SIMPLE_RADIAL 525 330 250 0.1",
            [525.0, 525.0],
            brown([0.1, 0.0, 0.0, 0.0, 0.0]),
        ),
        (
            "RADIAL 525 330 250 0.1 -0.2",
            [525.0, 525.0],
            brown([0.1, -0.2, 0.0, 0.0, 0.0]),
        ),
        (
            "OPENCV 525 530 330 250 0.1 -0.2 0.001 -0.002",
            [525.0, 530.0],
            brown([0.1, -0.2, 0.001, -0.002, 0.0]),
        ),
        (
            "FULL_OPENCV 525 530 330 250 0.1 -0.2 0.001 -0.002 0.03 0 0 0",
            [525.0, 530.0],
            brown([0.1, -0.2, 0.001, -0.002, 0.03]),
        ),
        (
            "SIMPLE_RADIAL_FISHEYE 525 330 250 -0.03",
            [525.0, 525.0],
            Distortion::KannalaBrandt([-0.03, 0.0, 0.0, 0.0]),
        ),
        (
            "RADIAL_FISHEYE 525 330 250 -0.03 0.01",
            [525.0, 525.0],
            Distortion::KannalaBrandt([-0.03, 0.01, 0.0, 0.0]),
        ),
        (
            "OPENCV_FISHEYE 525 530 330 250 -0.03 0.01 -0.002 0.0005",
            [525.0, 530.0],
            Distortion::KannalaBrandt([-0.03, 0.01, -0.002, 0.0005]),
        ),
    ] {
        assert_eq!(
            of_colmap(model),
            Some(intrinsics(focal, distortion)),
            "{model}"
        );
    }

    // Lenses of other models, and one that is not valid.
    for model in [
        "FULL_OPENCV 525 530 330 250 0.1 -0.2 0.001 -0.002 0.03 0.1 0 0",
        "FOV 525 530 330 250 0.9",
        "NEWER_MODEL 525 330 250",
        "SIMPLE_RADIAL 525 330 250 -2",
    ] {
        assert_eq!(of_colmap(model), None, "{model}");
    }
}

/// The camera of a `transforms.json` that begins with these fields.
fn of_transforms(fields: &str) -> Option<CameraIntrinsics> {
    let folder = tempfile::tempdir().unwrap();
    write(folder.path(), "a.png", "");
    let frames = r#"[{"file_path": "a.png",
        "transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}]"#;
    let text = format!(r#"{{{fields}, "w": 640, "h": 480, "frames": {frames}}}"#);
    write(folder.path(), "transforms.json", &text);

    let found = lenient(|reader| read_transforms(folder.path(), reader));
    found.unwrap().stated.camera
}

/// Oracle: the names of the fields in nerfstudio's and instant-ngp's documentation, by hand.
#[test]
fn transforms_state_two_focal_lengths_and_distortion() {
    let pixels = r#""fl_x": 525, "fl_y": 530, "cx": 330, "cy": 250"#;
    let brown = r#""k1": 0.1, "k2": -0.2, "k3": 0.03, "p1": 0.001, "p2": -0.002"#;
    let fisheye = r#""k1": -0.03, "k2": 0.01, "k3": -0.002, "k4": 0.0005"#;
    let focal = [525.0, 530.0];

    assert_eq!(
        of_transforms(pixels),
        Some(intrinsics(focal, Distortion::None))
    );
    let lens = Distortion::BrownConrady([0.1, -0.2, 0.001, -0.002, 0.03]);
    for model in ["", r#", "camera_model": "OPENCV""#] {
        let stated = of_transforms(&format!("{pixels}, {brown}{model}"));
        assert_eq!(stated, Some(intrinsics(focal, lens)), "{model}");
    }
    let lens = Distortion::KannalaBrandt([-0.03, 0.01, -0.002, 0.0005]);
    for model in [
        r#""camera_model": "OPENCV_FISHEYE""#,
        r#""is_fisheye": true"#,
    ] {
        let stated = of_transforms(&format!("{pixels}, {fisheye}, {model}"));
        assert_eq!(stated, Some(intrinsics(focal, lens)), "{model}");
    }
    for other in [
        r#""camera_model": "EQUIRECTANGULAR""#,
        r#""camera_model": "OPENCV", "k4": 0.1"#,
    ] {
        assert_eq!(
            of_transforms(&format!("{pixels}, {other}")),
            None,
            "{other}"
        );
    }
}

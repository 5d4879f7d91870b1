//! COLMAP, nerfstudio, KITTI, EuRoC and folders of one's own, on files that other programs wrote
//! (tests/golden/datasets/make_models.py).

use std::path::{Path, PathBuf};

use nalgebra::Matrix4;
use seese3_core::geometry::{CameraIntrinsics, Distortion, PixelCamera};
use seese3_data::datasets::{
    DropReason, Error, ImageTimes, Kitti, Reader, Recording, Unusable, read_colmap, read_euroc,
    read_folder, read_kitti, read_transforms,
};

use seese3_testing::{golden, json};

pub fn folder(name: &str) -> PathBuf {
    golden().join("datasets").join(name)
}

pub fn lenient<T>(read: impl FnOnce(&mut Reader<'_>) -> T) -> T {
    read(&mut Reader {
        unusable: Unusable::Drop,
        progress: &mut |_, _| (),
    })
}

/// The poses that the files were made from.
pub fn expected() -> Vec<Matrix4<f64>> {
    let file = json(&folder("expected_models.json"));
    let matrix = |numbers: &serde_json::Value| {
        let numbers = numbers
            .as_array()
            .unwrap()
            .iter()
            .map(|x| x.as_f64().unwrap());
        Matrix4::from_row_iterator(numbers)
    };
    file["world_from_camera"]
        .as_array()
        .unwrap()
        .iter()
        .map(matrix)
        .collect()
}

fn has_poses(found: &Recording, count: usize) {
    assert_eq!(found.frames.poses.len(), count);
    for (row, (pose, expected)) in found.frames.poses.iter().zip(expected()).enumerate() {
        let off = (pose.to_homogeneous() - expected).amax();
        assert!(off < 1e-9, "frame {row} is off by {off}");
    }
}

/// A camera of these files.
fn camera(center: [f64; 2], distortion: Distortion) -> CameraIntrinsics {
    let camera = PixelCamera {
        width: 8.0,
        height: 6.0,
        focal: [7.5, 7.5].into(),
        center: Some(center.into()),
        distortion,
    };
    CameraIntrinsics::new(camera).unwrap()
}

/// Oracle: the poses from which COLMAP's own library wrote both models.
#[test]
fn colmap_models_are_read_in_both_forms() {
    for (model, images) in [
        ("colmap", None),
        ("colmap/text", Some(folder("colmap/images"))),
    ] {
        let found = lenient(|reader| {
            read_colmap(
                &folder(model),
                images.as_deref(),
                &ImageTimes::Unknown,
                reader,
            )
        });
        let found = found.unwrap();
        has_poses(&found, 5);
        let lens = Distortion::BrownConrady([0.01, 0.0, 0.0, 0.0, 0.0]);
        assert_eq!(found.stated.camera, Some(camera([4.0, 3.0], lens)));
        assert_eq!(
            found.frames.images,
            [
                "img_0.png",
                "img_1.png",
                "img_2.png",
                "img_3.png",
                "img_10.png"
            ]
        );

        let [dropped] = found.dropped.as_slice() else {
            panic!("{:?}", found.dropped);
        };
        assert_eq!(dropped.name, "img_11.png");
        assert_eq!(dropped.reason, DropReason::MissingImage);
    }
}

/// Oracle: the numbers in the names of the images over the rate, and the lines of the file, by
/// hand.
#[test]
fn a_colmap_model_takes_times() {
    let read = |times: &ImageTimes| {
        lenient(|reader| read_colmap(&folder("colmap"), None, times, reader))
            .map(|found| found.frames.timestamps_ns)
    };
    assert!(read(&ImageTimes::Unknown).unwrap().is_empty());
    let by_rate = read(&ImageTimes::Rate(4.0)).unwrap();
    assert_eq!(
        by_rate,
        [0, 250_000_000, 500_000_000, 750_000_000, 2_500_000_000]
    );

    let file = tempfile::NamedTempFile::new().unwrap();
    let lines = "# seconds name\n7.5 img_0.png\n8 img_1.png\n9 img_2.png\n10 img_3.png\n11.000000001 img_10.png\n";
    std::fs::write(file.path(), format!("{lines}12 img_11.png\n")).unwrap();
    let times = ImageTimes::File(file.path().to_owned());
    let by_file = read(&times).unwrap();
    assert_eq!(
        by_file,
        [
            7_500_000_000,
            8_000_000_000,
            9_000_000_000,
            10_000_000_000,
            11_000_000_001
        ]
    );

    std::fs::write(file.path(), lines).unwrap();
    let error = read(&times).unwrap_err().to_string();
    assert!(error.contains("img_11.png"), "{error}");
    std::fs::write(file.path(), format!("{lines}12 img_0.png\n")).unwrap();
    assert!(
        read(&times)
            .unwrap_err()
            .to_string()
            .contains("second time")
    );
}

/// Oracle: the format: every cut of a file is refused, and no size in it is believed.
#[test]
fn hostile_colmap_files_are_refused() {
    let copy = tempfile::tempdir().unwrap();
    let model = folder("colmap/sparse/0");
    let images = folder("colmap/images");
    let read =
        || lenient(|reader| read_colmap(copy.path(), Some(&images), &ImageTimes::Unknown, reader));
    for (cut_file, other) in [("images.bin", "cameras.bin"), ("cameras.bin", "images.bin")] {
        std::fs::copy(model.join(other), copy.path().join(other)).unwrap();
        let whole = std::fs::read(model.join(cut_file)).unwrap();
        for cut in 0..whole.len() {
            std::fs::write(copy.path().join(cut_file), &whole[..cut]).unwrap();
            let error = read().unwrap_err().to_string();
            assert!(error.contains(cut_file), "{error}");
        }

        let mut huge = whole.clone();
        huge[..8].fill(0xff);
        std::fs::write(copy.path().join(cut_file), &huge).unwrap();
        assert!(read().is_err());
        std::fs::write(copy.path().join(cut_file), &whole).unwrap();
    }
    assert!(read().is_ok());

    let empty = tempfile::tempdir().unwrap();
    let error = lenient(|reader| read_colmap(empty.path(), None, &ImageTimes::Unknown, reader))
        .unwrap_err();
    assert!(error.to_string().contains("sparse/0"), "{error}");
}

/// Oracle: the poses from which the file was written, in OpenGL's axes and out of order.
#[test]
fn transforms_are_turned_and_sorted() {
    for path in ["transforms", "transforms/transforms.json"] {
        let found = lenient(|reader| read_transforms(&folder(path), reader)).unwrap();
        has_poses(&found, 6);
        let stated = camera([4.0, 3.0], Distortion::None);
        assert_eq!(found.stated.camera, Some(stated));
        let images: Vec<String> = (8..14).map(|n| format!("images/f{n}.png")).collect();
        assert_eq!(found.frames.images, images);
    }
}

/// Oracle: the poses and times from which NumPy wrote the files.
#[test]
fn kitti_poses_go_with_images_and_times() {
    let poses = folder("kitti/poses.txt");
    let beside = Kitti {
        images: Some(folder("kitti/image_2")),
        times: Some(folder("kitti/times.txt")),
    };
    let found = lenient(|reader| read_kitti(&poses, &beside, reader)).unwrap();
    has_poses(&found, 6);
    assert_eq!(found.frames.images[3], "000003.png");
    assert_eq!(found.frames.timestamps_ns[3], 300_000_000);

    let alone = lenient(|reader| read_kitti(&poses, &Kitti::default(), reader)).unwrap();
    has_poses(&alone, 6);
    assert!(alone.frames.images.is_empty());

    // As many images as poses, or nothing.
    let other = Kitti {
        images: Some(folder("colmap/images")),
        times: None,
    };
    let error = lenient(|reader| read_kitti(&poses, &other, reader)).unwrap_err();
    assert!(error.to_string().contains("5 images"), "{error}");
}

/// Oracle: the poses from which NumPy and SciPy wrote the files, of a body that the camera is
/// turned on.
#[test]
fn euroc_poses_are_those_of_the_camera() {
    for path in ["euroc", "euroc/mav0"] {
        let found = lenient(|reader| read_euroc(&folder(path), "cam0", reader)).unwrap();
        has_poses(&found, 5);
        // EuRoC's center of the first pixel is at (0, 0).
        let stated = camera([4.5, 3.5], Distortion::None);
        assert_eq!(found.stated.camera, Some(stated));
        assert_eq!(found.frames.timestamps_ns[1], 1_000_000_000_050_000_000);
        assert_eq!(found.dropped[0].reason, DropReason::NoPoseWithinTolerance);
    }

    let missing = lenient(|reader| read_euroc(&folder("euroc"), "cam1", reader));
    assert!(matches!(missing, Err(Error::Io { .. })));
}

/// Oracle: the definition: the n-th image by its number has the n-th pose.
#[test]
fn a_folder_of_ones_own_pairs_images_with_poses() {
    let own = tempfile::tempdir().unwrap();
    std::fs::create_dir(own.path().join("images")).unwrap();
    let image = |name: &str| {
        let from = folder("kitti/image_2/000000.png");
        std::fs::copy(from, own.path().join("images").join(name)).unwrap();
    };
    let names = [
        "a1.PNG", "a2.jpg", "a10.jpeg", "a11.png", "a12.png", "a100.png",
    ];
    names.into_iter().for_each(image);

    let matrices: Vec<f64> = expected()
        .iter()
        .flat_map(|m| m.transpose().data.0.concat())
        .collect();
    let poses = ndarray::Array3::from_shape_vec((6, 4, 4), matrices).unwrap();
    ndarray_npy::write_npy(own.path().join("poses.npy"), &poses).unwrap();

    let found = read_folder(own.path()).unwrap();
    has_poses(&found, 6);
    assert_eq!(
        found.frames.images,
        names.map(|name| format!("images/{name}"))
    );
    assert!(
        Path::new(&found.images_root)
            .join(&found.frames.images[5])
            .is_file()
    );

    image("one_more.jpg");
    let error = read_folder(own.path()).unwrap_err().to_string();
    assert!(
        error.contains("7 images") && error.contains("6 poses"),
        "{error}"
    );
}

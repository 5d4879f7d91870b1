//! Every recording format against what NumPy, SciPy and evo read from the same files, traps and
//! all.

use std::path::{Path, PathBuf};

use seese3_core::features::{FeatureSource, Features};
use seese3_core::geometry::{CameraIntrinsics, Distortion, PixelCamera};
use seese3_core::room::{FrameId, Provenance, Room, RoomId};
use seese3_core::splits::HoldOut;
use seese3_data::datasets::{
    BundleContents, Error, KeypointArrays, Reader, Recording, SevenScenes, Unusable,
    read_arkitscenes, read_bundle, read_numpy, read_scannet, read_sens, read_seven_scenes,
    read_tum, read_twelve_scenes, write_numpy,
};
use seese3_testing::{golden, json, near, number};
use serde_json::Value;

fn folder() -> PathBuf {
    golden().join("datasets")
}

fn expected(format: &str) -> Value {
    json(&folder().join("expected.json"))[format].clone()
}

fn root(expected: &Value) -> PathBuf {
    folder().join(expected["root"].as_str().unwrap())
}

fn lenient<T>(read: impl FnOnce(&mut Reader<'_>) -> T) -> T {
    read(&mut Reader {
        unusable: Unusable::Drop,
        progress: &mut |_, _| (),
    })
}

fn strict<T>(read: impl FnOnce(&mut Reader<'_>) -> T) -> T {
    read(&mut Reader {
        unusable: Unusable::Refuse,
        progress: &mut |_, _| (),
    })
}

/// Names, poses (1e-9), and what else the oracle says of each frame; then the dropped ones with
/// their reasons.
fn agrees(found: &Recording, expected: &Value) {
    let frames = expected["frames"].as_array().unwrap();
    let names: Vec<&str> = frames
        .iter()
        .map(|frame| frame["name"].as_str().unwrap())
        .collect();

    assert_eq!(found.frames.names, names);

    for (row, frame) in frames.iter().enumerate() {
        for (position, value) in found.frames.poses[row]
            .to_homogeneous()
            .transpose()
            .iter()
            .enumerate()
        {
            near(
                names[row],
                *value,
                number(&frame["world_from_camera"][position]),
                1e-9,
            );
        }

        if let Some(time) = frame["timestamp_ns"].as_i64() {
            assert_eq!(found.frames.timestamps_ns[row], time);
        }
        if let Some(id) = frame["frame_id"].as_i64() {
            assert_eq!(found.frames.numbers[row], id);
        }

        if let Some(split) = frame["split"].as_str() {
            assert_eq!(
                found.frames.held_out[row],
                split == "test",
                "{}",
                names[row]
            );
        }
    }

    let dropped: Vec<(String, String)> = found
        .dropped
        .iter()
        .map(|frame| (frame.name.clone(), frame.reason.to_string()))
        .collect();

    let text = |value: &Value| value.as_str().unwrap().to_owned();
    let wanted: Vec<(String, String)> = expected["dropped"]
        .as_array()
        .unwrap()
        .iter()
        .map(|frame| (text(&frame["name"]), text(&frame["reason"])))
        .collect();

    assert_eq!(dropped, wanted);

    for image in &found.frames.images {
        let file = image.split('@').next().unwrap();
        assert!(
            Path::new(&found.images_root).join(file).is_file(),
            "{image}"
        );
    }

    assert_eq!(found.frames.images.len(), names.len());
}

fn refuses(read: Result<Recording, Error>, word: &str) {
    let message = read.unwrap_err().to_string();
    assert!(message.contains(word), "{message}");
}

#[test]
fn tum_is_read_as_evo_reads_it() {
    let expected = expected("tum");
    let folder = root(&expected);
    agrees(
        &lenient(|reader| read_tum(&folder, reader)).unwrap(),
        &expected,
    );

    refuses(
        strict(|reader| read_tum(&folder, reader)),
        "no_pose_within_tolerance",
    );
}

/// Oracle: evo's verdicts, and the recommendation beside them to refuse all seven by file and line.
#[test]
fn malformed_trajectories_are_refused_by_file_and_line() {
    let folder = root(&expected("tum"));

    let malformed = expected("tum")["malformed_files"]
        .as_object()
        .unwrap()
        .clone();

    assert_eq!(malformed.len(), 7);

    for name in malformed.keys() {
        let copy = tempfile::tempdir().unwrap();
        std::fs::copy(folder.join("rgb.txt"), copy.path().join("rgb.txt")).unwrap();
        let broken = folder.join(format!("malformed_{name}.txt"));
        std::fs::copy(broken, copy.path().join("groundtruth.txt")).unwrap();

        refuses(
            lenient(|reader| read_tum(copy.path(), reader)),
            "groundtruth.txt, line 2",
        );
    }
}

#[test]
fn seven_scenes_keeps_sequences_and_the_split() {
    let expected = expected("sevenscenes");
    let scene = root(&expected);
    let read = |choice: &SevenScenes| lenient(|reader| read_seven_scenes(&scene, choice, reader));
    let found = read(&SevenScenes::default()).unwrap();
    agrees(&found, &expected);

    assert_eq!(found.frames.sequences, [0, 0, 0, 0, 0, 0, 1, 1]);
    assert_eq!(found.frames.numbers, [0, 1, 2, 3, 4, 5, 0, 1]);

    // Both sequences are one room: the first can be mapped, and the second localized in it.
    let name = RoomId::new("chess").unwrap();
    let room = Room::new(name, found.frames.clone(), Provenance::default()).unwrap();
    let rows = |frames: Vec<FrameId>| frames.iter().map(|frame| frame.0).collect::<Vec<_>>();
    assert_eq!(
        rows(HoldOut::Visit.mapped(room.timeline())),
        [0, 1, 2, 3, 4, 5]
    );
    assert_eq!(rows(HoldOut::Visit.tracked(room.timeline())), [6, 7]);

    let one = SevenScenes {
        sequence: Some("seq-02".to_owned()),
        ..SevenScenes::default()
    };

    assert_eq!(
        read(&one).unwrap().frames.names,
        ["seq-02/frame-000000", "seq-02/frame-000001"]
    );

    let inside =
        lenient(|reader| read_seven_scenes(&scene.join("seq-02"), &SevenScenes::default(), reader))
            .unwrap();

    assert_eq!(
        inside.frames.names,
        ["seq-02/frame-000000", "seq-02/frame-000001"]
    );

    refuses(
        strict(|reader| read_seven_scenes(&scene, &SevenScenes::default(), reader)),
        "missing_pose_file",
    );

    refuses(
        read(&SevenScenes {
            sequence: Some("seq-09".to_owned()),
            ..one
        }),
        "seq-01, seq-02",
    );
}

/// Oracle: the published poses times the inverse of a made-up calibration, by NumPy.
#[test]
fn seven_scenes_poses_can_be_those_of_the_color_camera() {
    let expected = expected("sevenscenes");
    let file = tempfile::NamedTempFile::new().unwrap();

    let numbers: Vec<String> = expected["with_calibration"]["rgb_from_depth"]
        .as_array()
        .unwrap()
        .iter()
        .map(ToString::to_string)
        .collect();
    std::fs::write(file.path(), numbers.join(" ")).unwrap();

    let choice = SevenScenes {
        sequence: Some("seq-01".to_owned()),
        rgb_from_depth: Some(file.path().to_owned()),
    };
    let found = lenient(|reader| read_seven_scenes(&root(&expected), &choice, reader)).unwrap();

    let wanted = expected["with_calibration"]["world_from_rgb"]
        .as_array()
        .unwrap();

    assert_eq!(found.frames.poses.len(), wanted.len());

    for (pose, wanted) in found.frames.poses.iter().zip(wanted) {
        for (position, value) in pose.to_homogeneous().transpose().iter().enumerate() {
            near("world_from_rgb", *value, number(&wanted[position]), 1e-9);
        }
    }
}

#[test]
fn twelve_scenes_tests_its_first_sequence() {
    let expected = expected("twelvescenes");
    let folder = root(&expected);
    let found = lenient(|reader| read_twelve_scenes(&folder, reader)).unwrap();
    agrees(&found, &expected);

    assert_eq!(found.frames.sequences, [0, 0, 0, 1, 1, 1]);

    refuses(
        strict(|reader| read_twelve_scenes(&folder, reader)),
        "non_finite_pose",
    );
}

#[test]
fn scannet_frames_go_by_number() {
    let expected = expected("scannet_export");
    let folder = root(&expected);
    agrees(
        &lenient(|reader| read_scannet(&folder, reader)).unwrap(),
        &expected,
    );

    refuses(
        strict(|reader| read_scannet(&folder, reader)),
        "non_finite_pose",
    );

    let lost = self::folder().join(expected["all_invalid_scene"]["root"].as_str().unwrap());
    refuses(
        lenient(|reader| read_scannet(&lost, reader)),
        "no usable frame",
    );
}

/// The exporter's other habit: everything in one folder. Oracle: the same scene in two.
#[test]
fn a_flat_scannet_export_gives_the_same_frames() {
    let folder = root(&expected("scannet_export"));
    let flat = tempfile::tempdir().unwrap();
    for part in ["color", "pose"] {
        for entry in std::fs::read_dir(folder.join(part)).unwrap() {
            let entry = entry.unwrap();
            std::fs::copy(entry.path(), flat.path().join(entry.file_name())).unwrap();
        }
    }

    let found = lenient(|reader| read_scannet(flat.path(), reader)).unwrap();
    assert_eq!(found.frames.numbers, [0, 1, 2, 9, 10, 100]);
    assert_eq!(found.frames.images[5], "100.jpg");
}

#[test]
fn sens_files_are_read_whole_or_not_at_all() {
    let expected = expected("scannet_sens");
    let file = folder().join(expected["file"].as_str().unwrap());
    let found = lenient(|reader| read_sens(&file, reader)).unwrap();
    agrees(&found, &expected);

    for (time, frame) in found
        .frames
        .timestamps_ns
        .iter()
        .zip(expected["frames"].as_array().unwrap())
    {
        assert_eq!(time / 1_000, frame["timestamp_color"].as_i64().unwrap());
    }

    let bytes = std::fs::read(&file).unwrap();
    for image in &found.frames.images {
        let (offset, length) = image.split_once('@').unwrap().1.split_once('+').unwrap();
        let offset = offset.parse().unwrap();
        let length: usize = length.parse().unwrap();
        let jpeg = &bytes[offset..offset + length];

        assert!(
            jpeg.starts_with(&[0xff, 0xd8]) && jpeg.ends_with(&[0xff, 0xd9]),
            "a JPEG begins and ends so"
        );
    }

    let truncated = folder().join(expected["truncated"]["file"].as_str().unwrap());
    refuses(lenient(|reader| read_sens(&truncated, reader)), "truncated");
}

/// Oracle: the format. Every cut of a file is refused, and sizes that reach past its end are not
/// believed.
#[test]
fn hostile_sens_files_are_refused() {
    let bytes = std::fs::read(folder().join("scannet_sens/tiny.sens")).unwrap();
    let file = tempfile::NamedTempFile::new().unwrap();
    let end_of_frames = bytes.len() - 8;
    for cut in (0..end_of_frames)
        .step_by(97)
        .chain([0, 1, 4, 12, end_of_frames - 1])
    {
        std::fs::write(file.path(), &bytes[..cut]).unwrap();

        assert!(
            lenient(|reader| read_sens(file.path(), reader)).is_err(),
            "cut at {cut}"
        );
    }

    let header = 4 + 8 + 13 + 4 * 64 + 4 + 4 + 4 * 4 + 4;
    for (at, what) in [
        (4, "the name"),
        (header, "the frames"),
        (header + 8 + 64 + 16, "the color image"),
    ] {
        let mut altered = bytes.clone();
        altered[at..at + 8].copy_from_slice(&u64::MAX.to_le_bytes());
        std::fs::write(file.path(), altered).unwrap();

        assert!(
            lenient(|reader| read_sens(file.path(), reader)).is_err(),
            "{what}"
        );
    }
}

#[test]
fn arkitscenes_poses_are_inverted_and_matched_in_time() {
    let expected = expected("arkitscenes");
    let folder = root(&expected);
    agrees(
        &lenient(|reader| read_arkitscenes(&folder, reader)).unwrap(),
        &expected,
    );

    refuses(
        strict(|reader| read_arkitscenes(&folder, reader)),
        "no_pose_within_tolerance",
    );
}

fn exported(out: &Path) -> (Room, Features) {
    let found =
        lenient(|reader| read_sens(&folder().join("scannet_sens/tiny.sens"), reader)).unwrap();

    let provenance = Provenance {
        format: "scannet".to_owned(),
        license: "test only".to_owned(),
        images_root: found.images_root.clone(),
        worst_rotation_deviation: found.worst_rotation_deviation,
        camera: Some(
            CameraIntrinsics::new(PixelCamera {
                width: 640.0,
                height: 480.0,
                focal: [525.0, 526.0].into(),
                center: Some([330.0, 250.0].into()),
                distortion: Distortion::BrownConrady([0.1, -0.2, 0.001, -0.002, 0.03]),
            })
            .unwrap(),
        ),
    };
    let room = Room::new(RoomId::new("tiny").unwrap(), found.frames, provenance).unwrap();

    let source = FeatureSource {
        encoder: "e".to_owned(),
        layer: "l".to_owned(),
        preprocess: "p".to_owned(),
        ..FeatureSource::imported("f", 2)
    };

    let rows = ndarray::Array2::from_shape_fn((6, 2), |(row, column)| (row * 2 + column) as f32);
    let features = Features::new(source, rows).unwrap();
    let contents = BundleContents {
        room: &room,
        features: std::slice::from_ref(&features),
        keypoints: Some(&keypoints()),
    };
    write_numpy(out, contents).unwrap();

    (room, features)
}

/// Keypoints of six frames, three in all.
fn keypoints() -> KeypointArrays {
    KeypointArrays {
        counts: ndarray::arr1(&[1, 0, 2, 0, 0, 0]),
        positions: ndarray::arr2(&[[0.0, 1.0], [0.25, 0.5], [0.75, 0.125]]),
        inverse_depths: ndarray::arr1(&[0.5, 2.0, 0.25]),
        deviations: ndarray::arr1(&[0.01, 0.02, 0.03]),
        descriptors: ndarray::Array2::from_shape_fn((3, 32), |(row, column)| {
            (row as i8 - 1) * column as i8
        }),
        basis_mean: ndarray::arr1(&[1.5, -2.5]),
        basis_axes: ndarray::Array2::from_elem((2, 32), 0.5),
    }
}

/// Oracle: NumPy's own format, as the `ndarray-npy` crate reads it. A room without keypoints has no
/// such file.
#[test]
fn exported_keypoints_are_arrays_of_numpy() {
    let out = tempfile::tempdir().unwrap();
    let (room, _) = exported(out.path());
    let array = |name: &str| out.path().join(format!("keypoint_{name}.npy"));
    let floats = |name: &str| seese3_testing::npy::<f32>(&array(name));
    let sent = keypoints();

    let counts = seese3_testing::npy::<i64>(&array("counts"));
    assert_eq!(counts, sent.counts.into_dyn());
    assert_eq!(floats("positions"), sent.positions.into_dyn());
    assert_eq!(floats("inverse_depths"), sent.inverse_depths.into_dyn());
    assert_eq!(floats("deviations"), sent.deviations.into_dyn());
    let descriptors = seese3_testing::npy::<i8>(&array("descriptors"));
    assert_eq!(descriptors, sent.descriptors.into_dyn());
    assert_eq!(floats("basis_mean"), sent.basis_mean.into_dyn());
    assert_eq!(floats("basis_axes"), sent.basis_axes.into_dyn());

    let without = tempfile::tempdir().unwrap();
    let contents = BundleContents {
        room: &room,
        features: &[],
        keypoints: None,
    };
    let files = write_numpy(without.path(), contents).unwrap();
    let is_keypoints = |file: &PathBuf| file.to_string_lossy().contains("keypoint_");
    assert!(!files.iter().any(is_keypoints), "{files:?}");
}

/// Oracle: NumPy's own format, as the `ndarray-npy` crate reads it, and the room that was written.
#[test]
fn an_exported_room_comes_back_whole() {
    let out = tempfile::tempdir().unwrap();
    let (room, features) = exported(out.path());
    let array = |name: &str| out.path().join(name);

    assert_eq!(
        seese3_testing::npy::<f64>(&array("poses.npy")).shape(),
        [6, 4, 4]
    );

    assert_eq!(
        seese3_testing::npy::<i64>(&array("timestamps.npy"))[1],
        1_033_333_000
    );

    assert_eq!(
        seese3_testing::npy::<i64>(&array("frame_ids.npy"))
            .into_raw_vec_and_offset()
            .0,
        [0, 1, 3, 5, 6, 7]
    );

    assert_eq!(
        seese3_testing::npy::<f32>(&array("features_f.npy")).into_dyn(),
        features.rows().to_owned().into_dyn()
    );

    let back = read_bundle(out.path()).unwrap();
    assert_eq!(
        (back.frames.names.as_slice(), back.frames.images.as_slice()),
        (room.frame_names(), room.images())
    );

    assert_eq!(back.frames.numbers, room.frame_numbers());
    assert_eq!(back.features[0].source(), features.source());

    assert_eq!(
        (back.stated.name.as_str(), back.stated.license.as_str()),
        ("tiny", "test only")
    );

    assert_eq!(back.images_root, room.provenance().images_root);
    assert_eq!(back.stated.camera, room.provenance().camera);

    for (a, b) in back.frames.poses.iter().zip(room.poses()) {
        assert!((a.to_homogeneous() - b.to_homogeneous()).amax() < 1e-14);
    }

    let plain = read_numpy(out.path()).unwrap();
    assert_eq!(plain.features[0].source(), &FeatureSource::imported("f", 2));
    assert!(plain.frames.names.is_empty());

    let again = BundleContents {
        room: &room,
        features: &[],
        keypoints: None,
    };
    assert!(
        write_numpy(out.path(), again).is_err(),
        "the folder is not empty"
    );
}

/// Oracle: by hand. Three recordings of one room, in one world frame: 2, 1 and 2 frames.
#[test]
fn arrays_of_several_recordings_make_one_room() {
    let folder = tempfile::tempdir().unwrap();
    let poses = ndarray::Array3::from_shape_fn((5, 4, 4), |(_, row, column)| {
        f64::from(u8::from(row == column))
    });
    ndarray_npy::write_npy(folder.path().join("poses.npy"), &poses).unwrap();
    let read = |sequences: &[i64]| {
        let file = folder.path().join("sequences.npy");
        ndarray_npy::write_npy(file, &ndarray::Array1::from(sequences.to_vec())).unwrap();
        read_numpy(folder.path())
    };

    let frames = read(&[4, 4, 0, 1, 1]).unwrap().frames;
    assert_eq!(frames.sequences, [4, 4, 0, 1, 1]);
    let room = Room::new(RoomId::new("r").unwrap(), frames, Provenance::default()).unwrap();
    let joined: Vec<bool> = (0..4)
        .map(|row| room.timeline().joins(FrameId(row), FrameId(row + 1)))
        .collect();
    assert_eq!(joined, [true, false, false, true]);

    for (sequences, words) in [
        (&[0, 0, 1, 1, 0][..], "sequence 0 goes on in row 4"),
        (&[0, 0, 0, 0, -1], "row 4 is -1"),
        (&[0, 0, 0, 0], "5 poses but 4 sequence marks"),
    ] {
        let error = read(sequences).unwrap_err().to_string();
        assert!(error.contains(words), "{error}");
    }
}

/// Oracle: a bundle that lost or gained a part is not the room that was written.
#[test]
fn a_bundle_that_is_not_whole_is_refused() {
    for (break_it, word) in [
        (
            (|at: &Path| std::fs::remove_file(at.join("features_f.npy")).unwrap()) as fn(&Path),
            "features_f.npy is missing",
        ),
        (
            |at| {
                std::fs::copy(at.join("features_f.npy"), at.join("features_g.npy")).unwrap();
            },
            "features_g.npy",
        ),
        (
            |at| std::fs::write(at.join("bundle.json"), "{").unwrap(),
            "bundle.json",
        ),
        (
            |at| std::fs::remove_file(at.join("poses.npy")).unwrap(),
            "poses.npy",
        ),
    ] {
        let out = tempfile::tempdir().unwrap();
        exported(out.path());
        break_it(out.path());
        refuses(read_bundle(out.path()), word);
    }
}

/// Oracle: the definition of `Error::source`: the error of the library that failed.
#[test]
fn an_error_keeps_its_cause() {
    let folder = tempfile::tempdir().unwrap();
    let cause = |error: &dyn std::error::Error| {
        let source = error.source().expect("a cause");
        source.is::<serde_json::Error>() || source.is::<std::io::Error>()
    };

    let absent = read_bundle(folder.path()).unwrap_err();
    assert!(cause(&absent), "{absent:?}");

    std::fs::write(folder.path().join("bundle.json"), "{").unwrap();
    let malformed = read_bundle(folder.path()).unwrap_err();
    assert!(cause(&malformed), "{malformed:?}");
}

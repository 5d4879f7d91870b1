//! Synthetic rooms with a swaying camera, and a calibrated adapter, for tests of tracking.

use std::sync::LazyLock;

use seese3_core::adapter::{Adapter, Preset, TrainingRecord};
use seese3_core::features::{FeatureSource, Features};
use seese3_core::geometry::{CameraIntrinsics, Distortion, PixelCamera, Pose};
use seese3_core::room::{Frames, Provenance, Room, RoomId};
use seese3_core::splits::Split;
use seese3_core::training::{TrainingPlan, train_adapter};
use seese3_robot::calibration::calibrate;

use crate::{noise, room_data};

pub const FRAMES: usize = 300;
const COLUMNS: usize = 48;

/// A synthetic room: a camera that sways and returns. Features are a linear function of the pose,
/// plus a constant for the room and noise.
pub fn place(name: &str, seed: u64) -> (Room, Features) {
    let phase = |axis: usize| 3.0 * noise(seed, 1_000_000 + axis);
    let sway = |t: usize, axis: usize| (t as f64 / (18.0 + 3.0 * axis as f64) + phase(axis)).sin();

    let poses: Vec<Pose> = (0..FRAMES)
        .map(|t| {
            let position =
                nalgebra::Vector3::new(0.6 * sway(t, 0), 0.1 * sway(t, 1), 0.8 * sway(t, 2));
            let turn =
                nalgebra::Vector3::new(0.05 * sway(t, 3), 0.3 * sway(t, 4), 0.05 * sway(t, 5));

            Pose::new(position, turn)
        })
        .collect();

    let features = ndarray::Array2::from_shape_fn((FRAMES, COLUMNS), |(row, column)| {
        let t = poses[row].translation.vector;
        let r = poses[row].rotation.scaled_axis();
        let numbers = [t.x, t.y, t.z, r.x, r.y, r.z];
        let seen: f64 = (0..6).map(|i| noise(7, column * 6 + i) * numbers[i]).sum();

        let which = 2.0 * noise(seed, 2_000_000 + column);
        (seen + which + 0.01 * noise(seed, row * COLUMNS + column)) as f32
    });

    let frames = Frames {
        poses,
        ..Frames::default()
    };
    let camera = PixelCamera {
        width: 640.0,
        height: 480.0,
        focal: [585.0, 585.0].into(),
        center: None,
        distortion: Distortion::None,
    };
    let provenance = Provenance {
        camera: Some(CameraIntrinsics::new(camera).unwrap()),
        ..Provenance::default()
    };
    let room = Room::new(RoomId::new(name).unwrap(), frames, provenance).unwrap();

    (
        room,
        Features::new(FeatureSource::imported("made-up", COLUMNS), features).unwrap(),
    )
}

/// A training room of the adapter, by name ("hall" or any other for "attic").
pub fn served(name: &str) -> (Room, Features) {
    place(name, if name == "hall" { 1 } else { 2 })
}

/// An adapter trained in three rooms and calibrated in four others. It is trained once per test
/// program.
pub fn calibrated() -> (Adapter, TrainingRecord) {
    static CALIBRATED: LazyLock<(Adapter, TrainingRecord)> = LazyLock::new(train_and_calibrate);
    CALIBRATED.clone()
}

fn train_and_calibrate() -> (Adapter, TrainingRecord) {
    let learned = [served("hall"), served("attic"), place("barn", 3)];
    let mut plan = TrainingPlan::of(Preset::PaperBase, Split::Whole, 10, 0);
    plan.config.epochs = 60;

    let (adapter, record) = train_adapter(&room_data(&learned), &plan, &mut |_| ()).unwrap();
    let others: Vec<(Room, Features)> = (10..14)
        .map(|seed| place(&format!("other{seed}"), seed))
        .collect();

    let calibrated = calibrate(adapter, record, &room_data(&others)).unwrap();
    assert!(calibrated.can_track);
    (calibrated.adapter, calibrated.record)
}

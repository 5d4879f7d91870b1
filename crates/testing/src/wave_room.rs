//! A synthetic room of any size with features as wide as an encoder's, for benchmarks.

use nalgebra::Vector3;
use ndarray::Array2;
use seese3_core::adapter::{Adapter, Preset, TrainingRecord};
use seese3_core::features::{FeatureSource, Features};
use seese3_core::geometry::{Pose, Twist, exp};
use seese3_core::room::{Frames, Provenance, Room, RoomId};
use seese3_core::splits::Split;
use seese3_core::training::{TrainingPlan, train_adapter};
use seese3_robot::calibration::calibrate;

use crate::{noise, room_data};

/// Columns of the features.
pub const COLUMNS: usize = 768;
/// Numbers of a pose that the features depend on: the first three rows of its matrix.
const NUMBERS: usize = 12;

/// A camera on a wavy path. A feature is a smooth function of the pose and the room, plus noise.
pub fn wave_room(name: &str, seed: u64, frame_count: usize) -> (Room, Features) {
    let phase = |axis: usize| 3.0 * noise(seed, axis);
    let wave =
        |t: usize, axis: usize| 0.02 * (t as f64 / (9.0 + 3.0 * axis as f64) + phase(axis)).sin();
    let step = |t: usize| Twist {
        linear: Vector3::from_fn(|axis, _| wave(t, axis)),
        angular: Vector3::from_fn(|axis, _| wave(t, 3 + axis)),
    };
    let poses = (0..frame_count).scan(Pose::identity(), |pose, t| {
        *pose *= exp(&step(t));
        Some(*pose)
    });
    let poses: Vec<Pose> = poses.collect();

    let weights = Array2::from_shape_fn((COLUMNS, NUMBERS), |(column, number)| {
        noise(1, column * NUMBERS + number)
    });
    let rows = Array2::from_shape_fn((frame_count, COLUMNS), |(row, column)| {
        let pose = poses[row].to_homogeneous();
        let weights = weights.row(column);
        let sum: f64 = (0..NUMBERS)
            .map(|i| weights[i] * pose[(i / 4, i % 4)])
            .sum();
        let of_room = noise(seed, 1_000 + column);
        let noise = noise(seed, 1_000_000 + row * COLUMNS + column);
        ((sum + of_room).sin() + 0.01 * noise) as f32
    });

    let frames = Frames {
        poses,
        ..Frames::default()
    };
    let room = Room::new(RoomId::new(name).unwrap(), frames, Provenance::default()).unwrap();
    let source = FeatureSource::imported("bench", COLUMNS);
    (room, Features::new(source, rows).unwrap())
}

/// An adapter for tracking, trained in the first of three or more rooms and calibrated in the others.
pub fn calibrated(rooms: &[(Room, Features)]) -> (Adapter, TrainingRecord) {
    let room_data = room_data(rooms);

    let plan = TrainingPlan::of(Preset::PaperBase, Split::Whole, 20, 0);
    let (adapter, record) = train_adapter(&room_data[..1], &plan, &mut |_| ()).unwrap();
    let calibrated = calibrate(adapter, record, &room_data[1..]).unwrap();
    assert!(calibrated.can_track, "the adapter has to track");
    (calibrated.adapter, calibrated.record)
}

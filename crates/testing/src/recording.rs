//! A room, features and an adapter derived from the synthetic oracle room.

use seese3_core::adapter::{Adapter, Preset, TrainingRecord};
use seese3_core::features::{FeatureSource, Features};
use seese3_core::geometry::{CameraIntrinsics, Distortion, PixelCamera};
use seese3_core::room::{Frames, Provenance, Room, RoomId};
use seese3_core::splits::Split;
use seese3_core::training::{RoomData, TrainingPlan, train_adapter};

use crate::{features, golden, poses};

/// The first 300 frames of the synthetic room, with all optional columns.
pub fn room(name: &str) -> Room {
    let mut poses = poses(&golden().join("rooms/synthetic/poses.npy"));
    poses.truncate(300);
    let names = (0..300).map(|i| format!("seq/frame-{i:06}")).collect();
    let timestamps_ns = (0..300)
        .map(|i| 1_700_000_000_000_000_000 + i * 33_333_333)
        .collect();

    let provenance = Provenance {
        format: "test".to_owned(),
        license: "CC0".to_owned(),
        images_root: "/recordings/a".to_owned(),
        worst_rotation_deviation: 1e-4,
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

    Room::new(
        RoomId::new(name).unwrap(),
        Frames {
            poses,
            timestamps_ns,
            names,
            numbers: (0..300).map(|row| 3 * row).collect(),
            images: (0..300).map(|row| format!("color/{row}.jpg")).collect(),
            sequences: (0..300).map(|row| row / 50).collect(),
            held_out: (0..300).map(|row| row >= 250).collect(),
        },
        provenance,
    )
    .unwrap()
}

/// Features of the synthetic room, multiplied by `scale`, with the source name `name`.
pub fn set(name: &str, scale: f32) -> Features {
    let rows = features(&golden(), "synthetic").slice_move(ndarray::s![..300, ..]) * scale;
    Features::new(FeatureSource::imported(name, 0), rows).unwrap()
}

/// An adapter trained for two epochs.
pub fn adapter(room: &Room, features: &Features) -> (Adapter, TrainingRecord) {
    let mut plan = TrainingPlan::of(Preset::PaperBase, Split::Time, 20, 4);
    plan.config.epochs = 2;

    train_adapter(
        &[RoomData {
            room,
            revision: 1,
            features,
        }],
        &plan,
        &mut |_| (),
    )
    .unwrap()
}

//! Rooms seen by a camera that turns in place: feature maps sample random waves on the sphere, so
//! that the similarity of two cells depends only on the angle between their directions.

use ndarray::Array2;
use seese3_core::adapter::{Adapter, Preset, RelationalConfig, TrainingRecord};
use seese3_core::features::{FeatureSource, Features};
use seese3_core::geometry::{Pose, Twist, exp};
use seese3_core::nalgebra::Vector3;
use seese3_core::room::{Frames, Provenance, Room, RoomId};
use seese3_core::splits::Split;
use seese3_core::training::{RoomData, TrainingPlan, train_adapter, train_reader};

/// Half of the field of view across and down, as tangents.
const HALF_VIEW: [f64; 2] = [0.6, 0.45];
/// Numbers per cell.
const CHANNELS: usize = 24;

/// A room with the feature sets `coarse` (2 × 2 cells) and `fine` (4 × 4 cells).
pub struct Panorama {
    pub room: Room,
    pub features: [Features; 2],
    pub joined: Features,
}

impl Panorama {
    /// A room of `frames` frames. `seed` decides its waves and the camera's path.
    pub fn new(name: &str, seed: u64, frames: usize) -> Self {
        let wave =
            |index: usize| ((seed as f64 + 1.3) * (index as f64 + 0.7) * 12.9898).sin() * 437.58;
        let unit = |index: usize| wave(index).fract();

        // A smooth walk of yaw and pitch, radians.
        let [a, b, c] = [unit(1), unit(2), unit(3)].map(|x| 1.0 + x.abs());
        let poses: Vec<Pose> = (0..frames)
            .map(|frame| {
                let t = frame as f64 * 0.03;
                let yaw = 0.9 * (a * t).sin() + 0.5 * (0.37 * b * t).cos();
                let pitch = 0.25 * (1.3 * c * t).sin();
                let turn = |angular: [f64; 3]| {
                    exp(&Twist {
                        linear: Vector3::zeros(),
                        angular: angular.into(),
                    })
                };
                turn([0.0, yaw, 0.0]) * turn([pitch, 0.0, 0.0])
            })
            .collect();

        let direction = |pose: &Pose, x: f64, y: f64| {
            let ray = Vector3::new(x * HALF_VIEW[0], y * HALF_VIEW[1], 1.0);
            (pose.rotation * ray).normalize()
        };
        let channel = |channel: usize, at: Vector3<f64>| {
            let number = |k: usize| 6.0 * unit(10 + 4 * channel + k);
            let phase = number(3);
            (Vector3::new(number(0), number(1), number(2)).dot(&at) + phase).cos()
        };

        let map = |name: &str, cells: usize| {
            let rows =
                Array2::from_shape_fn((frames, CHANNELS * cells * cells), |(frame, column)| {
                    // Flattened in the order (channels, rows, columns).
                    let place = |cell: usize| 2.0 * cell as f64 / (cells - 1) as f64 - 1.0;
                    let (x, y) = (place(column % cells), place(column / cells % cells));
                    channel(column / (cells * cells), direction(&poses[frame], x, y)) as f32
                });
            let source = FeatureSource {
                encoder: "panorama".to_owned(),
                layer: name.to_owned(),
                pooling: format!("grid{cells}x{cells}"),
                ..FeatureSource::imported(name, 0)
            };
            Features::new(source, rows).unwrap()
        };

        let features = [map("coarse", 2), map("fine", 4)];
        let joined = Features::joined(&[&features[0], &features[1]]).unwrap();
        let frames = Frames {
            poses,
            ..Frames::default()
        };
        Self {
            room: Room::new(RoomId::new(name).unwrap(), frames, Provenance::default()).unwrap(),
            features,
            joined,
        }
    }

    /// The room with its joined features.
    pub fn data(&self) -> RoomData<'_> {
        RoomData {
            room: &self.room,
            revision: 1,
            features: &self.joined,
        }
    }
}

/// An adapter with a relational reader for the joined features of panoramas; both are hardly
/// trained. The reader is calibrated in a made-up way if `is_calibrated`.
pub fn adapter(is_calibrated: bool) -> (Adapter, TrainingRecord) {
    let rooms: Vec<Panorama> = (0..2)
        .map(|seed| Panorama::new(&format!("learned-{seed}"), seed, 60))
        .collect();
    let data: Vec<RoomData<'_>> = rooms.iter().map(Panorama::data).collect();
    let config = RelationalConfig {
        epochs: 1,
        batch: 6_400,
        hidden: 16,
        members: 2,
        ..RelationalConfig::default()
    };
    let reader = train_reader(&data, Split::Whole, &config, &mut |_| ()).unwrap();
    let reader = match is_calibrated {
        true => reader.with_error_scale([1.5, 2.0]).unwrap(),
        false => reader,
    };

    let plan = TrainingPlan::of(Preset::PaperBase, Split::Whole, 5, 0);
    let (adapter, mut record) = train_adapter(&data, &plan, &mut |_| ()).unwrap();
    record.relational = Some(config);
    (adapter.with_relational(reader).unwrap(), record)
}

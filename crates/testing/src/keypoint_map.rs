//! Keypoints of random numbers, for tests that store them.

use ndarray::{Array1, Array2};
use seese3_core::geometry::CameraIntrinsics;
use seese3_robot::matched_views::{
    COMPRESSED, DescriptorBasis, KeypointMap, MapNoise, MappedKeypoints,
};

use crate::keypoint_scene::{Random, WIDTH};

/// Median depth of [`keypoint_map`], meters.
pub const UNIT_M: f64 = 2.5;

/// Keypoints of random numbers within their ranges: `count` in each frame but every fifth.
pub fn keypoint_map(camera: CameraIntrinsics, frame_count: usize, count: usize) -> KeypointMap {
    let mut random = Random::new(4);
    let frames = (0..frame_count)
        .map(|row| {
            let count = if row % 5 == 4 { 0 } else { count };
            let mut frame = MappedKeypoints::default();
            for _ in 0..count {
                let point = [random.uniform() as f32, random.uniform() as f32];
                frame.points.push(point.into());
                frame
                    .inverse_depths
                    .push((random.between(0.02, 8.0) / UNIT_M) as f32);
                frame.deviations.push(random.between(0.002, 0.2) as f32);
                let byte = |_| random.between(-127.0, 128.0).floor() as i8;
                frame.descriptors.extend((0..COMPRESSED).map(byte));
            }
            frame
        })
        .collect();

    let mean = Array1::from_shape_fn(WIDTH, |_| random.normal() as f32);
    let axes = Array2::from_shape_fn((WIDTH, COMPRESSED), |_| random.normal() as f32);
    KeypointMap {
        camera,
        unit_m: UNIT_M,
        epipolar_px: 0.7,
        noise: MapNoise {
            design_effect: 12.0,
            gap_scale: 0.3,
            pose_noise: 0.001,
            relative_error: 0.003,
        },
        basis: DescriptorBasis::from_parts(mean, axes).unwrap(),
        frames,
    }
}

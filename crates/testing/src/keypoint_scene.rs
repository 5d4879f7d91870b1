//! A scene of points with known positions and descriptors, and the keypoints that cameras see of
//! it.

use nalgebra::{Point3, Vector2, Vector3};
use ndarray::Array2;
use seese3_core::geometry::{CameraIntrinsics, Distortion, PixelCamera, Pose};
use seese3_core::keypoints::{Keypoints, MAX_KEYPOINTS};

/// Number of components of a descriptor.
pub const WIDTH: usize = 64;

/// Uniform and normal random numbers from a seed (SplitMix64).
#[derive(Debug, Clone)]
pub struct Random(u64);

impl Random {
    pub fn new(seed: u64) -> Self {
        Self(seed)
    }

    /// Uniform in [0, 1).
    pub fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut mixed = self.0;
        mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((mixed ^ (mixed >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// Uniform in [least, most).
    pub fn between(&mut self, least: f64, most: f64) -> f64 {
        least + (most - least) * self.uniform()
    }

    /// Standard normal, by the Box–Muller transform.
    pub fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.uniform()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.uniform()).cos()
    }

    /// Standard normal along each axis.
    pub fn normals(&mut self) -> Vector3<f64> {
        Vector3::from_fn(|_, _| self.normal())
    }
}

/// A camera with radial and tangential distortion, 640 by 480 pixels.
pub fn distorted_camera() -> CameraIntrinsics {
    CameraIntrinsics::new(PixelCamera {
        width: 640.0,
        height: 480.0,
        focal: [520.0, 518.0].into(),
        center: Some([322.0, 237.0].into()),
        distortion: Distortion::BrownConrady([-0.1, 0.03, 0.001, -0.0015, 0.002]),
    })
    .unwrap()
}

/// Points of a scene, each with its own descriptor and score.
#[derive(Debug, Clone)]
pub struct Scene {
    pub points: Vec<Vector3<f64>>,
    /// Shape (n, [`WIDTH`]), rows of unit length.
    pub descriptors: Array2<f32>,
    pub scores: Vec<f32>,
}

/// The keypoints of one view, and the point of the scene that each of them shows.
#[derive(Debug, Clone)]
pub struct SceneView {
    pub keypoints: Keypoints,
    pub shown: Vec<usize>,
}

impl Scene {
    /// A scene of these points with random descriptors.
    pub fn of(points: Vec<Vector3<f64>>, seed: u64) -> Self {
        let mut random = Random::new(seed);
        let mut descriptors =
            Array2::from_shape_fn((points.len(), WIDTH), |_| random.normal() as f32);
        for mut row in descriptors.rows_mut() {
            let length = row.dot(&row).sqrt();
            row /= length;
        }

        let scores = (0..points.len()).map(|_| random.uniform() as f32).collect();
        Self {
            points,
            descriptors,
            scores,
        }
    }

    /// `count` points in a box of 6 by 4 by 4 m, the nearest 2 m from the origin along z.
    pub fn in_box(count: usize, seed: u64) -> Self {
        let mut random = Random::new(seed);
        let point = |_| {
            Vector3::new(
                random.between(-3.0, 3.0),
                random.between(-2.0, 2.0),
                random.between(2.0, 6.0),
            )
        };
        Self::of((0..count).map(point).collect(), seed + 1)
    }

    /// The view of a camera at `pose`, with normal noise of `noise_px` pixels of an image 320 wide
    /// along each axis.
    pub fn view(
        &self,
        pose: &Pose,
        camera: &CameraIntrinsics,
        noise_px: f64,
        random: &mut Random,
    ) -> SceneView {
        let mut shown = Vec::new();
        let mut points = Vec::new();
        for (place, point) in self.points.iter().enumerate() {
            let direction = pose.inverse_transform_point(&Point3::from(*point)).coords;
            if direction.z < 0.1 || direction.xy().norm() > 1.2 * direction.z {
                continue;
            }
            let Some(exact) = camera.project(direction) else {
                continue;
            };
            let noise = Vector2::new(random.normal(), random.normal()) * (noise_px / 320.0);
            let seen = exact + noise;
            let fractions = Vector2::new(seen.x, seen.y / camera.height());
            if fractions.iter().all(|x| (0.0..1.0).contains(x)) {
                shown.push(place);
                points.push(fractions.cast::<f32>());
            }
        }

        // Keypoints are sorted by their scores; sort the points of the scene in the same way.
        let mut order: Vec<usize> = (0..shown.len()).collect();
        order.sort_by(|&a, &b| self.scores[shown[b]].total_cmp(&self.scores[shown[a]]));
        order.truncate(MAX_KEYPOINTS);
        let points: Vec<Vector2<f32>> = order.iter().map(|&place| points[place]).collect();
        let shown: Vec<usize> = order.iter().map(|&place| shown[place]).collect();
        let scores: Vec<f32> = shown.iter().map(|&place| self.scores[place]).collect();
        let descriptors = self.descriptors.select(ndarray::Axis(0), &shown);
        SceneView {
            keypoints: Keypoints::new(&points, &scores, descriptors.view()),
            shown,
        }
    }
}

/// A camera path of `count` poses near the origin that looks along z, moves in all directions and
/// turns by a few degrees.
pub fn camera_path(count: usize) -> Vec<Pose> {
    let pose = |at: usize| {
        let t = at as f64 / count as f64 * std::f64::consts::TAU;
        Pose::new(
            Vector3::new(1.0 * t.cos(), 0.4 * (2.0 * t).sin(), 0.5 * (3.0 * t).sin()),
            Vector3::new(
                0.08 * (2.0 * t).cos(),
                0.15 * t.sin(),
                0.1 * (3.0 * t).cos(),
            ),
        )
    };
    (0..count).map(pose).collect()
}

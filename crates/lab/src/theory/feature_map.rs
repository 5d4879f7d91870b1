//! Maps from poses to features, f: SE(3) → R^d.

use nalgebra::{DMatrix, DVector, Vector6};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use seese3_core::geometry::{Pose, Twist, exp};
use seese3_studio::{Camera, Scene, SuiteRoom, render};

/// Step of the central differences for constructed maps, meters and radians.
const STEP: f64 = 1e-4;
/// Step of the central differences for drawn maps, meters and radians: large compared with the
/// effect of pixel rounding.
const DRAWN_STEP: f64 = 0.02;

/// A map from a pose, `world_from_camera`, to a feature of shape (d,).
pub trait FeatureMap: Sync {
    /// f(g).
    fn feature(&self, pose: &Pose) -> DVector<f64>;

    /// The difference step of [`FeatureMap::jacobian`], meters and radians.
    fn step(&self) -> f64;

    /// J(g), shape (d, 6): the derivative of f(g exp(ξ)) with respect to ξ = (v, ω) at 0, by
    /// central differences.
    fn jacobian(&self, pose: &Pose) -> DMatrix<f64> {
        let h = self.step();
        let columns: Vec<DVector<f64>> = (0..6)
            .map(|component| {
                let mut xi = Vector6::zeros();
                xi[component] = h;
                let moved =
                    |xi: Vector6<f64>| self.feature(&(pose * exp(&Twist::from_vector(&xi))));

                (moved(xi) - moved(-xi)) / (2.0 * h)
            })
            .collect();

        DMatrix::from_columns(&columns)
    }
}

/// Sines of random linear combinations of position and rotation matrix: smooth, with rank 6 at all
/// checked poses.
#[derive(Debug, Clone)]
pub struct ConstructedMap {
    weights: DMatrix<f64>,
    phases: DVector<f64>,
}

impl ConstructedMap {
    /// A map to `dim` numbers. It depends on the first `coordinates` of twelve inputs: x, y, z and
    /// the nine entries of R.
    pub fn new(dim: usize, coordinates: usize, random: &mut ChaCha8Rng) -> Self {
        let weights = DMatrix::from_fn(dim, 12, |_, column| match column < coordinates {
            true => random.random_range(-0.8..0.8),
            false => 0.0,
        });
        Self {
            weights,
            phases: DVector::from_fn(dim, |_, _| random.random_range(0.0..std::f64::consts::TAU)),
        }
    }
}

impl FeatureMap for ConstructedMap {
    fn feature(&self, pose: &Pose) -> DVector<f64> {
        let rotation = pose.rotation.to_rotation_matrix();
        let numbers = DVector::from_iterator(
            12,
            pose.translation
                .vector
                .iter()
                .copied()
                .chain(rotation.matrix().iter().copied()),
        );

        (&self.weights * numbers + &self.phases).map(f64::sin)
    }

    fn step(&self) -> f64 {
        STEP
    }
}

/// A rendered studio room: the mean colors of 8 × 6 patches, 144 numbers from 0 to 1.
pub struct DrawnMap {
    scene: Scene,
    camera: Camera,
}

impl DrawnMap {
    /// Room `number` of a suite, and the pose in the middle of its camera path.
    pub fn new(seed: u64, number: u32) -> (Self, Pose) {
        let room = SuiteRoom::new(seed, number);
        let path = room.path(101);

        (
            Self {
                scene: room.scene,
                camera: Camera::sized(160, 120),
            },
            path[50],
        )
    }
}

/// Number of patches, horizontally and vertically.
const PATCHES: (usize, usize) = (8, 6);

impl FeatureMap for DrawnMap {
    fn feature(&self, pose: &Pose) -> DVector<f64> {
        let image = render(&self.scene, self.camera, pose);
        let across = image.width / PATCHES.0;
        let down = image.height / PATCHES.1;
        let mut feature = DVector::zeros(PATCHES.0 * PATCHES.1 * 3);

        for y in 0..image.height {
            for x in 0..image.width {
                let patch = (y / down) * PATCHES.0 + x / across;
                for (channel, &value) in image.pixel(x, y).iter().enumerate() {
                    feature[patch * 3 + channel] += f64::from(value);
                }
            }
        }

        feature / (255.0 * (across * down) as f64)
    }

    fn step(&self) -> f64 {
        DRAWN_STEP
    }
}

/// A twist of the given length in a uniformly random direction.
pub(super) fn twist_of_length(length: f64, random: &mut ChaCha8Rng) -> Twist {
    loop {
        let direction = Vector6::from_fn(|_, _| random.random_range(-1.0..1.0));
        let norm: f64 = direction.norm();

        // Reject points outside the unit ball; else directions to the cube's corners are favored.
        if (1e-3..=1.0).contains(&norm) {
            return Twist::from_vector(&(direction * (length / norm)));
        }
    }
}

/// A random pose at most `radius` from `center`, by the length of the twist between them.
pub(super) fn pose_near(center: &Pose, radius: f64, random: &mut ChaCha8Rng) -> Pose {
    // In six dimensions, the sixth root makes points uniform in the ball.
    let length = radius * random.random_range(0.0f64..1.0).powf(1.0 / 6.0);
    center * exp(&twist_of_length(length, random))
}

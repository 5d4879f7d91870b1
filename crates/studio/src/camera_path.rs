//! Paths of a calm hand-held camera, composed of slow oscillations: some return to earlier
//! positions, others lead through a room once.

use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::Scene;
use seese3_core::geometry::Pose;

/// One coordinate of the camera over time: a slow sine wave with the hand's tremor on top. Periods
/// are in frames.
struct Swing {
    amplitude: f64,
    period: f64,
    phase: f64,
    tremor: f64,
    tremor_phase: f64,
}

impl Swing {
    fn new(amplitude: f64, period: f64, random: &mut ChaCha8Rng) -> Self {
        let mut phase = || random.random_range(0.0..std::f64::consts::TAU);
        Self {
            amplitude,
            period,
            phase: phase(),
            tremor: 0.03 * amplitude,
            tremor_phase: phase(),
        }
    }

    fn at(&self, frame: f64) -> f64 {
        let turn = std::f64::consts::TAU * frame;
        self.amplitude * (turn / self.period + self.phase).sin()
            + self.tremor * (turn / 23.0 + self.tremor_phase).sin()
    }
}

/// `frame_count` poses in the middle of a scene, `world_from_camera`, meters, at about 30 frames
/// per second.
pub fn camera_path(scene: &Scene, frame_count: usize, seed: u64) -> Vec<Pose> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);

    // `Scene::new` draws from the generator's first stream: another one keeps the path of a seed
    // independent of the scene of the same seed.
    random.set_stream(1);
    let size = scene.size();

    // Amplitudes are in meters or radians, periods in frames. Every period varies by up to 8 %,
    // independently of the others.
    let mut swing = |amplitude: f64, period: f64| {
        let period = period * random.random_range(0.92..1.08);
        Swing::new(amplitude, period, &mut random)
    };
    let x = swing(size.x * 0.13, 420.0);

    let y = swing(size.y * 0.13, 310.0);
    let z = swing(0.09, 190.0);
    let yaw = swing(0.55, 530.0);
    let pitch = swing(0.09, 240.0);

    let roll = swing(0.05, 170.0);
    let heading = random.random_range(0.0..std::f64::consts::TAU);

    (0..frame_count)
        .map(|frame| {
            let t = frame as f64;

            // The camera is held about 1.5 m high near the middle of the room and looks slightly
            // down.
            let position = Vector3::new(
                size.x * 0.5 + x.at(t),
                size.y * 0.5 + y.at(t),
                1.5 + z.at(t),
            );

            let orientation = looking(heading + yaw.at(t), -0.12 + pitch.at(t), roll.at(t));
            posed(position, orientation)
        })
        .collect()
}

/// A path that circles in the middle of a room of `size`, meters, and looks about; it comes near
/// each position several times.
pub(super) fn around(size: Vector3<f64>, frame_count: usize, random: &mut ChaCha8Rng) -> Vec<Pose> {
    let mut swing = |amplitude: f64, period: f64| {
        let period = period * random.random_range(0.92..1.08);
        Swing::new(amplitude, period, random)
    };

    // Periods are shorter than in `camera_path`: a recording of a few hundred frames already
    // returns to where it has been.
    let x = swing((size.x * 0.09).min(0.45), 150.0);

    let y = swing((size.y * 0.09).min(0.4), 115.0);
    let z = swing(0.08, 130.0);
    let yaw = swing(0.45, 190.0);
    let pitch = swing(0.08, 140.0);

    let roll = swing(0.04, 120.0);
    let heading = random.random_range(0.0..std::f64::consts::TAU);
    let height = random.random_range(1.4..1.65);

    let pose = |frame: usize| {
        let t = frame as f64;
        let at = Vector3::new(
            size.x * 0.5 + x.at(t),
            size.y * 0.5 + y.at(t),
            height + z.at(t),
        );

        posed(
            at,
            looking(heading + yaw.at(t), -0.12 + pitch.at(t), roll.at(t)),
        )
    };

    (0..frame_count).map(pose).collect()
}

/// A straight path on the floor that is walked once, meters.
pub(super) struct Way {
    pub from: Vector3<f64>,
    pub to: Vector3<f64>,
    /// Amplitude of the oscillation to the sides.
    pub sway: f64,
    /// Angle by which the view turns from the first frame to the last, radians.
    pub sweep: f64,
}

/// The poses of a camera that walks a way once and looks ahead.
pub(super) fn along(way: &Way, frame_count: usize, random: &mut ChaCha8Rng) -> Vec<Pose> {
    let mut swing = |amplitude: f64, period: f64| {
        let period = period * random.random_range(0.85..1.15);
        Swing::new(amplitude, period, random)
    };
    let side = swing(way.sway, 210.0);

    let height = swing(0.06, 140.0);
    let yaw = swing(0.2, 230.0);
    let pitch = swing(0.07, 160.0);
    let roll = swing(0.04, 130.0);

    let level = random.random_range(1.4..1.65);
    let ahead = way.to - way.from;
    let heading = ahead.y.atan2(ahead.x);

    // The unit vector to the left of the walking direction.
    let aside = Vector3::new(-ahead.y, ahead.x, 0.0) / ahead.norm().max(1e-9);

    let last = frame_count.saturating_sub(1).max(1) as f64;
    let pose = |frame: usize| {
        let t = frame as f64;
        let part = frame as f64 / last;
        let mut at = way.from + ahead * part + aside * side.at(t);
        at.z = level + height.at(t);

        // The sweep is centered: halfway along, the camera looks ahead, apart from the yaw
        // oscillation.
        let turned = heading + way.sweep * (part - 0.5) + yaw.at(t);
        posed(at, looking(turned, -0.1 + pitch.at(t), roll.at(t)))
    };

    (0..frame_count).map(pose).collect()
}

pub(super) fn posed(at: Vector3<f64>, orientation: Rotation3<f64>) -> Pose {
    Isometry3::from_parts(
        Translation3::from(at),
        UnitQuaternion::from_rotation_matrix(&orientation),
    )
}

/// `world_from_camera` of a camera that looks along `yaw` from the x axis, `pitch` above the
/// horizon, tilted by `roll` about its own view; radians.
pub(super) fn looking(yaw: f64, pitch: f64, roll: f64) -> Rotation3<f64> {
    let forward = Vector3::new(
        yaw.cos() * pitch.cos(),
        yaw.sin() * pitch.cos(),
        pitch.sin(),
    );

    let right = Vector3::new(yaw.sin(), -yaw.cos(), 0.0);
    let down = forward.cross(&right);

    // The columns are the camera's axes in world coordinates: x right, y down, z forward.
    let level = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[right, down, forward]));

    level * Rotation3::from_axis_angle(&Vector3::z_axis(), roll)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: the crate's camera axes. Looking along world x, the image's right is world −y and
    /// its down world −z.
    #[test]
    fn a_level_camera_has_y_down_and_z_forward() {
        let rotation = looking(0.0, 0.0, 0.0);
        assert!((rotation * Vector3::z() - Vector3::x()).norm() < 1e-12);
        assert!((rotation * Vector3::y() + Vector3::z()).norm() < 1e-12);
        assert!((rotation * Vector3::x() + Vector3::y()).norm() < 1e-12);

        assert!((rotation.matrix().determinant() - 1.0).abs() < 1e-12);
    }
}

//! Theorem 7: image flow from rotation does not depend on depth, and flow from translation is
//! proportional to 1/Z. Scaling the scene and the translation together leaves the image unchanged.

use nalgebra::{Matrix2x6, Point3, Vector2, Vector3, Vector6};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::feature_map::twist_of_length;
use super::{Bound, Check, DrawnMap, Effort, FeatureMap};
use seese3_core::geometry::{Pose, Twist, exp};

/// Focal lengths of a camera, pixels. Image coordinates are relative to the principal point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pinhole {
    /// Along u.
    pub fx: f64,
    /// Along v.
    pub fy: f64,
}

impl Pinhole {
    fn project(self, point: &Point3<f64>) -> Vector2<f64> {
        Vector2::new(self.fx * point.x / point.z, self.fy * point.y / point.z)
    }

    fn point(self, at: Vector2<f64>, depth: f64) -> Point3<f64> {
        Point3::new(at.x * depth / self.fx, at.y * depth / self.fy, depth)
    }
}

/// The Jacobian of the image flow as printed in the paper, with respect to (v, ω): pixels per meter
/// and pixels per radian.
///
/// It is the negative of the image flow of a camera that moves by the body twist.
///
/// Source: SeeSE3, theorem 7a and b.
pub fn flow_jacobian(camera: Pinhole, at: Vector2<f64>, depth: f64) -> Matrix2x6<f64> {
    let Pinhole { fx, fy } = camera;
    let u = at.x;
    let v = at.y;

    #[rustfmt::skip]
    let jacobian = Matrix2x6::new(
        fx / depth, 0.0, -u / depth, -u * v / fy, fx + u * u / fx, -fx * v / fy,
        0.0, fy / depth, -v / depth, -fy - v * v / fy, u * v / fx, fy * u / fx,
    );

    jacobian
}

/// The image position of a pixel's scene point after the camera has moved by a twist.
fn moved(camera: Pinhole, at: Vector2<f64>, depth: f64, twist: Twist) -> Vector2<f64> {
    camera.project(&(exp(&twist).inverse() * camera.point(at, depth)))
}

/// The image flow of a camera that moves by a body twist, by central differences.
fn measured(camera: Pinhole, at: Vector2<f64>, depth: f64) -> Matrix2x6<f64> {
    const H: f64 = 1e-5;

    let columns: [Vector2<f64>; 6] = std::array::from_fn(|component| {
        let mut xi = Vector6::zeros();
        xi[component] = H;
        let end = |xi: Vector6<f64>| moved(camera, at, depth, Twist::from_vector(&xi));
        (end(xi) - end(-xi)) / (2.0 * H)
    });

    Matrix2x6::from_columns(&columns)
}

pub(super) fn checks(effort: Effort, random: &mut ChaCha8Rng) -> Vec<Check> {
    let mut sign = 0.0f64;
    let mut turning = 0.0f64;
    let mut moving = 0.0f64;
    let mut scaled = 0.0f64;

    for _ in 0..effort.samples {
        let camera = Pinhole {
            fx: random.random_range(200.0..600.0),
            fy: random.random_range(200.0..600.0),
        };

        let at = Vector2::new(
            random.random_range(-300.0..300.0),
            random.random_range(-200.0..200.0),
        );

        let near = random.random_range(0.5..2.0);
        let far = random.random_range(2.0..10.0);
        let [near_flow, far_flow] = [near, far].map(|depth| measured(camera, at, depth));
        let largest = near_flow.amax();

        // 7: the printed Jacobian is the negative of the camera's flow, so their sum must be zero.
        sign = sign.max((near_flow + flow_jacobian(camera, at, near)).amax() / largest);

        // 7a and b: the rotation columns must be equal at both depths, and so must the translation
        // columns multiplied by Z.
        let part =
            |flow: &Matrix2x6<f64>, first: usize| flow.fixed_columns::<3>(first).into_owned();
        turning = turning.max((part(&near_flow, 3) - part(&far_flow, 3)).amax() / largest);
        moving =
            moving.max((part(&near_flow, 0) * near - part(&far_flow, 0) * far).amax() / largest);

        // 7d: scaling translation and depth by the same factor must not move the image point.
        let twist = twist_of_length(0.1, random);
        let factor = random.random_range(0.2..5.0);
        let larger = Twist {
            linear: twist.linear * factor,
            ..twist
        };
        let shift = moved(camera, at, near * factor, larger) - moved(camera, at, near, twist);

        scaled = scaled.max(shift.norm());
    }

    let check = |theorem, what, measured, bound| Check {
        theorem,
        what,
        measured,
        bound,
    };

    let mut found = vec![
        check(
            "7",
            "printed flow plus measured flow, relative: printed = −(camera's)",
            sign,
            Bound::AtMost(1e-7),
        ),
        check(
            "7a",
            "turning: change of the flow with depth, relative",
            turning,
            Bound::AtMost(1e-7),
        ),
        check(
            "7b",
            "moving: change of Z · flow with depth, relative",
            moving,
            Bound::AtMost(1e-7),
        ),
        check(
            "7d",
            "(v, Z) → (λv, λZ): change of the image, pixels",
            scaled,
            Bound::AtMost(1e-9),
        ),
    ];

    found.extend(drawn_variation(effort));
    found
}

/// Relative change of the ω half and the v half of a drawn room's Jacobian between two poses 0.2 m
/// apart; mean over six rooms.
fn drawn_variation(effort: Effort) -> [Check; 2] {
    const PLACES: u32 = 6;

    let share = |first: usize| {
        let mut shares = Vec::new();
        for number in 0..PLACES {
            let (room, pose) = DrawnMap::new(effort.seed, number);
            let aside = pose
                * Pose::from_parts(
                    Vector3::new(0.15, 0.0, 0.15).into(),
                    nalgebra::UnitQuaternion::identity(),
                );

            let part = |pose: &Pose| room.jacobian(pose).columns(first, 3).into_owned();
            let here = part(&pose);
            let there = part(&aside);
            shares.push((&there - &here).norm() / here.norm());
        }

        seese3_core::statistics::mean(&shares)
    };

    let check = |what, measured| Check {
        theorem: "7c",
        what,
        measured,
        bound: Bound::Free,
    };

    [
        check("drawn rooms: relative change of J_ω over 0.2 m", share(3)),
        check("drawn rooms: relative change of J_v over 0.2 m", share(0)),
    ]
}

//! Trajectories in text formats that other programs read: TUM and KITTI.

use std::fmt::Write;

use seese3_core::geometry::Pose;

/// TUM format: one line per frame, "timestamp tx ty tz qx qy qz qw", seconds and meters,
/// `world_from_camera`.
///
/// There must be as many timestamps as poses.
pub fn tum_trajectory(timestamps_ns: &[i64], poses: &[Pose]) -> String {
    let mut text = String::from("# timestamp tx ty tz qx qy qz qw\n");
    for (time, pose) in timestamps_ns.iter().zip(poses) {
        let t = pose.translation.vector;
        let q = pose.rotation.coords;

        // The sign is written separately, since the whole seconds of −0.5 s are zero and have none.
        // Integers keep the nanoseconds exact; a 64-bit float of seconds would round them.
        let sign = if *time < 0 { "-" } else { "" };
        let time = time.unsigned_abs();
        let seconds = time / 1_000_000_000;

        let rest = time % 1_000_000_000;

        // Writing to a string cannot fail.
        let _ = writeln!(
            text,
            "{sign}{seconds}.{rest:09} {} {} {} {} {} {} {}",
            t.x, t.y, t.z, q.x, q.y, q.z, q.w
        );
    }

    text
}

/// KITTI format: one line per frame, the first three rows of `world_from_camera` as a matrix, row
/// by row, meters.
pub fn kitti_trajectory(poses: &[Pose]) -> String {
    let mut text = String::new();
    for pose in poses {
        let matrix = pose.to_homogeneous();
        let numbers: Vec<String> = (0..12)
            .map(|i| matrix[(i / 4, i % 4)].to_string())
            .collect();

        // Writing to a string cannot fail.
        let _ = writeln!(text, "{}", numbers.join(" "));
    }

    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Translation3, UnitQuaternion, Vector3};

    /// Oracle: the two formats by hand, for a quarter turn about z.
    #[test]
    fn a_quarter_turn_is_written_as_the_formats_say() {
        let half = std::f64::consts::FRAC_PI_2;
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), half);
        let pose = Pose::from_parts(Translation3::new(1.0, -2.0, 0.5), turn);
        let text = tum_trajectory(&[1_700_000_000_000_000_001], &[pose]);
        let line = text.lines().nth(1).unwrap();

        assert!(
            line.starts_with("1700000000.000000001 1 -2 0.5 0 0 0.7071"),
            "{line}"
        );

        let kitti = kitti_trajectory(&[pose]);
        let numbers: Vec<f64> = kitti
            .split_whitespace()
            .map(|word| word.parse().unwrap())
            .collect();

        let expected = [0.0, -1.0, 0.0, 1.0, 1.0, 0.0, 0.0, -2.0, 0.0, 0.0, 1.0, 0.5];
        assert!(
            numbers
                .iter()
                .zip(expected)
                .all(|(a, b)| (a - b).abs() < 1e-15)
                && numbers.len() == 12,
            "{kitti}"
        );

        assert!(tum_trajectory(&[-500_000_000], &[pose]).contains("\n-0.500000000 "));
    }
}

//! SE(3) against mpmath at 60 digits. Tolerance 1e-12 · max(1, |v|), as the oracle's README gives
//! it.

use nalgebra::{Matrix3, Matrix4};
use seese3_core::geometry::{
    Pose, Twist, adjoint, body_twist, exp, left_jacobian_inverse, log, nearest_rotation,
};

use seese3_testing::{Tensors, golden, json, near, npy, pose, shared};

fn twist(row: &[f64]) -> Twist {
    Twist::from_vector(&nalgebra::Vector6::from_column_slice(row))
}

fn matrix(pose: &Pose) -> Vec<f64> {
    pose.to_homogeneous().transpose().iter().copied().collect()
}

#[track_caller]
fn same(what: &str, actual: &[f64], expected: &[f64], scale: f64) {
    let worst = actual
        .iter()
        .zip(expected)
        .map(|(a, b)| (a - b).abs())
        .fold(0.0, f64::max);

    assert!(
        actual.len() == expected.len() && worst <= 1e-12 * scale.max(1.0),
        "{what}: off by {worst}"
    );
}

/// Rows of 4×4 matrices come back as sixteen numbers.
fn sixteens(tensors: &Tensors, name: &str) -> Vec<Vec<f64>> {
    let rows = tensors.rows(name);
    rows.iter()
        .copied()
        .collect::<Vec<_>>()
        .chunks(16)
        .map(<[f64]>::to_vec)
        .collect()
}

/// Oracle: mpmath's matrix exponential and logarithm at 60 digits, tiny, moderate, near π, at π and
/// beyond.
#[test]
fn exp_log_and_adjoint_match_mpmath() {
    let folder = golden().join("se3");
    let tensors = Tensors::open(&folder.join("expected.safetensors"));
    let categories = json(&folder.join("expected.json"))["category"].clone();
    let twists = npy::<f64>(&folder.join("twists.npy"))
        .into_dimensionality::<ndarray::Ix2>()
        .unwrap();

    let expected_exp = sixteens(&tensors, "exp");
    let expected_log = tensors.rows("log_of_exp");
    let expected_adjoint: Vec<f64> = tensors.rows("adjoint").iter().copied().collect();

    assert_eq!(twists.nrows(), 188);

    for (row, xi) in twists.outer_iter().enumerate() {
        let category = categories[row].as_str().unwrap();
        let xi = twist(&xi.to_vec());
        let scale = xi.linear.norm();
        let what = format!("row {row}, {category}");

        same(
            &format!("exp of {what}"),
            &matrix(&exp(&xi)),
            &expected_exp[row],
            scale,
        );

        let ad = adjoint(&exp(&xi)).transpose();
        same(
            &format!("adjoint of {what}"),
            ad.as_slice(),
            &expected_adjoint[row * 36..][..36],
            scale,
        );

        let found = log(&pose(&expected_exp[row]));
        if category.starts_with("exactly_pi") {
            // The sign of ω is free at π: the logarithm must be as long, and lead back to the
            // motion.
            near(
                &format!("angle of {what}"),
                found.angular.norm(),
                std::f64::consts::PI,
                1e-12,
            );

            same(
                &format!("exp of log of {what}"),
                &matrix(&exp(&found)),
                &expected_exp[row],
                scale,
            );
        } else {
            same(
                &format!("log of {what}"),
                found.to_vector().as_slice(),
                &expected_log.row(row).to_vec(),
                scale,
            );
        }
    }
}

/// Oracle: ad / (1 − e^(−ad)) of matrices at 60 digits, mpmath; J_r⁻¹(ξ) = J_l⁻¹(−ξ).
#[test]
fn the_inverse_jacobian_matches_mpmath() {
    let folder = golden().join("se3");
    let twists = npy::<f64>(&folder.join("twists.npy"))
        .into_dimensionality::<ndarray::Ix2>()
        .unwrap();

    let expected: Vec<f64> = Tensors::open(&folder.join("expected.safetensors"))
        .rows("jr_inv")
        .iter()
        .copied()
        .collect();

    let mut compared = 0;
    for (row, xi) in twists.outer_iter().enumerate() {
        let xi = twist(&xi.to_vec());
        if xi.angular.norm() > std::f64::consts::PI {
            continue;
        }

        compared += 1;

        let backwards = Twist {
            linear: -xi.linear,
            angular: -xi.angular,
        };
        let found = left_jacobian_inverse(&backwards).transpose();

        same(
            &format!("row {row}"),
            found.as_slice(),
            &expected[row * 36..][..36],
            10.0 * xi.linear.norm(),
        );
    }

    assert!(compared > 100);
}

/// Oracle: mpmath, log(P₁⁻¹P₂) of sixty pairs.
#[test]
fn body_twists_match_mpmath() {
    let tensors = Tensors::open(&golden().join("se3/expected.safetensors"));
    let poses = sixteens(&tensors, "exp");
    let expected = tensors.rows("body_relative_log");

    let row_of = |name: &str| {
        tensors
            .rows(name)
            .iter()
            .map(|&row| row as usize)
            .collect::<Vec<_>>()
    };

    let composed = sixteens(&tensors, "compose");
    for (pair, (i, j)) in row_of("pair_i")
        .into_iter()
        .zip(row_of("pair_j"))
        .enumerate()
    {
        let a = pose(&poses[i]);
        let b = pose(&poses[j]);
        let scale = a.translation.vector.norm().max(b.translation.vector.norm());

        same(
            &format!("compose {pair}"),
            &matrix(&(a * b)),
            &composed[pair],
            scale,
        );

        let found = body_twist(&a, &b);
        if found.is_unique_logarithm() {
            same(
                &format!("body twist {pair}"),
                found.to_vector().as_slice(),
                &expected.row(pair).to_vec(),
                scale,
            );
        }
    }
}

/// Oracle: NumPy's SVD polar factor of measured rotations that are 3.8e-4 off SO(3).
#[test]
#[ignore = "needs the folder of large inputs: SEESE3_SHARED or ../shared"]
fn published_rotations_project_to_so3() {
    let folder = shared().join("oracles");

    let raw = npy::<f64>(&folder.join("rooms/real/poses_raw.npy"));
    let projected = npy::<f64>(&folder.join("rooms/real/poses.npy"));
    let mut deviation: f64 = 0.0;
    for (raw, expected) in raw.outer_iter().zip(projected.outer_iter()) {
        let block = |m: ndarray::ArrayViewD<'_, f64>| {
            Matrix4::from_row_slice(&m.iter().copied().collect::<Vec<_>>())
                .fixed_view::<3, 3>(0, 0)
                .into_owned()
        };
        let found = nearest_rotation(&block(raw)).unwrap();

        let expected: Matrix3<f64> = block(expected);
        assert!((found.rotation.matrix() - expected).abs().max() < 1e-12);

        deviation = deviation.max(found.deviation);
    }

    let stated =
        &json(&folder.join("rooms/expected.json"))["real"]["raw_rotation_orthonormality_error"];

    near(
        "worst deviation",
        deviation,
        seese3_testing::number(stated),
        1e-12,
    );
}

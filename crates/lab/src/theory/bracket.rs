//! Theorem 5c: the residual error of perfectly unrolled features comes from the group itself. It is
//! (J_r⁻¹(X) − I) ξ, with leading term ½\[X, ξ\].

use nalgebra::{Matrix6, SymmetricEigen, Vector6};
use rand_chacha::ChaCha8Rng;

use super::feature_map::twist_of_length;
use super::{Bound, Check, Effort};
use seese3_core::geometry::{Twist, exp, left_jacobian_inverse, log};

/// sup ‖\[X, ξ\]‖ over unit X and ξ in the Euclidean norm of (v, ω): 2/√3.
pub const C_LIE: f64 = 1.154_700_538_379_251_5;

/// \[X, Y\] = ad_X Y in (v, ω): (ω_X × v_Y − ω_Y × v_X, ω_X × ω_Y).
pub fn bracket(x: Twist, y: Twist) -> Twist {
    Twist {
        linear: x.angular.cross(&y.linear) - y.angular.cross(&x.linear),
        angular: x.angular.cross(&y.angular),
    }
}

pub(super) fn checks(effort: Effort, random: &mut ChaCha8Rng) -> Vec<Check> {
    let mut exact = 0.0f64;
    let mut leading = 0.0f64;
    let mut over = 0.0f64;
    for _ in 0..effort.samples {
        let x = twist_of_length(0.7, random);
        let small = twist_of_length(1e-5, random);

        // For small ξ, the error of unrolling equals the residual (J_r⁻¹(X) − I) ξ to first order.
        exact = exact.max(
            (unrolled_error(x, small) - residual(x, small)).norm() / residual(x, small).norm(),
        );

        let near = twist_of_length(1e-2, random);
        let xi = twist_of_length(1.0, random);

        // For small X, the residual equals ½[X, ξ] to first order.
        let half = bracket(near, xi).to_vector() * 0.5;
        leading = leading.max((residual(near, xi) - half).norm() / half.norm());

        // Hence it is at most ½ C_Lie ‖X‖ ‖ξ‖, to first order in X.
        over = over.max(residual(near, xi).norm() / (0.5 * C_LIE * near.norm() * xi.norm()));
    }

    // Two special cases: translations commute, and a pure translation leaves no rotation error.
    let still = |xi: Twist| Twist {
        angular: nalgebra::Vector3::zeros(),
        ..xi
    };

    let [a, b] = [0, 1].map(|_| twist_of_length(1.0, random));

    let check = |what, measured, bound| Check {
        theorem: "5c",
        what,
        measured,
        bound,
    };

    vec![
        check(
            "log(g₂) − log(g₁) − ξ against (J_r⁻¹(X) − I) ξ, relative, ‖ξ‖ = 1e-5",
            exact,
            Bound::AtMost(1e-3),
        ),
        check(
            "that against ½[X, ξ], relative, ‖X‖ = 0.01",
            leading,
            Bound::AtMost(0.05),
        ),
        check(
            "largest ‖[X, ξ]‖ of unit twists, by ascent",
            steepest(effort, random),
            Bound::Equals(C_LIE, 1e-9),
        ),
        check(
            "largest residual over ½ C_Lie R ‖ξ‖, R = 0.01",
            over,
            Bound::AtMost(1.01),
        ),
        check(
            "two translations: the residual",
            residual(still(a), still(b)).norm(),
            Bound::AtMost(1e-15),
        ),
        check(
            "a translation from a turned pose: the residual's rotation",
            Twist::from_vector(&residual(a, still(b))).angular.norm(),
            Bound::AtMost(1e-15),
        ),
    ]
}

/// The error of unrolling a pose by the logarithm: log(g₂) − log(g₁) − log(g₁⁻¹g₂), with
/// g₁ = exp(X) and g₂ = g₁ exp(ξ).
fn unrolled_error(x: Twist, xi: Twist) -> Vector6<f64> {
    log(&(exp(&x) * exp(&xi))).to_vector() - x.to_vector() - xi.to_vector()
}

/// (J_r⁻¹(X) − I) ξ.
fn residual(x: Twist, xi: Twist) -> Vector6<f64> {
    let backwards = Twist::from_vector(&-x.to_vector());
    (left_jacobian_inverse(&backwards) - Matrix6::identity()) * xi.to_vector()
}

/// sup ‖\[X, ξ\]‖ over unit X and ξ, by alternating maximization from many random starts.
fn steepest(effort: Effort, random: &mut ChaCha8Rng) -> f64 {
    let ad = |x: &Vector6<f64>| {
        let columns: [Vector6<f64>; 6] = std::array::from_fn(|c| {
            let mut unit = Vector6::zeros();
            unit[c] = 1.0;
            bracket(Twist::from_vector(x), Twist::from_vector(&unit)).to_vector()
        });
        Matrix6::from_columns(&columns)
    };

    let mut best = 0.0f64;
    for _ in 0..effort.samples.min(100) {
        let mut x = twist_of_length(1.0, random).to_vector();
        for _ in 0..200 {
            let matrix = ad(&x);

            // For fixed X, the best unit ξ is the right singular vector of ad_X with the largest
            // singular value.
            let eigen = SymmetricEigen::new(matrix.transpose() * matrix);
            let xi = eigen
                .eigenvectors
                .column(eigen.eigenvalues.imax())
                .normalize();
            best = best.max((matrix * xi).norm());

            // ‖[X, ξ]‖ = ‖[ξ, X]‖, so swap the roles: ξ becomes the next X.
            x = xi;
        }
    }

    best
}

#[cfg(test)]
mod tests {
    use super::*;
    use seese3_core::geometry::adjoint;

    /// Oracle: the derivative of Ad(exp(tX)) at 0 is ad X.
    #[test]
    fn the_bracket_is_the_derivative_of_the_adjoint() {
        let x = Twist {
            linear: [0.3, -0.1, 0.7].into(),
            angular: [0.2, 0.5, -0.4].into(),
        };

        let y = Twist {
            linear: [-0.6, 0.2, 0.1].into(),
            angular: [0.9, 0.3, 0.2].into(),
        };

        let h = 1e-5;
        let moved =
            |h: f64| adjoint(&exp(&Twist::from_vector(&(x.to_vector() * h)))) * y.to_vector();
        let slope = (moved(h) - moved(-h)) / (2.0 * h);

        assert!((slope - bracket(x, y).to_vector()).norm() < 1e-9);
    }
}

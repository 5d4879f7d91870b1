//! Precision of the networks: f32 for training, f64 for inference and for comparison with reference
//! implementations.

/// 1/√(2π).
const DENSITY_AT_ZERO: f64 = 0.398_942_280_401_432_7;

/// A floating-point type of network parameters: f32 or f64.
pub trait Real: ndarray::NdFloat + Default {
    /// Φ(x), the cumulative distribution function of the standard normal distribution.
    fn normal_cumulative(self) -> Self;
    /// The density of the standard normal distribution.
    fn normal_density(self) -> Self;
    /// The nearest value to an f64.
    fn of(value: f64) -> Self;
    /// This value as f64.
    fn f64(self) -> f64;
}

/// Training evaluates these tens of thousands of times per step. They have no calls, so that the
/// compiler can vectorize them.
impl Real for f32 {
    /// Relative error at most 5e-7 + 6e-8 x²; the second term is from the rounding of x².
    #[inline]
    fn normal_cumulative(self) -> Self {
        // Φ(−|x|) = exp(−x²/2) t P(t) with t = 1/(1 + c|x|), the form of Hastings (Abramowitz and
        // Stegun, 26.2.17). c and P have the least relative error, 9.4e-8 in f64:
        // tests/golden/normal_cumulative.py chooses them.
        const C: f32 = 0.305;
        const P: [f32; 8] = [
            0.121_639_73,
            0.122_466_83,
            0.103_420_75,
            0.121_022_05,
            -0.037_977_53,
            0.185_717_66,
            -0.152_988_75,
            0.036_699_29,
        ];
        let t = 1.0 / (1.0 + C * self.abs());
        let polynomial = P.iter().rev().fold(0.0, |sum, &p| sum * t + p);
        let tail = exp_of_negative(-0.5 * self * self) * t * polynomial;

        if self < 0.0 { tail } else { 1.0 - tail }
    }
    #[inline]
    fn normal_density(self) -> Self {
        DENSITY_AT_ZERO as Self * exp_of_negative(-0.5 * self * self)
    }
    fn of(value: f64) -> Self {
        value as f32
    }
    fn f64(self) -> f64 {
        f64::from(self)
    }
}

impl Real for f64 {
    fn normal_cumulative(self) -> Self {
        0.5 * (1.0 + libm::erf(self * std::f64::consts::FRAC_1_SQRT_2))
    }
    fn normal_density(self) -> Self {
        DENSITY_AT_ZERO * (-0.5 * self * self).exp()
    }
    fn of(value: f64) -> Self {
        value
    }
    fn f64(self) -> f64 {
        self
    }
}

/// exp(x) of x ≤ 0; exp(−87) below −87, NaN of NaN.
#[inline]
fn exp_of_negative(x: f32) -> f32 {
    /// Added to a number below 2²², 1.5 · 2²³ rounds it to an integer, which is in the low bits.
    const ROUNDING: f32 = 12_582_912.0;
    /// ln 2 in two parts; k times the first is exact for |k| ≤ 128.
    const LN_2: [f32; 2] = [0.693_359_4, -0.000_212_194_44];
    // 1/n! for n = 7, 6, …, 0; |r| ≤ ln(2)/2.
    const TAYLOR: [f32; 8] = [
        1.0 / 5040.0,
        1.0 / 720.0,
        1.0 / 120.0,
        1.0 / 24.0,
        1.0 / 6.0,
        0.5,
        1.0,
        1.0,
    ];

    // exp(x) = 2ᵏ exp(r) with x = k ln 2 + r.
    let x = if x < -87.0 { -87.0 } else { x };
    let shifted = x * std::f32::consts::LOG2_E + ROUNDING;
    let k = shifted - ROUNDING;
    let r = (x - k * LN_2[0]) - k * LN_2[1];
    let exp_r = TAYLOR.iter().fold(0.0, |sum, &c| sum * r + c);

    // The exponent is in the bits from 23 on.
    f32::from_bits(exp_r.to_bits().wrapping_add(shifted.to_bits() << 23))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: libm's erf and exp in f64.
    #[test]
    fn the_normal_distribution_in_f32_is_that_in_f64() {
        for step in -100_000..=100_000 {
            let x = step as f32 * 1e-4;
            let wide = f64::from(x);
            let [cumulative, density] = [
                libm::erfc(-wide * std::f64::consts::FRAC_1_SQRT_2) / 2.0,
                (-wide * wide / 2.0).exp() / (2.0 * std::f64::consts::PI).sqrt(),
            ];
            // The square of x is rounded before it is an exponent.
            let rounding = 5e-7 + wide * wide * 6e-8;
            let off = |value: f32, expected: f64| (f64::from(value) / expected - 1.0).abs();

            assert!(off(x.normal_cumulative(), cumulative) < rounding, "Φ({x})");
            assert!(off(x.normal_density(), density) < rounding, "p({x})");
        }
    }

    /// Oracle: the limits of the distribution; a loss that is not finite has to show.
    #[test]
    fn far_values_have_the_limits_and_nan_stays() {
        for x in [-1e30_f32, -200.0, -14.0] {
            assert!((0.0..1e-37).contains(&x.normal_cumulative()), "{x}");
            assert!((0.0..1e-37).contains(&x.normal_density()), "{x}");
            assert_eq!((-x).normal_cumulative(), 1.0);
        }
        assert!(f32::NAN.normal_cumulative().is_nan() && f32::NAN.normal_density().is_nan());
    }
}

//! Precision of the networks: f32 for training, f64 for inference and for comparison with reference
//! implementations.

/// A floating-point type of network parameters: f32 or f64.
pub trait Real: ndarray::NdFloat + Default {
    /// The error function.
    fn erf(self) -> Self;
    /// The nearest value to an f64.
    fn of(value: f64) -> Self;
    /// This value as f64.
    fn f64(self) -> f64;
}

impl Real for f32 {
    fn erf(self) -> Self {
        libm::erff(self)
    }
    fn of(value: f64) -> Self {
        value as f32
    }
    fn f64(self) -> f64 {
        f64::from(self)
    }
}

impl Real for f64 {
    fn erf(self) -> Self {
        libm::erf(self)
    }
    fn of(value: f64) -> Self {
        value
    }
    fn f64(self) -> f64 {
        self
    }
}

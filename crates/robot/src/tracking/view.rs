//! Views, and the motion between two views.

use ndarray::Array1;

use seese3_core::adapter::{Adapter, Error};
use seese3_core::geometry::Twist;

/// A camera observation without a pose.
#[derive(Debug, Clone, PartialEq)]
pub enum View {
    /// A raw feature of the adapter's source, shape (d,).
    Feature(Vec<f32>),
    /// A latent of the adapter, shape (k,).
    Latent(Vec<f64>),
}

impl View {
    /// The view's latent, shape (k,).
    ///
    /// # Errors
    /// [`Error`] if the feature or the latent does not fit the adapter.
    pub fn latent(&self, adapter: &Adapter) -> Result<Array1<f64>, Error> {
        match self {
            Self::Feature(feature) => adapter.embed_one(feature),
            Self::Latent(latent) => {
                adapter.check_latent(latent)?;
                Ok(Array1::from(latent.clone()))
            }
        }
    }
}

/// Estimates the motion from the first view to the second, in the first camera's body frame.
///
/// # Errors
/// [`Error`] if a view does not fit the adapter.
///
/// Source: SeeSE3, Sec. A.2.
pub fn motion(adapter: &Adapter, first: &View, second: &View) -> Result<Twist, Error> {
    let first = first.latent(adapter)?;
    let second = second.latent(adapter)?;

    Ok(adapter.motion(first.view(), second.view()))
}

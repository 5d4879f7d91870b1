//! Steppers: methods that turn a motion into a step in latent space.

use ndarray::{Array1, Array2, ArrayView1, ArrayView2, s};
use strum::VariantArray;

use super::Error;
use crate::adapter::{Adapter, CorrectorKind, Reading};
use crate::geometry::{Pose, Twist, body_twist};
use crate::ridge::{Intercept, Ridge};
use crate::splits::Pair;

/// Ridge penalty α of a refit: scikit-learn's default.
const REFIT_ALPHA: f64 = 1.0;

/// A method that turns a motion into a latent step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StepKind {
    /// W⁺ΔP, as in the paper.
    InversePoincare(Reading),
    /// A corrector of the adapter.
    Corrector(CorrectorKind),
    /// B ΔP, with B fitted by ridge regression in the room itself, φ frozen.
    Refit(Refit),
}

/// A variant of the refit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Refit {
    /// Whether motions are z-scored by the adapter's μ and σ, which changes the effect of the
    /// penalty.
    pub z_scored: bool,
    /// Whether an intercept is fitted; with one, zero motion moves the latent.
    pub intercept: bool,
    /// Whether the refit is fitted on the test pairs: a leak, and probably the paper's protocol.
    /// Otherwise it is fitted on the room's training pairs.
    pub in_sample: bool,
}

impl StepKind {
    /// All methods, inverse Poincaré first.
    pub fn all() -> Vec<Self> {
        let readings = Reading::VARIANTS.iter().copied().map(Self::InversePoincare);
        let correctors = CorrectorKind::ALL.map(Self::Corrector);

        let refit = |bits: u8| Refit {
            z_scored: bits & 2 != 0,
            intercept: bits & 4 != 0,
            in_sample: bits & 1 != 0,
        };

        readings
            .into_iter()
            .chain(correctors)
            .chain((0..8).map(|bits| Self::Refit(refit(bits))))
            .collect()
    }

    /// Name in tables, JSON and on the wire.
    pub fn name(self) -> String {
        match self {
            Self::InversePoincare(reading) => format!("inverse-poincare-{reading}"),
            Self::Corrector(kind) => format!("corrector-{}", kind.name()),
            Self::Refit(refit) => {
                let z_scored = if refit.z_scored { "-z-scored" } else { "" };
                let intercept = if refit.intercept { "-intercept" } else { "" };
                let in_sample = if refit.in_sample { "-in-sample" } else { "" };
                format!("ridge-refit{z_scored}{intercept}{in_sample}")
            }
        }
    }
}

/// Data of one room for fitting a refit.
#[derive(Debug, Clone, Copy)]
pub struct RefitData<'a> {
    /// Latents, one row per frame.
    pub latents: ArrayView2<'a, f64>,
    /// `world_from_camera`, one per frame.
    pub poses: &'a [Pose],
    /// Training pairs, for a refit that is not in-sample.
    pub train: &'a [Pair],
    /// Test pairs, for an in-sample refit.
    pub test: &'a [Pair],
}

/// A fitted stepper.
#[derive(Debug, Clone)]
pub enum Stepper {
    /// W⁺ΔP.
    InversePoincare(Reading),
    /// A corrector.
    Corrector(CorrectorKind),
    /// A fitted linear map.
    Refit {
        /// The map from motions to steps of the latent coordinates.
        fit: Ridge,
        /// Whether motions are z-scored first.
        z_scored: bool,
    },
}

impl Stepper {
    /// Builds a stepper; fits a refit.
    ///
    /// # Errors
    /// [`Error::Adapter`] when the adapter does not have the corrector, [`Error::Refit`] without
    /// pairs for the fit.
    pub fn new(kind: StepKind, adapter: &Adapter, ground: RefitData<'_>) -> Result<Self, Error> {
        match kind {
            StepKind::InversePoincare(reading) => Ok(Self::InversePoincare(reading)),
            StepKind::Corrector(kind) => {
                // Trial step: fail now if the adapter does not have this corrector, not during a
                // walk.
                let still = Array1::zeros(adapter.latent_dim());
                adapter.corrected_step(kind, still.view(), Twist::default())?;
                Ok(Self::Corrector(kind))
            }
            StepKind::Refit(Refit {
                z_scored,
                intercept,
                in_sample,
            }) => {
                let pairs = if in_sample { ground.test } else { ground.train };

                let intercept = if intercept {
                    Intercept::Fitted
                } else {
                    Intercept::None
                };

                // Reverse of the adapter's training: motions are the inputs, latent differences the
                // targets.
                let twists: Vec<Array1<f64>> = pairs
                    .iter()
                    .map(|pair| {
                        body_twist(
                            &ground.poses[pair.source.row()],
                            &ground.poses[pair.target.row()],
                        )
                    })
                    .map(|twist| input(adapter, twist, z_scored, 1.0))
                    .collect();

                let inputs = Array2::from_shape_fn((twists.len(), 6), |at| twists[at.0][at.1]);

                // Only coordinates are fitted, not the gate weights of a mixture.
                let steps = Array2::from_shape_fn(
                    (pairs.len(), adapter.coordinate_count()),
                    |(row, column)| {
                        let Pair { source, target } = pairs[row];
                        ground.latents[(target.row(), column)]
                            - ground.latents[(source.row(), column)]
                    },
                );

                let fit = Ridge::fit(inputs.view(), steps.view(), REFIT_ALPHA, intercept)?;
                Ok(Self::Refit { fit, z_scored })
            }
        }
    }

    /// The latent step for a motion from `latent`. `mean_share` is the fraction of the constant
    /// terms (μ in the affine reading, the intercept of a refit) in this step: 1 for a whole
    /// motion, 1/S for one of S equal parts. A corrector ignores it and treats each part as a whole
    /// motion.
    ///
    /// # Errors
    /// [`Error::Adapter`] when the adapter does not have the corrector.
    pub fn step(
        &self,
        adapter: &Adapter,
        latent: ArrayView1<'_, f64>,
        twist: Twist,
        mean_share: f64,
    ) -> Result<Array1<f64>, Error> {
        match self {
            Self::InversePoincare(reading) => Ok(adapter.step(latent, twist, *reading, mean_share)),
            Self::Corrector(kind) => Ok(adapter.corrected_step(*kind, latent, twist)?),
            Self::Refit { fit, z_scored } => {
                let moved = fit
                    .coefficients
                    .dot(&input(adapter, twist, *z_scored, mean_share));

                // Only coordinates are fitted, so a mixture's gate weights do not change.
                let mut step = Array1::zeros(adapter.latent_dim());
                step.slice_mut(s![..moved.len()])
                    .assign(&(moved + &fit.intercept * mean_share));

                Ok(step)
            }
        }
    }
}

/// A motion as the input of a refit; `mean_share` is as in [`Stepper::step`].
fn input(adapter: &Adapter, twist: Twist, z_scored: bool, mean_share: f64) -> Array1<f64> {
    let scale = adapter.scale();
    let motion = twist.to_vector();
    let input = if z_scored {
        (motion - scale.mean * mean_share).component_div(&scale.deviation)
    } else {
        motion
    };

    Array1::from_iter(input.iter().copied())
}

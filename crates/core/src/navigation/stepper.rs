//! How a motion becomes a step in latent space.

use ndarray::{Array1, Array2, ArrayView1, ArrayView2, s};

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
    /// A corrector that was trained together with the adapter.
    Corrector(CorrectorKind),
    /// B ΔP, with B fitted by ridge regression in the room itself while φ stays frozen.
    Refit(Refit),
}

/// A variant of the refit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Refit {
    /// Whether motions are first z-scored by the adapter's μ and σ, which changes the effect of the
    /// penalty.
    pub z_scored: bool,
    /// Whether a constant step is fitted too; with one, zero motion moves the latent.
    pub intercept: bool,
    /// Whether it is fitted on the very pairs that it is tested on: a leak, and the likely protocol
    /// of the paper. Otherwise it is fitted on the room's training pairs.
    pub in_sample: bool,
}

impl StepKind {
    /// Every method, inverse Poincaré first.
    pub fn all() -> Vec<Self> {
        let readings = Reading::ALL.map(Self::InversePoincare);
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

    /// Its name in tables, JSON and on the wire.
    pub fn name(self) -> &'static str {
        match self {
            Self::InversePoincare(Reading::Affine) => "inverse-poincare-affine",
            Self::InversePoincare(Reading::Homogeneous) => "inverse-poincare-homogeneous",
            Self::InversePoincare(Reading::Literal) => "inverse-poincare-literal",
            Self::Corrector(CorrectorKind::Linear) => "corrector-linear",
            Self::Corrector(CorrectorKind::Mlp2) => "corrector-mlp-2",
            Self::Corrector(CorrectorKind::Mlp3) => "corrector-mlp-3",
            Self::Corrector(CorrectorKind::Attention) => "corrector-attention",
            Self::Refit(Refit {
                z_scored,
                intercept,
                in_sample,
            }) => match (z_scored, intercept, in_sample) {
                (false, false, false) => "ridge-refit",
                (false, false, true) => "ridge-refit-in-sample",
                (true, false, false) => "ridge-refit-z-scored",
                (true, false, true) => "ridge-refit-z-scored-in-sample",
                (false, true, false) => "ridge-refit-intercept",
                (false, true, true) => "ridge-refit-intercept-in-sample",
                (true, true, false) => "ridge-refit-z-scored-intercept",
                (true, true, true) => "ridge-refit-z-scored-intercept-in-sample",
            },
        }
    }

    /// The method with this [`StepKind::name`].
    pub fn from_name(name: &str) -> Option<Self> {
        Self::all().into_iter().find(|kind| kind.name() == name)
    }
}

/// The data of one room that a refit is fitted to.
#[derive(Debug, Clone, Copy)]
pub struct RefitData<'a> {
    /// Latents, one row per frame.
    pub latents: ArrayView2<'a, f64>,
    /// `world_from_camera`, one per frame.
    pub poses: &'a [Pose],
    /// Pairs to fit on, unless the refit is in-sample.
    pub train: &'a [Pair],
    /// Test pairs, on which an in-sample refit is fitted.
    pub test: &'a [Pair],
}

/// A method of stepping, fitted and ready to use.
#[derive(Debug, Clone)]
pub enum Stepper {
    /// W⁺ΔP.
    InversePoincare(Reading),
    /// By a corrector.
    Corrector(CorrectorKind),
    /// By a fitted linear map.
    Refit {
        /// The map from motions to steps of the latent coordinates.
        fit: Ridge,
        /// Whether motions are z-scored first.
        z_scored: bool,
    },
}

impl Stepper {
    /// Prepares a method of stepping; a refit is fitted here.
    ///
    /// # Errors
    /// [`Error::Adapter`] when the adapter lacks the corrector, [`Error::Refit`] without a pair to
    /// fit on.
    pub fn new(kind: StepKind, adapter: &Adapter, ground: RefitData<'_>) -> Result<Self, Error> {
        match kind {
            StepKind::InversePoincare(reading) => Ok(Self::InversePoincare(reading)),
            StepKind::Corrector(kind) => {
                // A trial step: an adapter without this corrector is refused now, not in the middle
                // of a walk.
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

                // The fit is the reverse of the adapter's training: motions are the inputs, and the
                // latent differences of the same pairs are the targets.
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

                // Only the coordinates are fitted; the gate columns of a mixture's latents are left
                // out.
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

    /// The latent step for a motion from `latent`. `mean_share` is the share that this step takes
    /// of what does not depend on the motion (μ in the affine reading, the intercept of a refit): 1
    /// for a whole motion, 1/S for one of S equal parts. A corrector ignores it and treats each
    /// part as a whole motion.
    ///
    /// # Errors
    /// [`Error::Adapter`] when the adapter lacks the corrector.
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

                // The fit covers the coordinates only, so a mixture's gate does not move.
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

//! Names of navigators, as used in tables, JSON, the command line and the wire.

use strum::VariantArray;

use super::{Refit, RetrievalMetric, StepKind};
use crate::adapter::{Adapter, CorrectorKind, Reading};

/// A navigator: a method to choose the next frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NavigatorKind {
    /// Baseline ĝ = g: the camera does not move. Retrieves the source frame, even if another frame
    /// has the same latent, so that Hit@ε is P(‖ΔP‖ < ε) for every encoder. With the source
    /// excluded, retrieves the frame with the nearest latent.
    Identity,
    /// Baseline: a random candidate.
    Random,
    /// Upper bound of retrieval: the candidate with the pose nearest to the target's.
    Oracle,
    /// Predicts the latent after a motion and retrieves the nearest frame under a metric.
    Step(StepKind, RetrievalMetric),
    /// Retrieves the frame to which the motion is most likely under the adapter's relational
    /// reader. Ours, not the paper's.
    Relational,
}

/// Separator between step and metric in a navigator's name.
const UNDER: char = '+';

impl NavigatorKind {
    /// All navigators.
    pub fn all() -> Vec<Self> {
        // The calibrated metric applies only to the homogeneous reading, where W maps the predicted
        // latent step exactly to ΔP.
        let homogeneous = StepKind::InversePoincare(Reading::Homogeneous);
        let steps = StepKind::all().into_iter();
        let metrics = RetrievalMetric::VARIANTS.iter();
        let steps = steps.flat_map(|step| metrics.clone().map(move |&metric| (step, metric)));
        let steps = steps
            .filter(|&(step, metric)| metric != RetrievalMetric::Calibrated || step == homogeneous);
        let steps = steps.map(|(step, metric)| Self::Step(step, metric));

        [Self::Identity, Self::Random, Self::Oracle]
            .into_iter()
            .chain(steps)
            .chain([Self::Relational])
            .collect()
    }

    /// Default rows of the table for an adapter: baselines, the three readings of inverse Poincaré,
    /// the adapter's correctors, refits on z-scored and on unscaled motions, and inverse Poincaré
    /// under the other supported metrics, and the relational reader if the adapter has one.
    pub fn table(adapter: &Adapter) -> Vec<Self> {
        let full = |step: StepKind| Self::Step(step, RetrievalMetric::Full);
        let corrector = |kind: CorrectorKind| full(StepKind::Corrector(kind));

        let refit = |z_scored: bool, in_sample: bool| {
            full(StepKind::Refit(Refit {
                z_scored,
                intercept: false,
                in_sample,
            }))
        };

        let affine = StepKind::InversePoincare(Reading::Affine);

        // The metrics `motion` and `calibrated` measure σ ⊙ W g. With a gate, W depends on the
        // source, so they are not available.
        let gated = adapter.motion_of_coordinates().is_err();
        let others = [
            RetrievalMetric::RowSpace,
            RetrievalMetric::Whitened,
            RetrievalMetric::Motion,
        ];
        let others = others
            .into_iter()
            .filter(|&metric| !(gated && metric == RetrievalMetric::Motion));

        let mut rows = vec![Self::Identity, Self::Random, Self::Oracle];
        let readings = Reading::VARIANTS.iter().copied();
        rows.extend(readings.map(StepKind::InversePoincare).map(full));
        rows.extend(adapter.correctors().map(|known| corrector(known.kind())));
        rows.extend([
            refit(true, false),
            refit(true, true),
            refit(false, false),
            refit(false, true),
        ]);

        rows.extend(others.map(|metric| Self::Step(affine, metric)));

        // Only a calibrated adapter has an error covariance.
        let homogeneous = StepKind::InversePoincare(Reading::Homogeneous);
        let calibrated = adapter.error_covariance().filter(|_| !gated);
        rows.extend(calibrated.map(|_| Self::Step(homogeneous, RetrievalMetric::Calibrated)));
        rows.extend(adapter.relational().map(|_| Self::Relational));

        rows
    }

    /// Name in tables, JSON and on the wire: the step, and `+METRIC` unless the metric is the
    /// paper's, `full`.
    pub fn name(self) -> String {
        match self {
            Self::Identity => "identity".to_owned(),
            Self::Random => "random".to_owned(),
            Self::Oracle => "oracle".to_owned(),
            Self::Relational => "relational".to_owned(),
            Self::Step(step, RetrievalMetric::Full) => step.name(),
            Self::Step(step, metric) => format!("{}{UNDER}{metric}", step.name()),
        }
    }

    /// The navigator with this [`NavigatorKind::name`].
    pub fn from_name(name: &str) -> Option<Self> {
        Self::all().into_iter().find(|kind| kind.name() == name)
    }

    /// All names in one sentence, for error messages about an unknown name.
    pub fn known_names() -> String {
        let steps: Vec<String> = StepKind::all().into_iter().map(StepKind::name).collect();
        format!(
            "identity, random, oracle, relational, {}; ways to step also with +row-space, +whitened or +motion, and \
             inverse-poincare-homogeneous with +calibrated",
            steps.join(", ")
        )
    }
}

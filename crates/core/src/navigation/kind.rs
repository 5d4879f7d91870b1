//! The name of a navigator: the one place that writes and reads it. Tables, JSON, the command line
//! and the wire all use it.

use super::{Refit, RetrievalMetric, StepKind};
use crate::adapter::{Adapter, CorrectorKind, Reading};

/// One way to choose the next frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NavigatorKind {
    /// ĝ = g: the camera stays. It retrieves the source frame itself, even if another frame has the
    /// same latent, so that its Hit@ε is P(‖ΔP‖ < ε) whatever the encoder. With the source
    /// excluded, it retrieves the frame whose latent is nearest to the source's.
    Identity,
    /// A candidate drawn at random.
    Random,
    /// The candidate whose pose is nearest to the target's: the best that retrieval can reach.
    Oracle,
    /// Predicts the latent that a motion leads to, and retrieves the nearest frame under a metric.
    Step(StepKind, RetrievalMetric),
}

/// Stands between the step and the metric in a navigator's name, unless the metric is the paper's.
const UNDER: char = '+';

impl NavigatorKind {
    /// Every navigator.
    pub fn all() -> Vec<Self> {
        // The calibrated metric belongs to the homogeneous reading: only there is the predicted
        // latent ΔP away from the source under W.
        let homogeneous = StepKind::InversePoincare(Reading::Homogeneous);
        let steps = StepKind::all().into_iter();
        let steps = steps.flat_map(|step| RetrievalMetric::ALL.map(|metric| (step, metric)));
        let steps = steps
            .filter(|&(step, metric)| metric != RetrievalMetric::Calibrated || step == homogeneous);
        let steps = steps.map(|(step, metric)| Self::Step(step, metric));

        [Self::Identity, Self::Random, Self::Oracle]
            .into_iter()
            .chain(steps)
            .collect()
    }

    /// The default rows of the table for an adapter: the baselines, the three readings of inverse
    /// Poincaré, the adapter's correctors, the refits on z-scored and on unscaled motions, and inverse Poincaré
    /// under the other metrics that the adapter supports.
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

        // The metrics motion and calibrated measure σ ⊙ W g. Under a gate, W changes with the
        // source and these metrics do not exist.
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
        rows.extend(Reading::ALL.map(|reading| full(StepKind::InversePoincare(reading))));
        rows.extend(adapter.correctors().map(|known| corrector(known.kind())));
        rows.extend([
            refit(true, false),
            refit(true, true),
            refit(false, false),
            refit(false, true),
        ]);

        rows.extend(others.map(|metric| Self::Step(affine, metric)));

        // Only an adapter with calibration rooms knows the covariance of its errors.
        let homogeneous = StepKind::InversePoincare(Reading::Homogeneous);
        let calibrated = adapter.error_covariance().filter(|_| !gated);
        rows.extend(calibrated.map(|_| Self::Step(homogeneous, RetrievalMetric::Calibrated)));

        rows
    }

    /// Its name in tables, JSON and on the wire: that of the step, and `+METRIC` unless the metric
    /// is the paper's.
    pub fn name(self) -> String {
        match self {
            Self::Identity => "identity".to_owned(),
            Self::Random => "random".to_owned(),
            Self::Oracle => "oracle".to_owned(),
            Self::Step(step, RetrievalMetric::Full) => step.name().to_owned(),
            Self::Step(step, metric) => format!("{}{UNDER}{}", step.name(), metric.name()),
        }
    }

    /// The navigator with this [`NavigatorKind::name`].
    pub fn from_name(name: &str) -> Option<Self> {
        Self::all().into_iter().find(|kind| kind.name() == name)
    }

    /// All names in one sentence, for the message about an unknown one.
    pub fn known_names() -> String {
        let steps: Vec<&str> = StepKind::all().into_iter().map(StepKind::name).collect();
        format!(
            "identity, random, oracle, {}; ways to step also with +row-space, +whitened or +motion, and \
             inverse-poincare-homogeneous with +calibrated",
            steps.join(", ")
        )
    }
}

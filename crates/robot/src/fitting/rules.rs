//! Reading rules: the motion estimator, its gain and covariance, by the distance from the map.

use nalgebra::{Matrix6, Vector3, Vector6};

use super::Error;
use super::hypotheses::{MotionHypotheses, MotionReader, PartRule};
use crate::calibration::robust_covariance;
use seese3_core::geometry::{Pose, Twist, body_twist, exp};
use seese3_core::statistics::{Rate, median};

/// Minimum number of held-out views per rule.
const FEWEST_MATCHES: usize = 25;
/// Maximum number of rules.
const MOST_RULES: usize = 8;
/// Size of the pseudo-error added in each direction, meters or radians.
const LEAST_ERROR: f64 = 1e-3;
/// Number of candidate gains: 0.1, 0.2, …, 1.
const GAINS: usize = 10;

/// Estimators and covariance for views up to a distance from the map.
#[derive(Debug, Clone, PartialEq)]
pub struct ReadingRule {
    /// Largest distance of the held-out views of the rule, in standard deviations of a feature
    /// column.
    pub up_to: f64,
    /// Estimator of the translation.
    pub translation: PartRule,
    /// Estimator of the rotation.
    pub rotation: PartRule,
    /// Covariance of the pose error in its body frame, on (v, ω), meters and radians, divided by
    /// u² + u₀². Here u is [`MotionHypotheses::disagreement`] and u₀ is `least_disagreement`.
    pub covariance: Matrix6<f64>,
    /// u₀: a quarter of the median disagreement of the held-out views. It keeps covariances above
    /// zero if the estimates happen to agree.
    pub least_disagreement: f64,
}

impl ReadingRule {
    /// Covariance of a pose error at a distance from the map and a disagreement of the estimates.
    /// Beyond `up_to`, the standard deviation grows in proportion to the distance.
    pub fn covariance_at(&self, distance: f64, disagreement: f64) -> Matrix6<f64> {
        let beyond = (distance / self.up_to).max(1.0);
        self.covariance * (self.squared_size(disagreement) * beyond * beyond)
    }

    fn squared_size(&self, disagreement: f64) -> f64 {
        disagreement * disagreement + self.least_disagreement * self.least_disagreement
    }
}

/// Rules in order of increasing distance; the last one also applies beyond its distance.
#[derive(Debug, Clone, PartialEq)]
pub struct ReadingRules(Vec<ReadingRule>);

/// The error that cross-validation leads to expect of views up to a distance from the map.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub struct ExpectedError {
    /// Largest distance of the view's feature from the nearest mapped feature, in standard
    /// deviations of a feature column.
    pub feature_distance: f64,
    /// Root mean square of the position error, meters.
    pub translation_m: f64,
    /// Root mean square of the rotation error, radians.
    pub rotation_rad: f64,
}

/// Motion hypotheses for a held-out view with known pose.
pub struct HeldOutView {
    /// Estimated motions from the mapped frame to the view.
    pub readings: MotionHypotheses,
    /// True motion from the mapped frame to the view.
    pub truth: Twist,
    /// Whether the view lies directly between two mapped frames, see `Fold::is_interleaved`.
    pub is_interleaved: bool,
}

impl ReadingRules {
    /// Validates stored rules.
    ///
    /// # Errors
    /// [`Error::Rules`], which names the problem.
    pub fn new(rules: Vec<ReadingRule>) -> Result<Self, Error> {
        let unsound = |what| Err(Error::Rules { what });
        if rules.is_empty() {
            return unsound("there are no rules");
        }
        if !rules.is_sorted_by(|a, b| a.up_to < b.up_to)
            || rules
                .iter()
                .any(|rule| rule.up_to.is_nan() || rule.up_to < 0.0)
        {
            return unsound("the distances do not increase");
        }

        for rule in &rules {
            for part in [rule.translation, rule.rotation] {
                let is_none = part.reader == MotionReader::NearestFrame;
                if !(0.0..=1.0).contains(&part.gain) || is_none != (part.gain == 0.0) {
                    return unsound("a gain is out of range");
                }
            }

            if rule.covariance.cholesky().is_none() {
                return unsound("a covariance is not positive definite");
            }
            if !(rule.least_disagreement.is_finite() && rule.least_disagreement > 0.0) {
                return unsound("a disagreement is not positive");
            }
        }

        Ok(Self(rules))
    }

    /// The rules, in order of increasing distance.
    pub fn rules(&self) -> &[ReadingRule] {
        &self.0
    }

    /// The expected errors at the median disagreement of the held-out views, nearest views first.
    pub fn expected_errors(&self) -> Vec<ExpectedError> {
        let expected = self.0.iter().map(|rule| {
            // `least_disagreement` is a quarter of the median.
            let median_disagreement = 4.0 * rule.least_disagreement;
            let variances = rule
                .covariance_at(rule.up_to, median_disagreement)
                .diagonal();
            ExpectedError {
                feature_distance: rule.up_to,
                translation_m: variances.fixed_rows::<3>(0).sum().sqrt(),
                rotation_rad: variances.fixed_rows::<3>(3).sum().sqrt(),
            }
        });
        expected.collect()
    }

    /// The rule for a view at this distance from the map.
    pub fn at(&self, distance: f64) -> &ReadingRule {
        let next = self.0.partition_point(|rule| rule.up_to < distance);
        &self.0[next.min(self.0.len() - 1)]
    }

    /// Fits rules to held-out views (trials), sorted by distance into bins of equal size.
    ///
    /// An adapter is used only if it is nearer to the truth than the mapped frame in significantly
    /// more than half of the trials (Wilson lower bound above 0.5).
    ///
    /// Interleaved views have smaller errors than other views at the same distance. Covariances
    /// therefore use only the other views, if a bin has enough.
    ///
    /// # Errors
    /// [`Error::AllAlike`] if all trials have distance 0, [`Error::Adapter`] if the errors give no
    /// valid covariance.
    pub(super) fn measured(mut trials: Vec<HeldOutView>) -> Result<Self, Error> {
        // A trial with distance 0 is a repeated image: there is no motion to estimate.
        trials.retain(|trial| trial.readings.distance > 0.0);
        if trials.is_empty() {
            return Err(Error::AllAlike);
        }
        trials.sort_by(|a, b| a.readings.distance.total_cmp(&b.readings.distance));

        let count = (trials.len() / FEWEST_MATCHES).clamp(1, MOST_RULES);
        let mut rules: Vec<ReadingRule> = Vec::new();

        for part in trials.chunks(trials.len().div_ceil(count).max(1)) {
            let translation = best_reader(part, |twist| twist.linear);
            let rotation = best_reader(part, |twist| twist.angular);

            let mut rule = ReadingRule {
                up_to: part[part.len() - 1].readings.distance,
                translation,
                rotation,
                covariance: Matrix6::identity(),
                least_disagreement: least_disagreement(part),
            };

            let elsewhere: Vec<&HeldOutView> =
                part.iter().filter(|trial| !trial.is_interleaved).collect();
            let judging = if elsewhere.len() >= FEWEST_MATCHES {
                elsewhere
            } else {
                part.iter().collect()
            };

            // At the same feature distance, errors between mapped frames are smaller than errors
            // beyond them. The disagreement captures this, so errors are normalized by it.
            let mut residuals: Vec<Vector6<f64>> = judging
                .into_iter()
                .map(|trial| {
                    let size = rule.squared_size(trial.readings.disagreement).sqrt();
                    residual(trial, translation, rotation) / size
                })
                .collect();

            // A wheeled robot has no error in some directions. One pseudo-error per direction keeps
            // the covariance positive definite.
            let size = rule.squared_size(rule.least_disagreement).sqrt();
            residuals.extend((0..6).map(|axis| Vector6::ith(axis, LEAST_ERROR / size)));
            rule.covariance = robust_covariance(&residuals)?;

            // Trials with equal distance may fall into two bins; keep the rule of the later bin.
            match rules.last_mut() {
                Some(last) if last.up_to >= rule.up_to => *last = rule,
                _ => rules.push(rule),
            }
        }

        Self::new(rules)
    }
}

/// A quarter of the median disagreement, bounded to be positive.
fn least_disagreement(trials: &[HeldOutView]) -> f64 {
    let found: Vec<f64> = trials
        .iter()
        .map(|trial| trial.readings.disagreement)
        .collect();
    (0.25 * median(&found)).max(f64::MIN_POSITIVE.sqrt())
}

/// Estimator and gain with the smallest median error, for one part of the motion.
fn best_reader(trials: &[HeldOutView], part: fn(&Twist) -> Vector3<f64>) -> PartRule {
    let unread: Vec<f64> = trials
        .iter()
        .map(|trial| part(&trial.truth).norm())
        .collect();
    let mut best = PartRule::NONE;
    let mut least = median(&unread);

    for reader in [MotionReader::ZeroShot, MotionReader::Fitted] {
        for tenth in 1..=GAINS {
            let gain = tenth as f64 / GAINS as f64;
            let errors: Option<Vec<f64>> = trials
                .iter()
                .map(|trial| {
                    let read = trial.readings.by(reader)?;
                    Some((part(&trial.truth) - part(&read) * gain).norm())
                })
                .collect();

            let Some(errors) = errors else {
                continue;
            };
            let nearer = errors
                .iter()
                .zip(&unread)
                .filter(|(read, unread)| read < unread);
            let is_sure = Rate::of(nearer.count(), trials.len()).low > 0.5;
            if is_sure && median(&errors) < least {
                least = median(&errors);
                best = PartRule { reader, gain };
            }
        }
    }

    best
}

/// Error of the estimated pose, in its body frame.
fn residual(trial: &HeldOutView, translation: PartRule, rotation: PartRule) -> Vector6<f64> {
    let located = exp(&trial.readings.combined(translation, rotation));
    let truth: Pose = exp(&trial.truth);
    body_twist(&located, &truth).to_vector()
}

#[cfg(test)]
mod tests {
    use super::*;
    use seese3_core::index::Neighbor;
    use seese3_core::room::FrameId;

    /// Trials in which the fitted adapter is accurate near the map and wrong far from it.
    fn trials(count: usize) -> Vec<HeldOutView> {
        let mut random = <rand_chacha::ChaCha8Rng as rand::SeedableRng>::seed_from_u64(1);
        (0..count)
            .map(|at| {
                let distance = 0.1 + at as f64 / count as f64;
                let noise: Vec<f64> =
                    seese3_core::statistics::normal_deviates(&mut random, 12).collect();
                let truth =
                    Twist::from_vector(&Vector6::from_iterator(noise[..6].iter().map(|x| 0.1 * x)));
                let wrong =
                    Twist::from_vector(&Vector6::from_iterator(noise[6..].iter().map(|x| 0.1 * x)));
                let (of_truth, of_error) = if distance < 0.6 {
                    (1.0, 0.1)
                } else {
                    (0.0, 1.0)
                };

                HeldOutView {
                    readings: MotionHypotheses {
                        nearest: Neighbor {
                            frame: FrameId(0),
                            distance,
                        },
                        distance,
                        disagreement: 1.0,
                        zero_shot: Some(wrong),
                        fitted: Some(Twist::from_vector(
                            &(truth.to_vector() * of_truth + wrong.to_vector() * of_error),
                        )),
                    },
                    truth,
                    is_interleaved: false,
                }
            })
            .collect()
    }

    /// Oracle: the construction of the trials: accurate below a distance of 0.6, wrong above.
    #[test]
    fn a_reader_is_believed_where_it_is_right() {
        let rules = ReadingRules::measured(trials(800)).unwrap();
        assert_eq!(rules.rules().len(), 8);

        for (distance, reader) in [
            (0.05, MotionReader::Fitted),
            (0.3, MotionReader::Fitted),
            (0.9, MotionReader::NearestFrame),
            (9.0, MotionReader::NearestFrame),
        ] {
            let rule = rules.at(distance);
            assert_eq!(rule.translation.reader, reader, "{distance}");
            assert_eq!(rule.rotation.reader, reader, "{distance}");
        }

        // Fitted estimates have a tenth of the other errors; all trials have the same disagreement.
        let near = rules.at(0.2).covariance_at(0.2, 1.0)[(0, 0)].sqrt();
        let far = rules.at(1.0).covariance_at(1.0, 1.0)[(0, 0)].sqrt();
        assert!(
            (0.005..0.02).contains(&near) && (0.07..0.13).contains(&far),
            "{near} {far}"
        );
    }

    /// Oracle: the documented conditions of [`Error::Rules`].
    #[test]
    fn rules_that_make_no_sense_are_refused() {
        let rule = ReadingRules::measured(trials(100)).unwrap().rules()[0].clone();
        let changed = |change: fn(&mut ReadingRule)| {
            let mut rule = rule.clone();
            change(&mut rule);
            ReadingRules::new(vec![rule])
        };

        assert!(ReadingRules::new(vec![]).is_err());
        assert!(ReadingRules::new(vec![rule.clone(), rule.clone()]).is_err());
        assert!(changed(|rule| rule.up_to = f64::NAN).is_err());
        assert!(changed(|rule| rule.rotation.gain = 1.5).is_err());
        assert!(changed(|rule| rule.rotation.reader = MotionReader::NearestFrame).is_err());
        assert!(changed(|rule| rule.covariance = Matrix6::zeros()).is_err());
        assert!(changed(|rule| rule.least_disagreement = 0.0).is_err());
        assert!(changed(|_| ()).is_ok());
    }
}

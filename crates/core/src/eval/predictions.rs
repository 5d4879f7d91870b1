//! Scores of external predictions, from a client with its own navigator.

use ndarray::{Array2, Axis, s};

use super::{Error, LatentScores, RetrievalScores, Row, check_thresholds};
use crate::cancel::Cancellation;
use crate::index::Exclusion;
use crate::navigation::{Navigator, RetrievalMetric, Search};
use crate::room::FrameId;
use crate::splits::{Pair, Split};

/// A client's prediction for one pair.
#[derive(Debug, Clone, PartialEq)]
pub enum Prediction {
    /// The predicted latent at the target, shape (k,).
    Latent(Vec<f64>),
    /// The retrieved frame.
    Frame(FrameId),
}

/// A pair and a client's prediction for it.
#[derive(Debug, Clone, PartialEq)]
pub struct PredictedPair {
    /// The source and the target.
    pub pair: Pair,
    /// The prediction for the target.
    pub prediction: Prediction,
    /// The frame that the last step started from, for a motion of several steps. The exclusion is
    /// centered on it, as in `evaluate`. `None` for the source.
    pub last_step_from: Option<FrameId>,
}

/// Allowed pairs and frames, and the thresholds of the scores.
#[derive(Debug, Clone, PartialEq)]
pub struct PredictionScope {
    /// Pairs must be test pairs of this split, and candidates are those of [`Split::candidates`].
    /// `None` allows any pair and all frames.
    pub split: Option<Split>,
    /// Excludes the source frame and this many rows to each side from retrieval; see
    /// [`PredictedPair::last_step_from`].
    pub exclude_source: Option<u32>,
    /// ε of Hit@ε.
    pub thresholds: Vec<f64>,
}

/// Scores one prediction per pair: a latent by its nearest frame, a frame directly. Identity, the
/// baseline, retrieves the source, so that there is none if the source is excluded or not a
/// candidate.
///
/// # Errors
/// [`Error::NoPredictions`] for an empty list, [`Error::MixedPredictions`] for latents and frames
/// in one list, [`Error::Threshold`] or [`Error::ThresholdCount`] as [`check_thresholds`],
/// [`Error::Cancelled`], and [`Error::Prediction`] for the first pair or prediction that is invalid
/// for the room, the scope or the adapter.
pub fn score_predictions(
    navigator: &Navigator,
    predictions: &[PredictedPair],
    scope: &PredictionScope,
    cancel: &Cancellation,
) -> Result<Row, Error> {
    check_thresholds(&scope.thresholds)?;
    if predictions.is_empty() {
        return Err(Error::NoPredictions);
    }

    let room = navigator.room();
    let candidates = match scope.split {
        Some(split) => split.candidates(room.timeline()),
        None => (0..room.frame_count() as u32).map(FrameId).collect(),
    };

    // Exact search: scores must not depend on an approximate index.
    let search = Search::exact(
        RetrievalMetric::Full,
        navigator.adapter(),
        navigator.latents(),
        &candidates,
    )?;

    let scoring = Scoring {
        navigator,
        scope,
        candidates: &candidates,
        search: &search,
    };
    let mut pairs = Vec::with_capacity(predictions.len());
    let mut retrieved = Vec::with_capacity(predictions.len());
    let mut latents: Vec<f64> = Vec::new();
    for (position, predicted) in predictions.iter().enumerate() {
        cancel.check()?;

        // Errors give the position in the client's list.
        let frame = scoring
            .retrieved_frame(predicted)
            .map_err(|problem| Error::Prediction {
                position,
                problem: Box::new(problem),
            })?;

        // Predicted latents are concatenated; `latent_scores` checks that every pair has one.
        if let Prediction::Latent(latent) = &predicted.prediction {
            latents.extend(latent);
        }
        pairs.push(predicted.pair);
        retrieved.push(frame);
    }

    // `None` if the predictions are frames.
    let latent = latent_scores(navigator, &pairs, &latents)?;
    let retrieval = RetrievalScores::of(&pairs, &retrieved, room.poses(), &scope.thresholds);

    let sources: Vec<FrameId> = pairs.iter().map(|pair| pair.source).collect();
    let is_candidate = |frame: &FrameId| candidates.binary_search(frame).is_ok();
    let has_identity = scope.exclude_source.is_none() && sources.iter().all(is_candidate);
    let hits_over_identity = if has_identity {
        let identity = RetrievalScores::of(&pairs, &sources, room.poses(), &scope.thresholds);
        retrieval.hits_over(&identity)
    } else {
        Vec::new()
    };

    Ok(Row {
        name: "predictions".to_owned(),
        n: pairs.len(),
        latent,
        retrieval,
        hits_over_identity,
        leaks: false,
    })
}

/// Context in which predictions are checked.
struct Scoring<'a> {
    navigator: &'a Navigator,
    scope: &'a PredictionScope,
    candidates: &'a [FrameId],
    search: &'a Search,
}

impl Scoring<'_> {
    /// The retrieved frame of a prediction: the given frame, if it is allowed, or the nearest
    /// candidate of the latent.
    fn retrieved_frame(&self, predicted: &PredictedPair) -> Result<FrameId, Error> {
        let PredictedPair {
            pair,
            ref prediction,
            last_step_from,
        } = *predicted;

        let room = self.navigator.room();
        let started_from = last_step_from.unwrap_or(pair.source);
        for frame in [pair.source, pair.target, started_from] {
            room.pose(frame)?;
        }

        // Training pairs would make the scores too optimistic.
        if let Some(split) = self.scope.split
            && !split.tests(room.timeline(), pair)
        {
            return Err(Error::NotATestPair {
                source_frame: pair.source,
                target_frame: pair.target,
                split,
            });
        }

        let exclusion = self.scope.exclude_source.map(|radius| Exclusion {
            center: started_from,
            radius,
        });

        match prediction {
            Prediction::Frame(frame) => self.checked_frame(*frame, exclusion),
            Prediction::Latent(latent) => {
                self.navigator.adapter().check_latent(latent)?;
                let latent = ndarray::ArrayView1::from(latent);
                let nearest = self.search.nearest(latent, 1, exclusion);
                let best = nearest.first().ok_or(Error::NoCandidates {
                    source_frame: pair.source,
                })?;
                Ok(best.frame)
            }
        }
    }

    fn checked_frame(
        &self,
        frame: FrameId,
        exclusion: Option<Exclusion>,
    ) -> Result<FrameId, Error> {
        self.navigator.room().pose(frame)?;
        if exclusion.is_some_and(|exclusion| exclusion.covers(frame)) {
            return Err(Error::Excluded { frame });
        }

        match self.scope.split {
            Some(split) if self.candidates.binary_search(&frame).is_err() => {
                Err(Error::NotACandidate { frame, split })
            }
            _ => Ok(frame),
        }
    }
}

/// Scores of predicted latents, concatenated in `latents`; `None` if it is empty.
fn latent_scores(
    navigator: &Navigator,
    pairs: &[Pair],
    latents: &[f64],
) -> Result<Option<LatentScores>, Error> {
    let targets: Vec<usize> = pairs.iter().map(|pair| pair.target.row()).collect();
    let targets = navigator.latents().select(Axis(0), &targets);

    // Only coordinates are scored, not the gate weights of a mixture.
    let coordinates = s![.., ..navigator.adapter().coordinate_count()];
    match latents.len() {
        0 => Ok(None),
        n if n == targets.len() => {
            let predicted = Array2::from_shape_fn(targets.dim(), |(row, column)| {
                latents[row * targets.ncols() + column]
            });
            Ok(Some(LatentScores::of(
                targets.slice(coordinates),
                predicted.slice(coordinates),
            )))
        }

        // Too few numbers: some predictions were frames.
        _ => Err(Error::MixedPredictions),
    }
}

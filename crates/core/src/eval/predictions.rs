//! Scores of predictions made elsewhere, by a client that brings its own navigator.

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
    /// The latent that it expects at the target, shape (k,).
    Latent(Vec<f64>),
    /// The frame that it retrieved.
    Frame(FrameId),
}

/// A client's prediction, and the pair that it is for.
#[derive(Debug, Clone, PartialEq)]
pub struct PredictedPair {
    /// The source and the target.
    pub pair: Pair,
    /// What is expected at the target.
    pub prediction: Prediction,
    /// The frame that the last step started from, where the motion was divided into steps that each
    /// went on from a frame: the exclusion is around it, as it is in `evaluate`. None for the
    /// source.
    pub last_step_from: Option<FrameId>,
}

/// Which pairs and frames are allowed, and the thresholds by which they are scored.
#[derive(Debug, Clone, PartialEq)]
pub struct PredictionScope {
    /// Pairs must be test pairs of this split, and candidates are as in [`Split::candidates`]. If
    /// none is given, any pair is scored and all frames are candidates.
    pub split: Option<Split>,
    /// If given, the source frame and this many rows to each side of it may not be retrieved; see
    /// [`PredictedPair::last_step_from`].
    pub exclude_source: Option<u32>,
    /// ε of Hit@ε.
    pub thresholds: Vec<f64>,
}

/// Scores one prediction per pair: a latent by the frame nearest to it, a frame as it is.
///
/// # Errors
/// [`Error::NoPredictions`] without any, [`Error::MixedPredictions`] when some are latents and some
/// frames, [`Error::Threshold`] or [`Error::ThresholdCount`] as [`check_thresholds`],
/// [`Error::Cancelled`], and [`Error::Prediction`] for the first pair or prediction that does not
/// fit the room, the scope or the adapter.
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

    // The search is exact: scores must not depend on an approximate index.
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

        // Errors name the prediction by its position, since the client sees only its own list.
        let frame = scoring
            .retrieved_frame(predicted)
            .map_err(|problem| Error::Prediction {
                position,
                problem: Box::new(problem),
            })?;

        // Predicted latents are collected in one row; whether every pair has one is checked at the
        // end.
        if let Prediction::Latent(latent) = &predicted.prediction {
            latents.extend(latent);
        }
        pairs.push(predicted.pair);
        retrieved.push(frame);
    }

    // A client that predicted frames has no latents to score.
    let latent = latent_scores(navigator, &pairs, &latents)?;
    let retrieval = RetrievalScores::of(&pairs, &retrieved, room.poses(), &scope.thresholds);

    Ok(Row {
        name: "predictions".to_owned(),
        n: pairs.len(),
        latent,
        retrieval,
    })
}

/// What every prediction is checked against.
struct Scoring<'a> {
    navigator: &'a Navigator,
    scope: &'a PredictionScope,
    candidates: &'a [FrameId],
    search: &'a Search,
}

impl Scoring<'_> {
    /// The frame that a prediction retrieves: a frame as it is, if it may be retrieved, and for a
    /// latent its nearest candidate.
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

        // Pairs that were trained on would flatter the scores.
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
            centre: started_from,
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

/// Scores of predicted latents, which lie one after the other in `latents`; none when only frames
/// were predicted.
fn latent_scores(
    navigator: &Navigator,
    pairs: &[Pair],
    latents: &[f64],
) -> Result<Option<LatentScores>, Error> {
    let targets: Vec<usize> = pairs.iter().map(|pair| pair.target.row()).collect();
    let targets = navigator.latents().select(Axis(0), &targets);

    // Scores are of the coordinates; the gate shares of a mixture are not compared.
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

        // Fewer numbers than the targets have: some predictions were frames.
        _ => Err(Error::MixedPredictions),
    }
}

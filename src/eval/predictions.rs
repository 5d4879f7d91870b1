//! Scores of predictions that were made elsewhere: a remote client brings its own navigator.

use ndarray::{Array2, Axis, s};

use super::{Error, LatentScores, RetrievalScores, Row, check_thresholds};
use crate::cancel::Cancellation;
use crate::index::Exclusion;
use crate::navigation::{Metric, Navigator, Search};
use crate::pairs::{Pair, Split};
use crate::room::FrameId;

/// What a client predicts for a pair.
#[derive(Debug, Clone, PartialEq)]
pub enum Prediction {
    /// Where in latent space the target should be, shape (k,).
    Latent(Vec<f64>),
    /// Which frame it chose.
    Frame(FrameId),
}

/// Among which frames, and how strictly, predictions are scored.
#[derive(Debug, Clone, PartialEq)]
pub struct PredictionScope {
    /// Candidates are this split's; all frames when none is given.
    pub split: Option<Split>,
    /// Whether the source frame may not be retrieved, and how many rows to each side of it.
    pub exclude_source: Option<u32>,
    /// ε of Hit@ε.
    pub thresholds: Vec<f64>,
}

/// Scores one prediction a pair.
///
/// # Errors
/// [`Error::Prediction`] names the first that does not fit; [`Error::MixedPredictions`],
/// [`Error::NoPredictions`], [`Error::Threshold`].
pub fn score_predictions(
    navigator: &Navigator,
    predictions: &[(Pair, Prediction)],
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

    // Exact, since evaluations never depend on an approximation.
    let search = Search::exact(
        Metric::Full,
        navigator.adapter(),
        navigator.latents(),
        &candidates,
    )?;

    let mut pairs = Vec::with_capacity(predictions.len());
    let mut retrieved = Vec::with_capacity(predictions.len());
    let mut latents: Vec<f64> = Vec::new();
    for (position, (pair, prediction)) in predictions.iter().enumerate() {
        cancel.check()?;

        let at = |problem: Error| Error::Prediction {
            position,
            problem: Box::new(problem),
        };

        for frame in [pair.source, pair.target] {
            room.pose(frame).map_err(|problem| at(problem.into()))?;
        }

        if let Some(split) = scope
            .split
            .filter(|split| !split.tests(room.timeline(), *pair))
        {
            return Err(at(Error::NotATestPair {
                source_frame: pair.source,
                target_frame: pair.target,
                split,
            }));
        }

        let exclusion = scope.exclude_source.map(|radius| Exclusion {
            centre: pair.source,
            radius,
        });

        let frame = match prediction {
            Prediction::Frame(frame) => {
                room.pose(*frame).map_err(|problem| at(problem.into()))?;
                if exclusion.is_some_and(|exclusion| exclusion.covers(*frame)) {
                    return Err(at(Error::Excluded { frame: *frame }));
                }

                match scope.split {
                    Some(split) if candidates.binary_search(frame).is_err() => {
                        return Err(at(Error::NotACandidate {
                            frame: *frame,
                            split,
                        }));
                    }
                    _ => *frame,
                }
            }
            Prediction::Latent(latent) => {
                navigator
                    .adapter()
                    .check_latent(latent)
                    .map_err(|problem| at(problem.into()))?;

                latents.extend(latent);
                let nearest = search.nearest(ndarray::ArrayView1::from(latent), 1, exclusion);

                nearest
                    .first()
                    .ok_or_else(|| {
                        at(Error::NoCandidates {
                            source_frame: pair.source,
                        })
                    })?
                    .frame
            }
        };

        pairs.push(*pair);
        retrieved.push(frame);
    }

    let latent = latent_scores(navigator, &pairs, &latents)?;
    let retrieval = RetrievalScores::of(&pairs, &retrieved, room.poses(), &scope.thresholds);

    Ok(Row {
        name: "predictions".to_owned(),
        n: pairs.len(),
        latent,
        retrieval,
    })
}

/// Scores of predicted latents, laid end to end; none when only frames were predicted.
fn latent_scores(
    navigator: &Navigator,
    pairs: &[Pair],
    latents: &[f64],
) -> Result<Option<LatentScores>, Error> {
    let targets: Vec<usize> = pairs.iter().map(|pair| pair.target.row()).collect();
    let targets = navigator.latents().select(Axis(0), &targets);
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
        _ => Err(Error::MixedPredictions),
    }
}

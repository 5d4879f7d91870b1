//! How large an adapter's errors are in one room, compared with the rooms it was calibrated in.
//!
//! The poses of a map's frames are known, so its own frames tell: the errors of motions between
//! them, and of poses read from one when it is left out of the map, against the calibrated
//! covariances.

use ndarray::{Array2, s};

use crate::adapter::{Error, ErrorModel, ErrorTable, MotionErrors, Stratum};
use crate::geometry::{Pose, body_twist, exp, log};
use crate::index::{ExactIndex, Exclusion, Index};
use crate::navigation::Navigator;
use crate::room::FrameId;
use crate::statistics::balancing_factor;

/// At most so many pairs per stride, or frames per radius, are evaluated.
const SAMPLES: usize = 200;
/// Frames to each side that are left out of the map in turn, so that matches of many distances are
/// seen.
const LEFT_OUT_RADII: [u32; 5] = [2, 4, 8, 15, 30];
/// With fewer errors than this no factor is estimated.
const FEWEST_ERRORS: usize = 30;
/// Factors of covariances are kept within these: deviations from half to ten times those of the
/// calibration rooms.
const FACTOR_RANGE: std::ops::RangeInclusive<f64> = 0.25..=100.0;

/// The errors of motions in a room: those of the calibration, each stratum times its factor in this
/// room. `mapped` are the room's mapped frames in order.
pub fn motion_errors(
    navigator: &Navigator,
    error_model: &ErrorModel,
    mapped: &[FrameId],
) -> Result<MotionErrors, Error> {
    let calibrated = &error_model.statistics().motion_errors;

    let mut strata = Vec::with_capacity(calibrated.shapes.strata().len());
    for stratum in calibrated.shapes.strata() {
        let stride = stratum.at as u32;
        let factor = factor_of(motion_surprises(navigator, error_model, mapped, stride));
        strata.push(Stratum {
            covariance: stratum.covariance * factor,
            ..*stratum
        });
    }

    Ok(MotionErrors {
        shapes: ErrorTable::new(strata)?,
        floor: calibrated.floor,
    })
}

/// How large the errors of retrieved poses are in a room, compared with the calibration: a factor
/// of covariances. `whitened` are the room's whitened latents, row by frame.
pub fn anchor_factor(
    navigator: &Navigator,
    error_model: &ErrorModel,
    mapped: &[FrameId],
    whitened: &Array2<f64>,
) -> f64 {
    factor_of(anchor_surprises(navigator, error_model, mapped, whitened))
}

/// The factor that makes covariances fit errors of these squared Mahalanobis lengths.
fn factor_of(mut squared_lengths: Vec<f64>) -> f64 {
    if squared_lengths.len() < FEWEST_ERRORS {
        return 1.0;
    }

    balancing_factor(&mut squared_lengths)
        .unwrap_or(1.0)
        .clamp(*FACTOR_RANGE.start(), *FACTOR_RANGE.end())
}

/// Squared Mahalanobis lengths of the errors of motions between mapped frames `stride` rows apart.
fn motion_surprises(
    navigator: &Navigator,
    error_model: &ErrorModel,
    mapped: &[FrameId],
    stride: u32,
) -> Vec<f64> {
    let room = navigator.room();
    let adapter = navigator.adapter();
    let latents = navigator.latents();
    let coordinates = s![..adapter.coordinate_count()];

    // Where every second frame is mapped, no two are one row apart: the next one is taken instead.
    let is_mapped = |frame: &FrameId| mapped.binary_search(frame).is_ok();
    let partner = |from: FrameId| {
        (stride..=stride + 1)
            .map(|rows| FrameId(from.0 + rows))
            .find(is_mapped)
    };
    let pairs: Vec<(FrameId, FrameId)> = mapped
        .iter()
        .filter_map(|&from| Some((from, partner(from)?)))
        .filter(|(from, to)| room.timeline().joins(*from, *to))
        .collect();

    let surprise = |(from, to): &(FrameId, FrameId)| {
        let latent_from = latents.row(from.row());
        let latent_to = latents.row(to.row());
        let difference = &latent_to.slice(coordinates) - &latent_from.slice(coordinates);
        let covariance = error_model.motion_errors(difference.view(), u64::from(to.0 - from.0));

        let truth = body_twist(&room.poses()[from.row()], &room.poses()[to.row()]).to_vector();
        let read = adapter
            .motion_without_mean(latent_from, latent_to)
            .to_vector();
        let error = truth - read;
        Some(error.dot(&covariance.cholesky()?.solve(&error)))
    };

    let every = pairs.len().div_ceil(SAMPLES).max(1);
    pairs.iter().step_by(every).filter_map(surprise).collect()
}

/// Squared Mahalanobis lengths of the errors of mapped frames' poses, each read from the frame that
/// matches it best when it and its neighbours in time are left out of the map.
fn anchor_surprises(
    navigator: &Navigator,
    error_model: &ErrorModel,
    mapped: &[FrameId],
    whitened: &Array2<f64>,
) -> Vec<f64> {
    let index = ExactIndex::new(whitened.view(), mapped);
    let poses = navigator.room().poses();
    let adapter = navigator.adapter();
    let latents = navigator.latents();

    let surprise = |centre: FrameId, radius: u32| {
        let row = whitened.row(centre.row()).to_vec();
        let best = *index
            .nearest(&row, 1, Some(Exclusion { centre, radius }))
            .first()?;

        let errors = error_model.anchor_errors(best.distance);
        let motion = adapter
            .motion_without_mean(latents.row(best.frame.row()), latents.row(centre.row()))
            .scaled(errors.gain);
        let found: Pose = poses[best.frame.row()] * exp(&motion);

        let error = log(&found.inv_mul(&poses[centre.row()])).to_vector();
        Some(error.dot(&errors.covariance.cholesky()?.solve(&error)))
    };

    let every = mapped.len().div_ceil(SAMPLES).max(1);
    let mut surprises = Vec::new();
    for radius in LEFT_OUT_RADII {
        let queries = mapped.iter().step_by(every);
        surprises.extend(queries.filter_map(|&centre| surprise(centre, radius)));
    }

    surprises
}

//! How large an adapter's errors are in a room, against those in the rooms it was calibrated in:
//! told by the room's own frames, whose poses are known.

use ndarray::{Array2, s};

use crate::adapter::{Calibration, Error, ErrorTable, MotionErrors, Stratum};
use crate::geometry::{Pose, body_twist, exp, log};
use crate::index::{ExactIndex, Exclusion, Index};
use crate::navigation::Navigator;
use crate::room::FrameId;
use crate::training::balancing_factor;

/// Pairs and frames that are looked at, at most so many for each stride and each radius.
const SAMPLED: usize = 200;
/// Frames to each side that are left out of the map in turn, so that matches of many distances are
/// seen.
const LEFT_OUT: [u32; 5] = [2, 4, 8, 15, 30];
/// Errors that a factor is told by at least.
const LEAST: usize = 30;
/// Factors are kept within these: deviations twice smaller to ten times larger than where the
/// adapter was calibrated.
const FACTORS: std::ops::RangeInclusive<f64> = 0.25..=100.0;

/// The errors of motions in a room: those of the calibration, each stratum by its factor here.
/// `mapped` are frames in order.
pub fn motion_errors(
    navigator: &Navigator,
    calibration: &Calibration,
    mapped: &[FrameId],
) -> Result<MotionErrors, Error> {
    let MotionErrors { shapes, floor } = &calibration.measured().motion;

    let own = |stratum: &Stratum| {
        let factor = factor(motions(navigator, calibration, mapped, stratum.at as u32));
        Stratum {
            covariance: stratum.covariance * factor,
            ..*stratum
        }
    };

    Ok(MotionErrors {
        shapes: ErrorTable::new(shapes.strata().iter().map(own).collect())?,
        floor: *floor,
    })
}

/// How large the errors of poses found by retrieval are in a room, against the calibration: a
/// factor of covariances. `white` are the room's latents, whitened, row by frame.
pub fn anchor_factor(
    navigator: &Navigator,
    calibration: &Calibration,
    mapped: &[FrameId],
    white: &Array2<f64>,
) -> f64 {
    factor(anchors(navigator, calibration, mapped, white))
}

fn factor(mut lengths: Vec<f64>) -> f64 {
    match lengths.len() {
        LEAST.. => balancing_factor(&mut lengths)
            .unwrap_or(1.0)
            .clamp(*FACTORS.start(), *FACTORS.end()),
        _ => 1.0,
    }
}

/// Squared Mahalanobis lengths of the errors of motions between mapped frames so far apart.
fn motions(
    navigator: &Navigator,
    calibration: &Calibration,
    mapped: &[FrameId],
    stride: u32,
) -> Vec<f64> {
    let room = navigator.room();
    let adapter = navigator.adapter();
    let latents = navigator.latents();
    let coordinates = s![..adapter.coordinate_count()];

    let is_mapped = |frame: &FrameId| mapped.binary_search(frame).is_ok();

    // Where every second frame is mapped no two are one apart: those next further are as near as
    // can be told.
    let pairs: Vec<(FrameId, FrameId)> = mapped
        .iter()
        .filter_map(|&from| {
            Some((
                from,
                (stride..=stride + 1)
                    .map(|n| FrameId(from.0 + n))
                    .find(is_mapped)?,
            ))
        })
        .filter(|(from, to)| room.timeline().joins(*from, *to))
        .collect();

    let length = |(from, to): &(FrameId, FrameId)| {
        let a = latents.row(from.row());
        let b = latents.row(to.row());
        let difference = &b.slice(coordinates) - &a.slice(coordinates);
        let covariance = calibration.motion_errors(difference.view(), u64::from(to.0 - from.0));

        let truth = body_twist(&room.poses()[from.row()], &room.poses()[to.row()]).to_vector();
        let error = truth - adapter.displacement(a, b).to_vector();

        Some(error.dot(&covariance.cholesky()?.solve(&error)))
    };

    pairs
        .iter()
        .step_by(pairs.len().div_ceil(SAMPLED).max(1))
        .filter_map(length)
        .collect()
}

/// Squared Mahalanobis lengths of the errors of mapped frames' poses as others say them.
fn anchors(
    navigator: &Navigator,
    calibration: &Calibration,
    mapped: &[FrameId],
    white: &Array2<f64>,
) -> Vec<f64> {
    let index = ExactIndex::new(white.view(), mapped);
    let poses = navigator.room().poses();
    let adapter = navigator.adapter();
    let latents = navigator.latents();

    let every = mapped.len().div_ceil(SAMPLED).max(1);

    let length = |centre: FrameId, radius: u32| {
        let row = white.row(centre.row()).to_vec();
        let best = *index
            .nearest(&row, 1, Some(Exclusion { centre, radius }))
            .first()?;
        let errors = calibration.anchor_errors(best.distance);
        let step = adapter
            .displacement(latents.row(best.frame.row()), latents.row(centre.row()))
            .scaled(errors.gain);

        let found: Pose = poses[best.frame.row()] * exp(&step);
        let error = log(&found.inv_mul(&poses[centre.row()])).to_vector();

        Some(error.dot(&errors.covariance.cholesky()?.solve(&error)))
    };

    let mut lengths = Vec::new();
    for radius in LEFT_OUT {
        lengths.extend(
            mapped
                .iter()
                .step_by(every)
                .filter_map(|&centre| length(centre, radius)),
        );
    }

    lengths
}

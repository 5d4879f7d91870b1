//! Scales the calibrated motion errors to one room, with the known poses of its mapped frames.

use ndarray::s;

use super::clock::{frame_period_s, seconds_between};
use seese3_core::adapter::{Error, ErrorModel, ErrorTable, MotionErrors, Stratum};
use seese3_core::geometry::body_twist;
use seese3_core::navigation::Navigator;
use seese3_core::room::FrameId;
use seese3_core::statistics::balancing_factor;

/// Maximum number of pairs per stride.
const SAMPLES: usize = 200;
/// Minimum number of errors for a factor; otherwise it is 1.
const FEWEST_ERRORS: usize = 30;
/// Range of covariance factors: standard deviations from 0.5 to 10 times the calibrated ones.
const FACTOR_RANGE: std::ops::RangeInclusive<f64> = 0.25..=100.0;

/// Motion errors of a room: the calibrated table with a factor per stratum. `mapped` holds the
/// mapped frames in order.
pub fn motion_errors(
    navigator: &Navigator,
    error_model: &ErrorModel,
    mapped: &[FrameId],
) -> Result<MotionErrors, Error> {
    let calibrated = &error_model.statistics().motion_errors;

    // Strata are in frame periods of the calibration rooms; convert them to rows of this room.
    let rows_per_frame = error_model.statistics().frame_period_s / frame_period_s(navigator.room());

    let mut strata = Vec::with_capacity(calibrated.shapes.strata().len());
    for stratum in calibrated.shapes.strata() {
        let stride = (stratum.at * rows_per_frame).round().max(1.0) as u32;
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

/// Covariance factor that calibrates errors with these squared Mahalanobis lengths.
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

    // If every second frame is mapped, no two are an odd number of rows apart: try the next row.
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

    let frames =
        |from: FrameId, to: FrameId| error_model.frames_in(seconds_between(room, from, to));
    let surprise = |(from, to): &(FrameId, FrameId)| {
        let latent_from = latents.row(from.row());
        let latent_to = latents.row(to.row());
        let difference = &latent_to.slice(coordinates) - &latent_from.slice(coordinates);
        let covariance = error_model.motion_errors(difference.view(), frames(*from, *to));

        let truth = body_twist(&room.poses()[from.row()], &room.poses()[to.row()]).to_vector();
        let read = adapter
            .motion_without_mean(latent_from, latent_to)
            .scaled(
                error_model
                    .statistics()
                    .motion_errors
                    .gain(frames(*from, *to)),
            )
            .to_vector();
        let error = truth - read;
        Some(error.dot(&covariance.cholesky()?.solve(&error)))
    };

    let every = pairs.len().div_ceil(SAMPLES).max(1);
    pairs.iter().step_by(every).filter_map(surprise).collect()
}

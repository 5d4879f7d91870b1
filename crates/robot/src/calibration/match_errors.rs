//! Errors of poses estimated from a matching frame, as a function of the match distance.

use nalgebra::Vector6;
use ndarray::Array2;

use super::Error;
use super::embedded_room::EmbeddedRoom;
use super::robust_covariance;
use seese3_core::adapter::{ErrorTable, Stratum};
use seese3_core::geometry::body_twist;
use seese3_core::index::{ExactIndex, Exclusion, Index};
use seese3_core::room::FrameId;
use seese3_core::statistics::median;

/// Exclusion radii in frames: one pass per radius excludes the frames within it of the query, so
/// that matches of all distances occur.
const LEFT_OUT_RADII: [u32; 10] = [0, 1, 2, 4, 6, 8, 10, 15, 20, 30];
/// Number of distance bins, each with about the same number of matches.
const STRATA: usize = 8;
/// A six-dimensional covariance needs more errors than this.
const FEWEST_ERRORS: usize = 6;

/// One match: its distance and the motion from the matching frame to the query.
struct Match {
    /// In standard deviations of frame noise.
    distance: f64,
    motion: Vector6<f64>,
}

/// Error table of poses estimated from matches, binned by distance. `whitened` holds the whitened
/// latents of each room, one row per frame.
pub fn match_errors(
    rooms: &[EmbeddedRoom<'_>],
    whitened: &[Array2<f64>],
) -> Result<ErrorTable, Error> {
    let mut matches = Vec::new();
    for (room, whitened) in rooms.iter().zip(whitened) {
        add_matches(room, whitened, &mut matches);
    }
    matches.sort_by(|a, b| a.distance.total_cmp(&b.distance));

    let mut strata: Vec<Stratum> = Vec::new();
    for part in matches.chunks(matches.len().div_ceil(STRATA).max(1)) {
        let distances: Vec<f64> = part.iter().map(|found| found.distance).collect();
        let at = median(&distances);
        let residuals: Vec<Vector6<f64>> = part.iter().map(|found| found.motion).collect();

        // Repeated images have distance 0. Their bin is skipped: distances must increase strictly.
        let previous = strata.last().map_or(0.0, |last| last.at);
        if at > previous && residuals.len() > FEWEST_ERRORS {
            strata.push(Stratum {
                at,
                covariance: robust_covariance(&residuals)?,
            });
        }
    }

    Ok(ErrorTable::new(strata)?)
}

/// Matches every frame of a room with the rest of the room, once per exclusion radius.
fn add_matches(room: &EmbeddedRoom<'_>, whitened: &Array2<f64>, matches: &mut Vec<Match>) {
    let frames: Vec<FrameId> = (0..whitened.nrows() as u32).map(FrameId).collect();
    let index = ExactIndex::new(whitened.view(), &frames);

    for radius in LEFT_OUT_RADII {
        for &center in &frames {
            let row = center.row();
            let query = whitened.row(row).to_vec();
            let nearest = index.nearest(&query, 1, Some(Exclusion { center, radius }));
            let Some(best) = nearest.first() else {
                continue;
            };

            let at = best.frame.row();
            matches.push(Match {
                distance: best.distance,
                motion: body_twist(&room.poses[at], &room.poses[row]).to_vector(),
            });
        }
    }
}

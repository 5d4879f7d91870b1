//! Statistics of recordings, so that drawn rooms can be compared with real ones.

use std::ops::Range;

use ndarray::{Array2, ArrayView1, ArrayView2, Axis, s};
use serde::Serialize;

use seese3_core::geometry::{Pose, PoseError, body_twist};
use seese3_core::nalgebra::{DMatrix, Vector3};
use seese3_core::room::{FrameId, Room};
use seese3_core::statistics::{mean, median};
use seese3_core::training::RoomData;

/// Frames of a step whose size is reported, two thirds of a second of a camera with 30 Hz.
const STEP: usize = 20;
/// Frames that lie between a frame and its revisit, at least.
const APART: usize = 50;
/// Bounds within which two views share a viewpoint, meters and radians.
const NEAR: (f64, f64) = (0.25, 15.0 * std::f64::consts::PI / 180.0);
/// Frames of a window whose participation ratio is taken. Windows have equal length, because the
/// ratio grows with the length of a recording.
const WINDOW: usize = 125;

/// Statistics of one recording. NaN where the recording is too short; a visit is a sequence.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RoomCard {
    /// The room.
    pub room: String,
    /// Source format of the recording.
    pub format: String,
    /// Number of frames.
    pub frames: usize,
    /// Number of visits.
    pub visits: usize,
    /// Median distance moved in 20 frames, meters.
    pub step_m: f64,
    /// Median rotation in 20 frames, degrees.
    pub step_deg: f64,
    /// Autocorrelation of the translation between successive frames, after 1, 10 and 20 frames.
    pub persistence_v: [f64; 3],
    /// Autocorrelation of the rotation between successive frames, after 1, 10 and 20 frames.
    pub persistence_w: [f64; 3],
    /// Fraction of frames with another frame of the same visit, more than 50 frames away, within
    /// 0.25 m and 15°.
    pub revisited: f64,
    /// Fraction of frames of later visits with a frame of an earlier visit within 0.25 m and 15°;
    /// `None` for a single visit.
    pub overlap: Option<f64>,
    /// For frames of later visits, the nearest frame of the earlier visits by feature; `None` for a
    /// single visit.
    pub across_by_feature: Option<MedianError>,
    /// The same by pose, meters plus radians: the best that retrieval can do.
    pub across_by_pose: Option<MedianError>,
    /// Participation ratio (Σλ)² / Σλ² of the covariance of the features of 125 successive frames:
    /// the mean over such windows. How many directions the features vary in.
    pub participation_ratio: f64,
    /// Root mean square of the change of features from frame to frame, in standard deviations.
    pub feature_step: f64,
}

/// Median errors of retrieved poses.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct MedianError {
    /// Meters.
    pub translation_m: f64,
    /// Degrees.
    pub rotation_deg: f64,
}

impl RoomCard {
    /// The statistics of a room with its features.
    pub fn of(data: &RoomData<'_>) -> Self {
        let room = data.room;
        let poses = room.poses();
        let recording = Recording {
            poses,
            visits: visits(room),
        };
        let rows = data.features.rows();
        let scaled = standardized(rows);

        let steps: Vec<PoseError> = recording
            .starts(STEP)
            .map(|row| PoseError::between(&poses[row], &poses[row + STEP]))
            .collect();
        let column = |of: fn(&PoseError) -> f64| median(&steps.iter().map(of).collect::<Vec<_>>());
        let windows = windows(&recording.visits);
        let ratios: Vec<f64> = windows
            .map(|window| participation_ratio(rows.slice(s![window, ..])))
            .collect();
        let changes: Vec<f64> = recording
            .starts(1)
            .map(|row| squared_distance(scaled.row(row), scaled.row(row + 1)))
            .collect();

        Self {
            room: room.id().to_string(),
            format: room.provenance().format.clone(),
            frames: poses.len(),
            visits: recording.visits.len(),
            step_m: column(|step| step.translation_m),
            step_deg: column(|step| step.rotation_rad.to_degrees()),
            persistence_v: recording.persistence(|a, b| body_twist(a, b).linear),
            persistence_w: recording.persistence(|a, b| body_twist(a, b).angular),
            revisited: recording.revisited(),
            overlap: recording.overlap(),
            across_by_feature: recording
                .across(|row, other| squared_distance(scaled.row(row), scaled.row(other))),
            across_by_pose: recording.across(|row, other| {
                let error = PoseError::between(&poses[row], &poses[other]);
                error.translation_m + error.rotation_rad
            }),
            participation_ratio: mean(&ratios),
            feature_step: (mean(&changes) / rows.ncols() as f64).sqrt(),
        }
    }
}

/// The poses of a recording and the rows of its visits.
struct Recording<'a> {
    poses: &'a [Pose],
    visits: Vec<Range<usize>>,
}

impl Recording<'_> {
    /// The rows that have another row of the same visit `lag` frames later.
    fn starts(&self, lag: usize) -> impl Iterator<Item = usize> {
        let of_visit = move |visit: &Range<usize>| visit.start..visit.end.saturating_sub(lag);
        self.visits.iter().flat_map(of_visit)
    }

    /// Autocorrelation of a velocity after 1, 10 and 20 frames.
    fn persistence(&self, velocity: fn(&Pose, &Pose) -> Vector3<f64>) -> [f64; 3] {
        let at = |row: usize| velocity(&self.poses[row], &self.poses[row + 1]);
        [1, 10, STEP].map(|lag| {
            let starts = self.starts(lag + 1);
            autocorrelation(starts.map(|row| [at(row), at(row + lag)]))
        })
    }

    fn revisited(&self) -> f64 {
        share(self.visits.iter().flat_map(|visit| {
            let has_revisit = |row: usize| {
                let mut others = visit.clone().filter(|other| other.abs_diff(row) > APART);
                others.any(|other| is_near(&self.poses[row], &self.poses[other]))
            };
            visit.clone().map(has_revisit)
        }))
    }

    /// The rows of later visits, each with the number of rows of earlier visits.
    fn later(&self) -> impl Iterator<Item = (usize, usize)> {
        let later = self.visits.iter().skip(1);
        later.flat_map(|visit| visit.clone().map(|row| (row, visit.start)))
    }

    fn overlap(&self) -> Option<f64> {
        let meets = |(row, earlier): (usize, usize)| {
            (0..earlier).any(|other| is_near(&self.poses[row], &self.poses[other]))
        };
        (self.visits.len() > 1).then(|| share(self.later().map(meets)))
    }

    /// Errors of the frames of earlier visits with the least distance to those of later visits.
    fn across(&self, distance: impl Fn(usize, usize) -> f64) -> Option<MedianError> {
        let retrieved = self.later().map(|(row, earlier)| {
            let nearest = least(earlier, |other| distance(row, other));
            (row, nearest)
        });
        MedianError::of(retrieved, self.poses)
    }
}

impl MedianError {
    /// Of pairs of a row and the row retrieved for it; `None` without any.
    fn of(retrieved: impl Iterator<Item = (usize, usize)>, poses: &[Pose]) -> Option<Self> {
        let errors: Vec<PoseError> = retrieved
            .map(|(row, other)| PoseError::between(&poses[row], &poses[other]))
            .collect();
        let column = |of: fn(&PoseError) -> f64| median(&errors.iter().map(of).collect::<Vec<_>>());
        (!errors.is_empty()).then(|| Self {
            translation_m: column(|error| error.translation_m),
            rotation_deg: column(|error| error.rotation_rad.to_degrees()),
        })
    }
}

/// The rows of each visit.
fn visits(room: &Room) -> Vec<Range<usize>> {
    let frame = |row: usize| FrameId(row as u32);
    let joins = |row: usize| room.timeline().joins(frame(row - 1), frame(row));
    let mut visits: Vec<Range<usize>> = Vec::new();
    for row in 0..room.frame_count() {
        match visits.last_mut() {
            Some(visit) if joins(row) => visit.end = row + 1,
            _ => visits.push(row..row + 1),
        }
    }
    visits
}

/// The windows of 125 frames within visits.
fn windows(visits: &[Range<usize>]) -> impl Iterator<Item = Range<usize>> {
    visits.iter().flat_map(|visit| {
        let starts = visit.clone().step_by(WINDOW);
        let end = visit.end;
        starts
            .filter(move |start| start + WINDOW <= end)
            .map(|start| start..start + WINDOW)
    })
}

fn is_near(a: &Pose, b: &Pose) -> bool {
    let error = PoseError::between(a, b);
    error.translation_m <= NEAR.0 && error.rotation_rad <= NEAR.1
}

/// The row below `count` with the least distance; the first of equals. `count` is above 0.
fn least(count: usize, distance: impl Fn(usize) -> f64) -> usize {
    let distances = (0..count).map(|row| (distance(row), row));
    let best = distances.min_by(|a, b| a.0.total_cmp(&b.0));
    best.map_or(0, |(_, row)| row)
}

fn share(of: impl Iterator<Item = bool>) -> f64 {
    let all: Vec<f64> = of.map(|holds| f64::from(u8::from(holds))).collect();
    mean(&all)
}

/// Σ a·b / √(Σ a² Σ b²) over pairs of vectors; NaN without any.
fn autocorrelation(pairs: impl Iterator<Item = [Vector3<f64>; 2]>) -> f64 {
    let [mut product, mut first, mut second] = [0.0; 3];
    for [a, b] in pairs {
        product += a.dot(&b);
        first += a.norm_squared();
        second += b.norm_squared();
    }
    product / (first * second).sqrt()
}

fn squared_distance(a: ArrayView1<'_, f64>, b: ArrayView1<'_, f64>) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum()
}

/// Columns divided by their standard deviations; a constant column is zero.
fn standardized(rows: ArrayView2<'_, f32>) -> Array2<f64> {
    let mut scaled = rows.mapv(f64::from);
    for mut column in scaled.axis_iter_mut(Axis(1)) {
        let spread = column.std(0.0);
        let factor = if spread > 0.0 { 1.0 / spread } else { 0.0 };
        column.mapv_inplace(|value| value * factor);
    }
    scaled
}

/// (Σλ)² / Σλ² of the covariance of rows, from their Gram matrix.
fn participation_ratio(rows: ArrayView2<'_, f32>) -> f64 {
    let mut centered = rows.mapv(f64::from);
    for mut column in centered.axis_iter_mut(Axis(1)) {
        let center = column.sum() / column.len() as f64;
        column.mapv_inplace(|value| value - center);
    }

    let gram = centered.dot(&centered.t());
    let gram = DMatrix::from_fn(gram.nrows(), gram.ncols(), |row, column| {
        gram[[row, column]]
    });
    gram.trace().powi(2) / gram.norm_squared()
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::array;
    use seese3_core::features::{FeatureSource, Features};
    use seese3_core::room::{Frames, Provenance, RoomId};

    /// Oracle: by hand: variances 1, 1 and 0 along three axes have the ratio (1 + 1)² / (1 + 1).
    #[test]
    fn the_participation_ratio_counts_directions() {
        let plane = array![
            [1.0, 0.0, 5.0],
            [-1.0, 0.0, 5.0],
            [0.0, 1.0, 5.0],
            [0.0, -1.0, 5.0]
        ];
        assert!((participation_ratio(plane.view()) - 2.0).abs() < 1e-12);
        let line = array![[1.0, 1.0], [2.0, 2.0], [4.0, 4.0]];
        assert!((participation_ratio(line.view()) - 1.0).abs() < 1e-12);
    }

    /// Oracle: by hand. Two visits along x at 1 cm a frame, the second 0.1 m above the first and
    /// from its middle on: velocities persist fully, half of the second visit's views are more than
    /// 0.25 m beyond the end of the first, and the feature x retrieves the pose below.
    #[test]
    fn visits_are_compared_with_earlier_ones() {
        let pose = |row: usize| {
            let (visit, frame) = (row / 200, row % 200);
            let x = 0.01 * frame as f64 + f64::from(visit as u32);
            Pose::translation(x, 0.0, 0.1 * visit as f64)
        };
        let poses: Vec<Pose> = (0..400).map(pose).collect();
        let positions = poses.iter().map(|pose| pose.translation.vector.x as f32);
        let positions = Array2::from_shape_vec((400, 1), positions.collect()).unwrap();
        let frames = Frames {
            sequences: (0..400).map(|row| row / 200).collect(),
            poses,
            ..Frames::default()
        };
        let room = Room::new(RoomId::new("r").unwrap(), frames, Provenance::default()).unwrap();
        let features = Features::new(FeatureSource::imported("x", 1), positions).unwrap();
        let card = RoomCard::of(&RoomData {
            room: &room,
            revision: 1,
            features: &features,
        });

        assert_eq!((card.visits, card.frames), (2, 400));
        assert!((card.step_m - 0.2).abs() < 1e-9 && card.step_deg < 1e-9);
        assert!(
            card.persistence_v
                .iter()
                .all(|share| (share - 1.0).abs() < 1e-9)
        );
        assert_eq!(card.revisited, 0.0);
        // Within 0.25 m at a height of 0.1 m: up to 0.229 m beyond the last x of 1.99 m.
        assert!(
            (card.overlap.unwrap() - 122.0 / 200.0).abs() < 1e-9,
            "{card:?}"
        );
        let [by_feature, by_pose] =
            [card.across_by_feature, card.across_by_pose].map(Option::unwrap);
        assert_eq!(by_feature, by_pose);
        assert!(
            (by_feature.translation_m - 0.1).abs() < 0.01,
            "{by_feature:?}"
        );
        assert!((card.participation_ratio - 1.0).abs() < 1e-9);
    }
}

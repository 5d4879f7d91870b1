//! Checks whether the poses of a recording match its images.
//!
//! Poses in a wrong convention (inverted, or along other axes) train and score almost as well
//! as right ones, and then mislead their users. The images are independent evidence: when a camera
//! turns right, the image moves left. The check compares image motion ([`crate::image_motion`])
//! with the motion of the poses, read in every common convention.
//!
//! | what the camera does | what the image does |
//! | --- | --- |
//! | turns right, ω_y | shifts left by focal · ω_y |
//! | turns up, ω_x | shifts down by focal · ω_x |
//! | turns clockwise, ω_z | turns the other way by ω_z |
//! | moves right, t_x, or down, t_y | shifts left or up by focal · t / depth |
//! | moves forward, t_z | grows by t_z / depth |
//!
//! Focal length and depth are unknown. They are fitted as non-negative factors, and reported: a
//! wrong unit of length shows as an impossible depth.
//!
//! | file | what |
//! | --- | --- |
//! | `convention` | pose conventions and their conversion |
//! | `translations` | ways in which only the translations are wrong |
//! | `motion_fit` | share of the image motion that poses explain |
//! | `evidence` | whether a small difference is consistent throughout a recording |
//! | `path` | statistics of the poses alone: extents, steps, jumps |
//! | `camera_fit` | focal length and radial distortion from epipolar errors |
//! | `report` | [`check_room`]: all checks of a room, and the warnings in words |
//!
//! Not a method of the paper. The limits were chosen on a real recording and on drawn rooms;
//! docs/rooms-and-encoders.md reports the results on held-out rooms that were drawn afterwards.

mod camera_fit;
mod convention;
mod evidence;
mod motion_fit;
mod path;
mod report;
mod translations;

pub use camera_fit::{CameraFitError, FittedCamera};
pub use convention::{Axes, Convention, Direction, QuaternionOrder};
pub use motion_fit::SceneEstimate;
pub use path::{PathFacts, PathWarning, is_identity};
pub use report::{ImageReport, LengthUnit, PoseReport, PoseWarning, RoomImages, check_room};
pub use translations::Translations;

use crate::image_motion::ImageMotion;
use evidence::Residuals;
use motion_fit::{MotionFit, fit_motions, unexplained};
use seese3_core::geometry::Pose;
use seese3_core::room::{FrameId, Room};

/// Maximum number of frame pairs to compare.
const PAIRS: usize = 100;
/// Preferred rotation between the frames of a pair, radians (3 degrees): large enough to measure,
/// small enough to align.
const WANTED_TURN_RAD: f64 = 0.052;
/// Maximum distance between the frames of a pair, rows.
const FURTHEST_ROWS: u32 = 60;
/// Minimum correlation of a usable alignment.
const LEAST_CORRELATION: f64 = 0.7;
/// Minimum number of usable pairs for a verdict.
const FEWEST_PAIRS: usize = 12;
/// Minimum mean image shift for a verdict, image widths. The same number, in radians, bounds the
/// mean turn of an image that stands still.
const LEAST_MOTION: f64 = 0.005;

/// Minimum explained share of poses that agree with the images.
const AGREES: f64 = 0.6;
/// Minimum explained share to report another convention, mirrored images or transposed rotations.
const EXPLAINS: f64 = 0.6;
/// Minimum gain over the stated convention to report another one.
const BETTER_BY: f64 = 0.15;
/// Minimum gain to report another convention if the gain is consistent throughout the recording.
const THROUGHOUT_BETTER_BY: f64 = 0.05;
/// Minimum gain over the stated translations to report others.
const TRANSLATIONS_BETTER_BY: f64 = 0.05;
/// Minimum gain to report other translations if the gain is consistent throughout the recording.
const TRANSLATIONS_THROUGHOUT_BETTER_BY: f64 = 0.015;
/// Minimum explained share to report other translations. It is higher than [`EXPLAINS`], because
/// the best of 49 candidates explains much by chance.
const TRANSLATIONS_EXPLAIN: f64 = 0.7;
/// Minimum gain of mirrored images or transposed rotations over the best convention and the best
/// translations.
const RARER_BETTER_BY: f64 = 0.07;
/// Mean rotation of the poses, radians, from which still images contradict them.
const SURE_TURN_RAD: f64 = 0.03;
/// Minimum gain of shifted over unshifted poses to report a row shift.
const ROWS_BETTER_BY: f64 = 0.02;
/// Minimum explained share to report a row shift. It is higher than [`EXPLAINS`], because the best
/// of 121 shifts explains much by chance.
const ROWS_EXPLAIN: f64 = 0.75;
/// Maximum shift between poses and images that is tried, rows.
const FURTHEST_SHIFT: i64 = 60;
/// Explained shares that differ by at most this count as equally good.
const AS_GOOD: f64 = 0.03;
/// Below this explained share, poses are unrelated to the images if no mistake explains them.
const UNRELATED: f64 = 0.4;

/// Two frames of a recording and the image motion between them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ObservedPair {
    /// The frame at which the motion starts.
    pub first: FrameId,
    /// The frame at which the motion ends.
    pub second: FrameId,
    /// The motion of the content from the first image to the second.
    pub motion: ImageMotion,
    /// The brightness correlation of the aligned images, -1 to 1.
    pub correlation: f64,
}

/// The result of comparing poses with images.
///
/// `explained` is the share of the image motion that poses explain, 0 to 1.
#[derive(Debug, Clone, PartialEq)]
pub enum Verdict {
    /// The poses match the images.
    Agrees(SceneEstimate),
    /// The poses are in another convention.
    OtherConvention {
        /// The likely conventions, the best first.
        likely: Vec<Convention>,
        /// The share explained in the best of them.
        explained: f64,
    },
    /// The images are mirrored: left and right are exchanged.
    MirroredImages {
        /// The likely conventions of the poses, the best first.
        likely: Vec<Convention>,
        /// The share of the mirrored motion explained in the best of them.
        explained: f64,
    },
    /// The translations are right, but the rotations are inverted.
    TransposedRotations {
        /// The share explained with inverted rotations.
        explained: f64,
    },
    /// The rotations are right, but the translations do not match them.
    OtherTranslations {
        /// The likely translations.
        likely: Translations,
        /// The share explained with them.
        explained: f64,
    },
    /// The pose in row r belongs to the image in row r + `rows`.
    OtherRows {
        /// The number of rows.
        rows: i64,
        /// The share explained by the shifted poses.
        explained: f64,
    },
    /// The poses do not explain the image motion, or turn while the images stand still. They are of
    /// other images, in another order, or of another recording.
    Unrelated {
        /// The share explained in the best convention.
        explained: f64,
    },
    /// Poses and images neither contradict each other nor agree well.
    Unclear {
        /// The share explained in the best convention.
        explained: f64,
    },
    /// Too few pairs of frames could be aligned.
    TooFewPairs,
    /// The images hardly move.
    TooLittleMotion,
}

impl Verdict {
    /// Whether the poses are certainly not those of the images.
    pub fn is_contradiction(&self) -> bool {
        match self {
            Self::OtherConvention { .. }
            | Self::MirroredImages { .. }
            | Self::TransposedRotations { .. }
            | Self::OtherTranslations { .. }
            | Self::OtherRows { .. }
            | Self::Unrelated { .. } => true,
            Self::Agrees(_) | Self::Unclear { .. } | Self::TooFewPairs | Self::TooLittleMotion => {
                false
            }
        }
    }

    /// The name of this verdict in machine-readable reports.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Agrees(_) => "agrees",
            Self::OtherConvention { .. } => "other_convention",
            Self::MirroredImages { .. } => "mirrored_images",
            Self::TransposedRotations { .. } => "transposed_rotations",
            Self::OtherTranslations { .. } => "other_translations",
            Self::OtherRows { .. } => "other_rows",
            Self::Unrelated { .. } => "unrelated",
            Self::Unclear { .. } => "unclear",
            Self::TooFewPairs => "too_few_pairs",
            Self::TooLittleMotion => "too_little_motion",
        }
    }
}

/// The comparison of poses with images.
#[derive(Debug, Clone, PartialEq)]
pub struct PoseCheck {
    /// The result.
    pub verdict: Verdict,
    /// The share of the image motion that the poses explain as stated, 0 to 1; 0 if nothing was
    /// compared.
    pub explained: f64,
    /// The number of usable pairs.
    pub pair_count: usize,
}

/// Selects frame pairs to compare, spread over the recording.
pub fn pairs_to_look_at(room: &Room) -> Vec<(FrameId, FrameId)> {
    let frame_count = room.frame_count() as u32;
    let every = room.frame_count().div_ceil(PAIRS);

    let starts = (0..frame_count).step_by(every).map(FrameId);
    let pairs = starts.filter_map(|first| Some((first, turned_since(room, first)?)));
    pairs.take(PAIRS).collect()
}

/// The next frame of the same sequence that is turned by [`WANTED_TURN_RAD`] or more; if there is
/// none within [`FURTHEST_ROWS`], the most turned one. `None` at the end of a sequence.
fn turned_since(room: &Room, first: FrameId) -> Option<FrameId> {
    let poses = room.poses();
    let turn = |other: &FrameId| {
        let rotation = poses[other.row()].rotation;
        poses[first.row()].rotation.angle_to(&rotation)
    };

    let end = (first.0 + FURTHEST_ROWS).min(room.frame_count() as u32 - 1);
    let later = (first.0 + 1..=end).map(FrameId);
    let later: Vec<FrameId> = later
        .take_while(|other| room.timeline().joins(first, *other))
        .collect();

    let enough = later.iter().find(|other| turn(other) >= WANTED_TURN_RAD);
    let most = later.iter().max_by(|a, b| turn(a).total_cmp(&turn(b)));
    enough.or(most).copied()
}

/// Compares poses with image motion.
///
/// `poses` are as stated, one per frame; `read_as` is the convention in which they are interpreted.
pub fn check(poses: &[Pose], read_as: Convention, observed: &[ObservedPair]) -> PoseCheck {
    let observed: Vec<ObservedPair> = observed
        .iter()
        .filter(|pair| pair.correlation >= LEAST_CORRELATION)
        .copied()
        .collect();
    let pair_count = observed.len();
    let nothing = |verdict| PoseCheck {
        verdict,
        explained: 0.0,
        pair_count,
    };
    if pair_count < FEWEST_PAIRS {
        return nothing(Verdict::TooFewPairs);
    }

    let mean = |numbers: &mut dyn Iterator<Item = f64>| numbers.sum::<f64>() / pair_count as f64;
    let shift = mean(&mut observed.iter().map(|pair| pair.motion.shift.norm()));
    let turn = mean(&mut observed.iter().map(|pair| pair.motion.turn.abs()));
    if shift < LEAST_MOTION {
        let stated = motions(poses, read_as, &observed);
        let stated_turn = mean(&mut stated.iter().map(|motion| motion.rotation.angle()));
        return nothing(if stated_turn >= SURE_TURN_RAD && turn < LEAST_MOTION {
            Verdict::Unrelated { explained: 0.0 }
        } else {
            Verdict::TooLittleMotion
        });
    }

    let stated = fit_motions(&motions(poses, read_as, &observed), &observed);
    PoseCheck {
        verdict: verdict(poses, read_as, &observed, &stated),
        explained: stated.explained,
        pair_count,
    }
}

fn verdict(
    poses: &[Pose],
    read_as: Convention,
    observed: &[ObservedPair],
    stated: &MotionFit,
) -> Verdict {
    let conventions = RankedConventions::of(poses, observed);
    let best = conventions.explained;
    let (translations, with_translations) = best_translations(poses, read_as, observed);

    if let Some(mistake) = rarer_mistake(poses, read_as, observed, best.max(with_translations)) {
        return mistake;
    }
    let of_stated = motions(poses, read_as, observed);
    let is_throughout = |other: &[Pose]| {
        let residuals = Residuals {
            stated: unexplained(&of_stated, observed),
            other: unexplained(other, observed),
        };
        residuals.is_other_better_throughout()
    };

    let gain = best - stated.explained;
    let is_better = gain >= BETTER_BY
        || (gain >= THROUGHOUT_BETTER_BY
            && is_throughout(&motions(poses, conventions.likely[0], observed)));
    if best >= EXPLAINS && best + AS_GOOD >= with_translations && is_better {
        return Verdict::OtherConvention {
            likely: conventions.likely,
            explained: best,
        };
    }

    // If a row shift and other translations both explain the motion, the better one is reported.
    let shifted = best_shift(poses, read_as, observed);
    let by_shift = shifted.map_or(0.0, |shift| shift.explained);
    let gain = with_translations - stated.explained;
    let is_better = gain >= TRANSLATIONS_BETTER_BY
        || (gain >= TRANSLATIONS_THROUGHOUT_BETTER_BY
            && is_throughout(&motions_with(translations, poses, read_as, observed)));
    if with_translations >= TRANSLATIONS_EXPLAIN && with_translations >= by_shift && is_better {
        return Verdict::OtherTranslations {
            likely: translations,
            explained: with_translations,
        };
    }
    if let Some(Shift { rows, explained }) = shifted {
        return Verdict::OtherRows { rows, explained };
    }

    if stated.explained >= AGREES {
        Verdict::Agrees(stated.seen)
    } else if stated.explained < UNRELATED {
        Verdict::Unrelated { explained: best }
    } else {
        Verdict::Unclear { explained: best }
    }
}

/// The conventions that explain most of the motion.
struct RankedConventions {
    /// The best first; the others explain at most [`AS_GOOD`] less.
    likely: Vec<Convention>,
    /// The share explained in the best one, 0 to 1.
    explained: f64,
}

impl RankedConventions {
    fn of(poses: &[Pose], observed: &[ObservedPair]) -> Self {
        let explained = |convention: Convention| {
            let motions = motions(poses, convention, observed);
            (fit_motions(&motions, observed).explained, convention)
        };
        let mut readings: Vec<(f64, Convention)> =
            Convention::all().into_iter().map(explained).collect();
        readings.sort_by(|a, b| b.0.total_cmp(&a.0));

        let best = readings[0].0;
        readings.retain(|(explained, _)| best - explained <= AS_GOOD);
        Self {
            likely: readings.into_iter().map(|(_, likely)| likely).collect(),
            explained: best,
        }
    }
}

/// The verdict of mirrored images or transposed rotations, if it explains clearly more than
/// `usual`, the share explained by the best of the more common mistakes.
fn rarer_mistake(
    poses: &[Pose],
    read_as: Convention,
    observed: &[ObservedPair],
    usual: f64,
) -> Option<Verdict> {
    let transposed = |pose: &Pose| Pose::from_parts(pose.translation, pose.rotation.inverse());
    let transposed: Vec<Pose> = poses.iter().map(transposed).collect();
    let transposed = fit_motions(&motions(&transposed, read_as, observed), observed).explained;
    let mirrored = RankedConventions::of(poses, &mirrored(observed));

    let explained = transposed.max(mirrored.explained);
    if explained < EXPLAINS || explained - usual < RARER_BETTER_BY {
        return None;
    }
    Some(if transposed >= mirrored.explained {
        Verdict::TransposedRotations { explained }
    } else {
        Verdict::MirroredImages {
            likely: mirrored.likely,
            explained,
        }
    })
}

/// The observed motions with left and right exchanged.
fn mirrored(observed: &[ObservedPair]) -> Vec<ObservedPair> {
    let mirrored = |pair: &ObservedPair| {
        let mut pair = *pair;
        pair.motion.shift.x = -pair.motion.shift.x;
        pair.motion.turn = -pair.motion.turn;
        pair
    };
    observed.iter().map(mirrored).collect()
}

/// A shift of poses to images some rows later, and the share of the motion that they then explain.
#[derive(Debug, Clone, Copy)]
struct Shift {
    rows: i64,
    explained: f64,
}

/// The row shift that explains most, if it explains enough and clearly more than no shift.
fn best_shift(poses: &[Pose], read_as: Convention, observed: &[ObservedPair]) -> Option<Shift> {
    let mut best = Shift {
        rows: 0,
        explained: 0.0,
    };
    for rows in -FURTHEST_SHIFT..=FURTHEST_SHIFT {
        // The image in row r takes the pose in row r − rows.
        let shifted = |frame: FrameId| {
            let row = i64::from(frame.0) - rows;
            let is_there = (0..poses.len() as i64).contains(&row);
            is_there.then_some(FrameId(row as u32))
        };
        let moved = observed.iter().filter_map(|pair| {
            Some(ObservedPair {
                first: shifted(pair.first)?,
                second: shifted(pair.second)?,
                ..*pair
            })
        });
        let moved: Vec<ObservedPair> = moved.collect();
        if moved.len() < FEWEST_PAIRS {
            continue;
        }

        // The unshifted poses are evaluated on the same pairs.
        let back = |frame: FrameId| FrameId((i64::from(frame.0) + rows) as u32);
        let there = moved.iter().map(|pair| ObservedPair {
            first: back(pair.first),
            second: back(pair.second),
            ..*pair
        });
        let there: Vec<ObservedPair> = there.collect();
        let explained = fit_motions(&motions(poses, read_as, &moved), &moved).explained;
        let stated = fit_motions(&motions(poses, read_as, &there), &there).explained;
        if explained - stated >= ROWS_BETTER_BY && explained > best.explained {
            best = Shift { rows, explained };
        }
    }

    (best.explained >= ROWS_EXPLAIN).then_some(best)
}

/// The translations that explain most with the stated rotations, and the share explained. Of ties,
/// the first wins; the stated ones come first.
fn best_translations(
    poses: &[Pose],
    read_as: Convention,
    observed: &[ObservedPair],
) -> (Translations, f64) {
    let mut best = (Translations::STATED, 0.0);
    for translations in Translations::all() {
        let motions = motions_with(translations, poses, read_as, observed);
        let explained = fit_motions(&motions, observed).explained;
        if explained > best.1 {
            best = (translations, explained);
        }
    }
    best
}

/// The camera motions of the pairs with reinterpreted translations.
fn motions_with(
    translations: Translations,
    poses: &[Pose],
    read_as: Convention,
    observed: &[ObservedPair],
) -> Vec<Pose> {
    let meant = |frame: FrameId| {
        let read = read_as.to_world_from_camera(&poses[frame.row()]);
        translations.meant(&read)
    };
    observed
        .iter()
        .map(|pair| meant(pair.first).inverse() * meant(pair.second))
        .collect()
}

/// The camera motions of the pairs with poses read in a convention.
fn motions(poses: &[Pose], convention: Convention, observed: &[ObservedPair]) -> Vec<Pose> {
    let read = |frame: FrameId| convention.to_world_from_camera(&poses[frame.row()]);
    let motion = |pair: &ObservedPair| read(pair.first).inverse() * read(pair.second);

    observed.iter().map(motion).collect()
}

//! Whether the poses of a recording can be those of its images.
//!
//! Poses in a wrong convention (inverted, along other axes, of other frames) train and score almost
//! as well as right ones, and then mislead whoever uses them. The images know better: when a camera
//! turns right, everything moves left. So the motion of the images ([`crate::image_motion`]) is
//! compared with the motion that the poses state, read in every convention that is in use.
//!
//! | what the camera does | what the image does |
//! | --- | --- |
//! | turns right, ω_y | shifts left by focal · ω_y |
//! | turns up, ω_x | shifts down by focal · ω_x |
//! | turns clockwise, ω_z | turns the other way by ω_z |
//! | moves right, t_x, or down, t_y | shifts left or up by focal · t / depth |
//! | moves forward, t_z | grows by t_z / depth |
//!
//! The focal length and the depth are not known. They are fitted, may not be negative, and are worth
//! reading themselves: a wrong unit of length shows as an impossible depth.
//!
//! | file | what |
//! | --- | --- |
//! | `convention` | the conventions and how each is read |
//! | `translations` | ways in which translations alone can be wrong |
//! | `motion_fit` | how well poses explain the motion of images |
//! | `evidence` | whether a small difference shows throughout a recording |
//! | `path` | what the poses alone tell: extents, steps, jumps |
//! | `report` | [`check_room`]: all checks of a room, and the warnings in words |
//!
//! Not a method of the paper. The limits were chosen on a real recording and on drawn rooms;
//! docs/rooms-and-encoders.md reports them on rooms that were drawn afterwards.

mod convention;
mod evidence;
mod motion_fit;
mod path;
mod report;
mod translations;

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

/// Pairs of frames that are looked at.
const PAIRS: usize = 100;
/// Between the frames of a pair the camera should turn by this, radians: 3 degrees, enough to see and
/// not too much to follow.
const WANTED_TURN_RAD: f64 = 0.052;
/// The frames of a pair are at most this many rows apart.
const FURTHEST_ROWS: u32 = 60;
/// Alignments with a lower correlation are not used.
const LEAST_CORRELATION: f64 = 0.7;
/// Fewer pairs than this decide nothing.
const FEWEST_PAIRS: usize = 12;
/// Images that move less than this on average, image widths, decide nothing.
const LEAST_MOTION: f64 = 0.005;

/// Poses that explain this share of the images' motion agree with it.
const AGREES: f64 = 0.6;
/// Another convention is named where it explains this share at least,
const EXPLAINS: f64 = 0.6;
/// and by this much more than the stated one,
const BETTER_BY: f64 = 0.15;
/// or by this much, if it shows throughout the recording.
const THROUGHOUT_BETTER_BY: f64 = 0.05;
/// Other translations are named where they explain by this much more than the stated ones,
const TRANSLATIONS_BETTER_BY: f64 = 0.05;
/// or by this much, if it shows throughout the recording.
const TRANSLATIONS_THROUGHOUT_BETTER_BY: f64 = 0.015;
/// Other translations have to explain this share at least: of 49, one explains much by chance.
const TRANSLATIONS_EXPLAIN: f64 = 0.7;
/// Mirrored images and transposed rotations are named where they explain by this much more than every
/// convention and every way to write translations.
const RARER_BETTER_BY: f64 = 0.07;
/// Where poses turn by this on average, radians, images that stand still are not theirs.
const SURE_TURN_RAD: f64 = 0.03;
/// Poses of other frames are named where they explain by this much more than those of the same,
const ROWS_BETTER_BY: f64 = 0.02;
/// and this share at least: of 121 places to look for them, one explains much by chance.
const ROWS_EXPLAIN: f64 = 0.75;
/// Poses are looked for so many rows away from their images.
const FURTHEST_SHIFT: i64 = 60;
/// Conventions within this of the best one may be meant as well.
const AS_GOOD: f64 = 0.03;
/// Poses that explain less than this are not those of the images, where no mistake explains enough.
const UNRELATED: f64 = 0.4;

/// Two frames of a recording and how the image moved between them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ObservedPair {
    /// The frame that the motion starts from.
    pub first: FrameId,
    /// The frame that it leads to.
    pub second: FrameId,
    /// Where the contents of the first image are in the second.
    pub motion: ImageMotion,
    /// How alike the two images are when laid over one another, -1 to 1.
    pub correlation: f64,
}

/// What a comparison of poses and images says.
#[derive(Debug, Clone, PartialEq)]
pub enum Verdict {
    /// The poses can be those of the images.
    Agrees(SceneEstimate),
    /// The poses are written in another convention.
    OtherConvention {
        /// The likely ones, the best first.
        likely: Vec<Convention>,
        /// How much of the motion the best of them explains, 0 to 1.
        explained: f64,
    },
    /// The images are mirrored: left and right are exchanged.
    MirroredImages {
        /// In which conventions the poses then explain the motion, the best first.
        likely: Vec<Convention>,
        /// How much of the motion the best of them explains, 0 to 1.
        explained: f64,
    },
    /// The translations are right, and the rotations are those of the inverse.
    TransposedRotations {
        /// How much of the motion is explained with rotations turned round, 0 to 1.
        explained: f64,
    },
    /// The rotations are right, and the translations do not go with them.
    OtherTranslations {
        /// The likely ones.
        likely: Translations,
        /// How much of the motion they explain, 0 to 1.
        explained: f64,
    },
    /// The poses are those of images so many rows later, or earlier if below 0.
    OtherRows {
        /// The rows.
        rows: i64,
        /// How much of the motion the poses then explain, 0 to 1.
        explained: f64,
    },
    /// The images move, and no convention makes the poses explain how: they are of other frames, in
    /// another order, or of another recording.
    Unrelated {
        /// How much of the motion the best convention explains, 0 to 1.
        explained: f64,
    },
    /// Poses and images do not contradict each other, and do not agree well either.
    Unclear {
        /// How much of the motion the best convention explains, 0 to 1.
        explained: f64,
    },
    /// Too few pairs of frames could be laid over one another.
    TooFewPairs,
    /// The camera hardly moves.
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
    /// What it says.
    pub verdict: Verdict,
    /// How much of the images' motion the poses explain as they are, 0 to 1; 0 if nothing was
    /// compared.
    pub explained: f64,
    /// The pairs that were compared.
    pub pair_count: usize,
}

/// Pairs of frames to look at, spread over the recording.
pub fn pairs_to_look_at(room: &Room) -> Vec<(FrameId, FrameId)> {
    let frame_count = room.frame_count() as u32;
    let every = room.frame_count().div_ceil(PAIRS);

    let starts = (0..frame_count).step_by(every).map(FrameId);
    let pairs = starts.filter_map(|first| Some((first, turned_since(room, first)?)));
    pairs.take(PAIRS).collect()
}

/// The next frame of the same sequence at which the camera has turned by enough; if there is none,
/// the one at which it has turned most. None at the end of a sequence.
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

/// Compares poses with how images moved.
///
/// `poses` are as they were stated, one a frame; `read_as` is the convention in which they are taken.
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

    // Where other rows and other translations both would explain it, the better ones are meant.
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

/// The conventions that explain most, and how much that is.
struct RankedConventions {
    /// The best first; those after it explain hardly less.
    likely: Vec<Convention>,
    /// What the best one explains, 0 to 1.
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

/// The verdict that images are mirrored or rotations transposed, if that explains much more than
/// anything more usual, of which the best explains `usual`.
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

/// How the images would have moved with left and right exchanged.
fn mirrored(observed: &[ObservedPair]) -> Vec<ObservedPair> {
    let mirrored = |pair: &ObservedPair| {
        let mut pair = *pair;
        pair.motion.shift.x = -pair.motion.shift.x;
        pair.motion.turn = -pair.motion.turn;
        pair
    };
    observed.iter().map(mirrored).collect()
}

/// Poses that are those of images so many rows later, and how much they explain then.
#[derive(Debug, Clone, Copy)]
struct Shift {
    rows: i64,
    explained: f64,
}

/// The rows by which poses are shifted, if they are.
fn best_shift(poses: &[Pose], read_as: Convention, observed: &[ObservedPair]) -> Option<Shift> {
    let mut best = Shift {
        rows: 0,
        explained: 0.0,
    };
    for rows in -FURTHEST_SHIFT..=FURTHEST_SHIFT {
        // The pose of an image stands so many rows before it.
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

        // Compared with the stated rows on the same pairs.
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

/// The translations that explain most beside the stated rotations, and how much that is. Of those that
/// explain the same, the first: the stated ones.
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

/// The camera motions of the pairs, if translations were written down in another way.
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

/// The stated camera motions of the pairs, if poses are read in a convention.
fn motions(poses: &[Pose], convention: Convention, observed: &[ObservedPair]) -> Vec<Pose> {
    let read = |frame: FrameId| convention.to_world_from_camera(&poses[frame.row()]);
    let motion = |pair: &ObservedPair| read(pair.first).inverse() * read(pair.second);

    observed.iter().map(motion).collect()
}

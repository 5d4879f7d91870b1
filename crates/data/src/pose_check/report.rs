//! The whole check of a room: its path, its images, the verdict, and the warnings.

use std::collections::BTreeMap;
use std::fmt;

use super::camera_fit::CameraEvidence;
use super::{
    CameraFitError, Convention, FittedCamera, ObservedPair, PathFacts, PathWarning, PoseCheck,
    SceneEstimate, Translations, Verdict, check, is_identity, pairs_to_look_at,
};
use crate::image_motion::{SmallImage, align};
use seese3_core::geometry::{CameraIntrinsics, Pose};
use seese3_core::image::RgbImage;
use seese3_core::room::{FrameId, Room};

/// Usual distance of visible surfaces, meters. A fitted depth outside of it suggests another unit
/// of length.
const USUAL_DEPTH_M: std::ops::Range<f64> = 0.4..40.0;
/// Largest factor between the stated and the fitted focal length without a warning.
const FOCAL_FACTOR: f64 = 1.4;
/// Largest relative difference between the aspect ratios of the stated camera and of an image.
const ASPECT_TOLERANCE: f64 = 0.02;

/// Returns the width and height of an image, pixels, or the reason why it cannot be read.
type SizeOf<'a> = dyn Fn(&str) -> Result<(u32, u32), String> + 'a;

/// Access to the images of a room, which this crate does not decode itself.
pub struct RoomImages<'a> {
    /// Reads the size of an image from its header.
    pub size: &'a SizeOf<'a>,
    /// Decodes an image; `None` if it cannot be read.
    pub read: &'a dyn Fn(&str) -> Option<RgbImage>,
    /// The room's poses in meters, before they are converted by `read_as`; one per frame.
    pub stated: &'a [Pose],
    /// The convention in which the stated poses are read.
    pub read_as: Convention,
    /// Called with the numbers of compared and of all pairs.
    pub progress: &'a dyn Fn(usize, usize),
}

/// Facts about a room's poses and images, and warnings about them.
#[derive(Debug, Clone, PartialEq)]
pub struct PoseReport {
    /// The path of the camera; `None` if no two frames follow each other.
    pub path: Option<PathFacts>,
    /// The images; `None` if they were not compared.
    pub images: Option<ImageReport>,
    /// What looks wrong.
    pub warnings: Vec<PoseWarning>,
}

/// Facts about a room's images, and their comparison with the poses.
#[derive(Debug, Clone, PartialEq)]
pub struct ImageReport {
    /// Number of images by width and height, pixels.
    pub sizes: BTreeMap<(u32, u32), usize>,
    /// Number of images that cannot be read.
    pub unreadable_count: usize,
    /// The comparison with the poses.
    pub check: PoseCheck,
    /// The camera fitted to the images; `None` if the poses do not agree with the images.
    pub camera_fit: Option<Result<FittedCamera, CameraFitError>>,
    /// Whether no pair was left to compare, because all poses are equal or those of lost tracking.
    pub is_all_lost: bool,
}

/// Unit of length that the translations may be in instead of meters.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LengthUnit {
    /// 0.001 m.
    Millimeters,
    /// 0.01 m.
    Centimeters,
    /// Any other, such as the arbitrary one of COLMAP.
    Unknown,
}

/// A sign that the poses or the images of a room are wrong. The text names no option of a program.
#[derive(Debug, Clone, PartialEq)]
pub enum PoseWarning {
    /// Found in the poses alone.
    Path(PathWarning),
    /// Images cannot be read.
    UnreadableImages {
        /// How many.
        count: usize,
        /// The reason for the first.
        first: String,
    },
    /// Images have several sizes.
    MixedSizes {
        /// Width, height, number of images, and the name of one; most frequent first.
        sizes: Vec<(u32, u32, usize, String)>,
    },
    /// The comparison with the images found a mistake or is unclear.
    Verdict {
        /// The comparison.
        check: PoseCheck,
        /// The convention in which the poses were read.
        read_as: Convention,
    },
    /// Visible surfaces would be implausibly near or far.
    Depth {
        /// Their fitted distance, meters.
        depth_m: f64,
        /// The unit that would explain it.
        unit: LengthUnit,
    },
    /// The stated focal length differs from the fitted one.
    Focal {
        /// Fitted to the images' motion, image widths.
        fitted: f64,
        /// The room's camera, image widths.
        stated: f64,
    },
    /// The camera fitted to the images contradicts the stated one.
    Camera {
        /// The fitted camera.
        fitted: FittedCamera,
        /// The room's camera.
        stated: CameraIntrinsics,
    },
    /// An image has another aspect ratio than the stated camera.
    Aspect {
        /// Height over width of the stated camera.
        stated: f64,
        /// Width of such an image, pixels.
        width: u32,
        /// Height of such an image, pixels.
        height: u32,
    },
}

/// Checks the poses of a room, and compares them with its images if given.
pub fn check_room(room: &Room, images: Option<&RoomImages<'_>>) -> PoseReport {
    let path = PathFacts::of(room);
    let path_warnings = path.iter().flat_map(|facts| &facts.warnings);
    let mut report = PoseReport {
        warnings: path_warnings.copied().map(PoseWarning::Path).collect(),
        path,
        images: None,
    };

    if let Some(images) = images {
        report.compare(room, images);
    }
    report
}

impl PoseReport {
    /// Whether the poses must not be used as they are: the images contradict them, or they
    /// themselves are implausible.
    pub fn is_wrong(&self) -> bool {
        self.warnings.iter().any(|warning| match warning {
            PoseWarning::Path(path) => matches!(
                path,
                PathWarning::NeverMoves
                    | PathWarning::Identities { .. }
                    | PathWarning::OtherUnit { .. }
                    | PathWarning::TimesFall { .. }
            ),
            PoseWarning::Verdict { check, .. } => check.verdict.is_contradiction(),
            _ => false,
        })
    }

    /// Whether some of the images cannot be read.
    pub fn has_unreadable_images(&self) -> bool {
        let images = self.images.as_ref();
        images.is_some_and(|images| images.unreadable_count > 0)
    }

    fn compare(&mut self, room: &Room, images: &RoomImages<'_>) {
        let (sizes, warning) = sizes(room, images);
        self.warnings.extend(warning);

        // Poses of lost tracking have their own warning, and would mislead the comparison.
        let mut observed = observe(room, images);
        let observed_count = observed.len();
        let is_lost = |frame: FrameId| self.is_lost(&room.poses()[frame.row()]);
        observed.retain(|pair| !is_lost(pair.first) && !is_lost(pair.second));

        let check = check(images.stated, images.read_as, &observed);
        if check.verdict.is_contradiction() || matches!(check.verdict, Verdict::Unclear { .. }) {
            self.warnings.push(PoseWarning::Verdict {
                check: check.clone(),
                read_as: images.read_as,
            });
        }
        let mut camera_fit = None;
        if let Verdict::Agrees(seen) = check.verdict {
            self.warnings.extend(depth_warning(seen));
            let fit = self.fit_camera(room, images, &sizes, seen);
            let stated = room.provenance().camera;
            self.warnings
                .extend(stated.and_then(|stated| camera_warning(fit.as_ref().ok(), seen, stated)));
            camera_fit = Some(fit);
        }
        self.warnings.extend(aspect_warning(room, &sizes));
        self.images = Some(ImageReport {
            unreadable_count: room.images().len() - sizes.values().sum::<usize>(),
            sizes,
            check,
            camera_fit,
            is_all_lost: observed_count > 0 && observed.is_empty(),
        });
    }

    fn fit_camera(
        &self,
        room: &Room,
        images: &RoomImages<'_>,
        sizes: &BTreeMap<(u32, u32), usize>,
        seen: SceneEstimate,
    ) -> Result<FittedCamera, CameraFitError> {
        let is_usable = |row: &usize| !self.is_lost(&room.poses()[*row]);
        let rows: Vec<usize> = (0..room.frame_count()).filter(is_usable).collect();
        let poses: Vec<Pose> = rows.iter().map(|&row| room.poses()[row]).collect();

        let most_frequent = sizes.iter().max_by_key(|(_, count)| **count);
        CameraEvidence {
            poses: &poses,
            read: &|place| (images.read)(&room.images()[rows[place]]),
            image_size: most_frequent.map_or((0, 0), |(size, _)| *size),
            seen,
            stated: room.provenance().camera,
        }
        .fit()
    }

    /// Whether recorders write this pose when tracking is lost.
    fn is_lost(&self, pose: &Pose) -> bool {
        let mut warnings = self.path.iter().flat_map(|path| &path.warnings);
        warnings.any(|warning| match warning {
            PathWarning::NeverMoves => true,
            PathWarning::Identities { .. } => is_identity(pose),
            _ => false,
        })
    }
}

/// The sizes of all images, and a warning about them.
fn sizes(
    room: &Room,
    images: &RoomImages<'_>,
) -> (BTreeMap<(u32, u32), usize>, Option<PoseWarning>) {
    let mut sizes = BTreeMap::new();
    let mut names = BTreeMap::new();
    let mut unreadable = Vec::new();
    for image in room.images() {
        match (images.size)(image) {
            Ok(size) => {
                *sizes.entry(size).or_insert(0) += 1;
                names.entry(size).or_insert(image);
            }
            Err(reason) => unreadable.push(reason),
        }
    }

    if let Some(first) = unreadable.first() {
        let warning = PoseWarning::UnreadableImages {
            count: unreadable.len(),
            first: first.clone(),
        };
        return (sizes, Some(warning));
    }
    if sizes.len() < 2 {
        return (sizes, None);
    }

    let mut listed: Vec<(u32, u32, usize, String)> = sizes
        .iter()
        .map(|(&(width, height), &count)| (width, height, count, names[&(width, height)].clone()))
        .collect();
    listed.sort_by_key(|(_, _, count, _)| std::cmp::Reverse(*count));
    (sizes, Some(PoseWarning::MixedSizes { sizes: listed }))
}

/// Aligns pairs of images. Images that cannot be read are skipped: [`sizes`] reports them.
fn observe(room: &Room, images: &RoomImages<'_>) -> Vec<ObservedPair> {
    let small = |frame: FrameId| -> Option<SmallImage> {
        let image = (images.read)(&room.images()[frame.row()])?;
        SmallImage::of(&image)
    };

    let pairs = pairs_to_look_at(room);
    let pair_count = pairs.len();
    let mut observed = Vec::new();
    for (done, (first, second)) in pairs.into_iter().enumerate() {
        let both = small(first).zip(small(second));
        let aligned = both.and_then(|(first, second)| align(&first, &second));
        observed.extend(aligned.map(|alignment| ObservedPair {
            first,
            second,
            motion: alignment.motion,
            correlation: alignment.correlation,
        }));
        (images.progress)(done + 1, pair_count);
    }
    observed
}

fn depth_warning(seen: SceneEstimate) -> Option<PoseWarning> {
    let depth_m = seen.depth.filter(|depth| !USUAL_DEPTH_M.contains(depth))?;
    let unit = if USUAL_DEPTH_M.contains(&(depth_m / 1_000.0)) && depth_m > 500.0 {
        LengthUnit::Millimeters
    } else if USUAL_DEPTH_M.contains(&(depth_m / 100.0)) {
        LengthUnit::Centimeters
    } else {
        LengthUnit::Unknown
    };
    Some(PoseWarning::Depth { depth_m, unit })
}

/// The warning about the stated camera, by the fitted camera if the motion determines it.
fn camera_warning(
    fitted: Option<&FittedCamera>,
    seen: SceneEstimate,
    stated: CameraIntrinsics,
) -> Option<PoseWarning> {
    match fitted.filter(|fitted| fitted.is_determined()) {
        Some(&fitted) => fitted
            .contradicts(&stated)
            .then_some(PoseWarning::Camera { fitted, stated }),
        None => focal_warning(seen, stated),
    }
}

fn focal_warning(seen: SceneEstimate, camera: CameraIntrinsics) -> Option<PoseWarning> {
    // The fit assumes square pixels.
    let stated = camera.focal().x;
    let ratio = seen.focal / stated;
    let is_usual = (FOCAL_FACTOR.recip()..FOCAL_FACTOR).contains(&ratio);
    (!is_usual).then_some(PoseWarning::Focal {
        fitted: seen.focal,
        stated,
    })
}

fn aspect_warning(room: &Room, sizes: &BTreeMap<(u32, u32), usize>) -> Option<PoseWarning> {
    let stated = room.provenance().camera?.height();
    let is_other = |width: u32, height: u32| {
        let aspect = f64::from(height) / f64::from(width);
        (aspect / stated - 1.0).abs() > ASPECT_TOLERANCE
    };
    let (&(width, height), _) = sizes
        .iter()
        .find(|((width, height), _)| is_other(*width, *height))?;

    Some(PoseWarning::Aspect {
        stated,
        width,
        height,
    })
}

impl fmt::Display for PathWarning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NeverMoves => {
                f.write_str("all poses are the same: these are not the poses of a moving camera")
            }
            Self::OnlyTurns => f.write_str(
                "all positions are the same, and the camera only turns: were the translations lost? \
                 No translation can be learned from these poses",
            ),
            Self::Identities { count, first } => write!(
                f,
                "{count} poses are exactly the identity (in some axis convention) after others that \
                 are not, first at frame {first}: recorders write it when tracking is lost; remove \
                 these frames"
            ),
            Self::Jumps { count, first } => {
                match count {
                    1 => write!(f, "the camera jumps once, to frame {first}")?,
                    count => write!(f, "the camera jumps {count} times, first to frame {first}")?,
                }
                f.write_str(": tracking was lost, or one sequence holds several recordings")
            }
            Self::OtherUnit { median_step_m } => write!(
                f,
                "the median step is {median_step_m:.1} m: are the translations in millimeters or \
                 centimeters?"
            ),
            Self::TimesFall { first } => write!(
                f,
                "timestamps do not increase: frame {first} is not later than the one before it; are \
                 the frames in order?"
            ),
        }
    }
}

impl fmt::Display for PoseWarning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Path(warning) => warning.fmt(f),
            Self::UnreadableImages { count, first } => {
                write!(f, "{count} images cannot be read, the first: {first}")
            }
            Self::MixedSizes { sizes } => {
                let listed: Vec<String> = sizes
                    .iter()
                    .map(|(width, height, count, name)| {
                        format!("{count} of {width}x{height} (such as {name})")
                    })
                    .collect();
                write!(
                    f,
                    "images have {} sizes: {}; an encoder resizes all images to one size, which \
                     distorts those of another shape",
                    sizes.len(),
                    listed.join(", ")
                )
            }
            Self::Verdict { check, read_as } => {
                let stated = 100.0 * check.explained;
                write_verdict(f, &check.verdict, stated, *read_as)
            }
            Self::Depth { depth_m, unit } => {
                let unit = match unit {
                    LengthUnit::Millimeters => "are the translations in millimeters?",
                    LengthUnit::Centimeters => "are the translations in centimeters?",
                    LengthUnit::Unknown => "are the translations in meters? COLMAP's are not",
                };
                write!(f, "things in view would be {depth_m:.2} m away: {unit}")
            }
            Self::Focal { fitted, stated } => write!(
                f,
                "the images move as through a focal length of {fitted:.2} image widths, and the \
                 room's camera has {stated:.2}: is the stated camera right?"
            ),
            Self::Camera { fitted, stated } => write!(
                f,
                "the images contradict the stated camera: its focal length is {:.0} pixels, and \
                 {:.1} +- {:.1} is estimated, which reduces the median epipolar error from {:.1} to \
                 {:.1} pixels of an image 320 wide",
                stated.focal().mean() * f64::from(fitted.image_size.0),
                fitted.focal_px(),
                fitted.focal_px() * fitted.focal_deviation,
                fitted.stated_median_px.unwrap_or(f64::NAN),
                fitted.median_px,
            ),
            Self::Aspect {
                stated,
                width,
                height,
            } => write!(
                f,
                "the stated camera's images are {stated:.3} times as high as wide, and some are \
                 {width}x{height}: were they cropped, or turned by their EXIF orientation?"
            ),
        }
    }
}

/// `stated` is how much of the images' motion the stated poses explain, percent.
fn write_verdict(
    f: &mut fmt::Formatter<'_>,
    verdict: &Verdict,
    stated: f64,
    read_as: Convention,
) -> fmt::Result {
    match verdict {
        Verdict::OtherConvention { likely, explained } => write!(
            f,
            "the images contradict the poses: read as {read_as} they explain {stated:.0} % of how \
             the images move, and {:.0} % as {}",
            100.0 * explained,
            alternatives(likely)
        ),
        Verdict::MirroredImages { likely, explained } => write!(
            f,
            "the images are mirrored: the poses explain {stated:.0} % of how they move, and {:.0} % \
             of how they would with left and right exchanged, read as {}; mirror the images back",
            100.0 * explained,
            alternatives(likely)
        ),
        Verdict::TransposedRotations { explained } => write!(
            f,
            "the images contradict the rotations: the poses explain {stated:.0} % of how the images \
             move, and {:.0} % with the rotations transposed and the translations unchanged",
            100.0 * explained
        ),
        Verdict::OtherTranslations { likely, explained } => write!(
            f,
            "the images contradict the translations: the poses explain {stated:.0} % of how the \
             images move, and {:.0} % with translations {likely}",
            100.0 * explained,
        ),
        Verdict::OtherRows { rows, explained } => write!(
            f,
            "the images contradict the poses: they explain {stated:.0} % of how the images move, and \
             {:.0} % of how those move that are {} frames {}; do poses and images start at the same \
             frame, and use the same clock?",
            100.0 * explained,
            rows.abs(),
            if *rows > 0 { "later" } else { "earlier" }
        ),
        Verdict::Unrelated { explained } => write!(
            f,
            "the images contradict the poses: no convention explains more than {:.0} % of how the \
             images move; are the poses in another order, of other frames or of another recording?",
            100.0 * explained
        ),
        Verdict::Unclear { .. }
        | Verdict::Agrees(_)
        | Verdict::TooFewPairs
        | Verdict::TooLittleMotion => write!(
            f,
            "the poses explain only {stated:.0} % of how the images move: they may be inexact, or \
             the images blurred"
        ),
    }
}

fn alternatives(conventions: &[Convention]) -> String {
    let named: Vec<String> = conventions.iter().map(ToString::to_string).collect();
    named.join(", or as ")
}

impl fmt::Display for Translations {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::OfTheInverse => f.write_str("read as those of camera_from_world"),
            Self::Axes(axes) => {
                let axes = axes.map(|(axis, sign)| {
                    let sign = if sign < 0.0 { "-" } else { "" };
                    format!("{sign}{}", ["x", "y", "z"][axis])
                });
                write!(f, "({})", axes.join(", "))
            }
        }
    }
}

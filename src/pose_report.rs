//! What is said about the poses of a room, at import and by `check room`.

use std::collections::BTreeMap;
use std::path::Path;

use serde_json::{Value, json};

use super::output::say;
use super::pose_options::{flags_of, in_words};
use super::progress::bar;
use seese3_core::geometry::{Pinhole, Pose};
use seese3_core::room::{FrameId, Room};
use seese3_data::image_motion::{SmallImage, align};
use seese3_data::pose_check::{
    Convention, ObservedPair, PathFacts, PathWarning, PoseCheck, SceneEstimate, Translations,
    Verdict, check, is_identity, pairs_to_look_at,
};
use seese3_encoder::{image_size, read_image};

/// Things in view are usually this far away, metres; beyond it the unit of translations is asked
/// about.
const USUAL_DEPTH_M: std::ops::Range<f64> = 0.4..40.0;
/// A stated focal length that differs from the seen one by more than this factor is asked about.
const FOCAL_FACTOR: f64 = 1.4;

/// Where the poses come from that are compared with images.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PosesFrom {
    /// A recording, and are read in this convention: the options that mend them are those of `import`.
    Recording(Convention),
    /// The store. Nobody knows by which options they were read when they were imported.
    Store,
}

impl PosesFrom {
    fn read_as(self) -> Convention {
        match self {
            Self::Recording(convention) => convention,
            Self::Store => Convention::default(),
        }
    }
}

/// The facts about a room's poses and images, and what looks wrong in them.
pub struct PoseReport {
    path: Option<PathFacts>,
    images: Option<Images>,
    /// What looks wrong, a sentence each.
    warnings: Vec<String>,
}

/// What the images say.
struct Images {
    /// How many have which width and height, pixels.
    sizes: BTreeMap<(u32, u32), usize>,
    unreadable_count: usize,
    check: PoseCheck,
    /// Whether no pose was left to compare, since all are the same or those of lost tracking.
    are_lost: bool,
}

impl PoseReport {
    /// What the poses alone say.
    pub fn of_path(room: &Room) -> Self {
        let path = PathFacts::of(room);
        let warnings = path.iter().flat_map(|facts| &facts.warnings);
        let warnings = warnings.map(|warning| path_warning(*warning)).collect();

        Self {
            path,
            images: None,
            warnings,
        }
    }

    /// Looks at the images below `root` too, and compares them with the room's poses: `stated` are
    /// those before they were read in their convention.
    pub fn look_at_images(&mut self, room: &Room, root: &Path, stated: &[Pose], from: PosesFrom) {
        let (sizes, problem) = sizes(room, root);
        self.warnings.extend(problem);

        // Poses that are no poses say nothing about the others, and have been named already.
        let mut observed = observe(room, root);
        let observed_count = observed.len();
        let lost = |frame: FrameId| self.is_lost(&room.poses()[frame.row()]);
        observed.retain(|pair| !lost(pair.first) && !lost(pair.second));

        let check = check(stated, from.read_as(), &observed);
        self.warnings.extend(verdict_warning(&check, from));
        if let Verdict::Agrees(seen) = check.verdict {
            let camera = room.provenance().camera;
            self.warnings.extend(seen_warnings(seen, camera));
        }
        self.warnings.extend(camera_warning(room, &sizes));
        self.images = Some(Images {
            unreadable_count: room.images().len() - sizes.values().sum::<usize>(),
            sizes,
            check,
            are_lost: observed_count > 0 && observed.is_empty(),
        });
    }

    /// Whether this pose is one of those that recorders write when tracking is lost.
    fn is_lost(&self, pose: &Pose) -> bool {
        let mut warnings = self.path.iter().flat_map(|path| &path.warnings);
        warnings.any(|warning| match warning {
            PathWarning::NeverMoves => true,
            PathWarning::Identities { .. } => is_identity(pose),
            _ => false,
        })
    }

    /// Whether the poses are wrong for certain: contradicted by the images, or by themselves.
    pub fn is_wrong(&self) -> bool {
        let warnings = self.path.iter().flat_map(|path| &path.warnings);
        let is_wrong = |warning: &PathWarning| {
            matches!(
                warning,
                PathWarning::NeverMoves
                    | PathWarning::Identities { .. }
                    | PathWarning::OtherUnit { .. }
                    | PathWarning::TimesFall { .. }
            )
        };

        self.is_contradicted() || warnings.into_iter().any(is_wrong)
    }

    /// Whether some of the images that were looked at are no images.
    pub fn has_unreadable_images(&self) -> bool {
        let images = self.images.as_ref();
        images.is_some_and(|images| images.unreadable_count > 0)
    }

    fn is_contradicted(&self) -> bool {
        let verdict = self.images.as_ref().map(|images| &images.check.verdict);
        matches!(
            verdict,
            Some(
                Verdict::OtherConvention { .. }
                    | Verdict::MirroredImages { .. }
                    | Verdict::TransposedRotations { .. }
                    | Verdict::OtherTranslations { .. }
                    | Verdict::OtherRows { .. }
                    | Verdict::Unrelated { .. }
            )
        )
    }

    /// Prints the facts, and the warnings to standard error.
    pub fn say(&self) {
        if let Some(path) = &self.path {
            say_path(path);
        }
        if let Some(images) = &self.images {
            say_images(images);
        }
        for warning in &self.warnings {
            eprintln!("warning: {warning}");
        }
    }

    /// The same for programs.
    pub fn json(&self, room: &Room) -> Value {
        json!({
            "room": room.id().as_str(),
            "frames": room.frame_count(),
            "path": self.path.as_ref().map(path_json),
            "images": self.images.as_ref().map(images_json),
            "warnings": self.warnings,
        })
    }
}

/// The sizes of all images, and what is wrong with them.
fn sizes(room: &Room, root: &Path) -> (BTreeMap<(u32, u32), usize>, Option<String>) {
    let mut sizes = BTreeMap::new();
    let mut names = BTreeMap::new();
    let mut unreadable = Vec::new();
    for image in room.images() {
        match image_size(root, image) {
            Ok(size) => {
                *sizes.entry(size).or_insert(0) += 1;
                names.entry(size).or_insert(image);
            }
            Err(error) => unreadable.push(error.to_string()),
        }
    }

    if let Some(first) = unreadable.first() {
        let count = unreadable.len();
        let problem = format!("{count} images cannot be read, the first: {first}");
        return (sizes, Some(problem));
    }
    if sizes.len() < 2 {
        return (sizes, None);
    }

    let mut by_count: Vec<_> = sizes.iter().collect();
    by_count.sort_by(|a, b| b.1.cmp(a.1));
    let words = by_count.iter().map(|((width, height), count)| {
        let name = names
            .get(&(*width, *height))
            .map_or("", |name| name.as_str());
        format!("{count} of {width}x{height} (such as {name})")
    });
    let words: Vec<String> = words.collect();
    let problem = format!(
        "images have {} sizes: {}; an encoder resizes all images to one size, which distorts those of another \
         shape",
        sizes.len(),
        words.join(", ")
    );
    (sizes, Some(problem))
}

/// Lays pairs of images over one another. Images that cannot be read are left out here; `sizes` reports
/// them, or encoding them will.
fn observe(room: &Room, root: &Path) -> Vec<ObservedPair> {
    let pairs = pairs_to_look_at(room);
    let progress = bar(pairs.len() as u64, "comparing poses with images");
    let small = |frame: FrameId| -> Option<SmallImage> {
        let image = read_image(root, &room.images()[frame.row()]).ok()?;
        SmallImage::of(&image)
    };

    let mut observed = Vec::new();
    for (first, second) in pairs {
        progress.inc(1);
        let images = small(first).zip(small(second));
        let aligned = images.and_then(|(first, second)| align(&first, &second));
        observed.extend(aligned.map(|alignment| ObservedPair {
            first,
            second,
            motion: alignment.motion,
            correlation: alignment.correlation,
        }));
    }

    progress.finish_and_clear();
    observed
}

fn say_path(path: &PathFacts) {
    let [x, y, z] = path.extent_m;
    say(format_args!(
        "camera: extent {x:.2} x {y:.2} x {z:.2} m, path {:.2} m",
        path.length_m
    ));
    let (longest_m, at_m) = path.largest_step_m;
    let (longest_rad, at_rad) = path.largest_step_rad;
    say(format_args!(
        "steps: median {:.4} m and {:.2} degrees; largest {longest_m:.3} m (to frame {at_m}) and {:.1} \
         degrees (to frame {at_rad})",
        path.median_step_m,
        path.median_step_rad.to_degrees(),
        longest_rad.to_degrees(),
    ));
    if let Some(rate) = path.rate_hz {
        say(format_args!("rate: {rate:.2} frames a second"));
    }
}

fn say_images(images: &Images) {
    for ((width, height), count) in &images.sizes {
        say(format_args!("image size: {count} of {width}x{height}"));
    }

    let PoseCheck {
        verdict,
        explained,
        pair_count,
    } = &images.check;
    let share = format!("{:.0} % of how the images move", 100.0 * explained);
    match verdict {
        _ if images.are_lost => say("poses against images: cannot tell, the poses say nothing"),
        Verdict::Agrees(seen) => {
            let depth = seen.depth.map_or(String::new(), |depth| {
                format!(", things in view about {depth:.1} m away")
            });
            say(format_args!(
                "poses against images: agree; they explain {share} ({pair_count} pairs; focal length about \
                 {:.2} image widths{depth})",
                seen.focal
            ));
        }
        Verdict::TooFewPairs => say(format_args!(
            "poses against images: cannot tell, only {pair_count} pairs of images could be laid over one another"
        )),
        Verdict::TooLittleMotion => {
            say("poses against images: cannot tell, the camera hardly moves");
        }
        Verdict::Unclear { .. } => say(format_args!(
            "poses against images: unclear, they explain {share} ({pair_count} pairs)"
        )),
        Verdict::OtherConvention { .. }
        | Verdict::MirroredImages { .. }
        | Verdict::TransposedRotations { .. }
        | Verdict::OtherTranslations { .. }
        | Verdict::OtherRows { .. }
        | Verdict::Unrelated { .. } => say(format_args!(
            "poses against images: contradict each other, the poses explain {share} ({pair_count} pairs)"
        )),
    }
}

fn path_warning(warning: PathWarning) -> String {
    match warning {
        PathWarning::NeverMoves => {
            "all poses are the same: these are not the poses of a moving camera".to_owned()
        }
        PathWarning::OnlyTurns => {
            "all positions are the same, and the camera only turns: were the \
             translations lost? Nothing can be learned about moving from these poses"
                .to_owned()
        }
        PathWarning::Identities { count, first } => format!(
            "{count} poses are exactly the identity (or it along other axes) after others that are not, the \
             first of frame {first}: recorders write it when tracking is lost; remove these frames"
        ),
        PathWarning::Jumps { count, first } => {
            let times = match count {
                1 => format!("once, to frame {first}"),
                count => format!("{count} times, first to frame {first}"),
            };
            format!(
                "the camera jumps {times}: tracking was lost, or several recordings are in one sequence"
            )
        }
        PathWarning::OtherUnit { median_step_m } => format!(
            "the median step is {median_step_m:.1} m: are the translations in millimetres (--scale 0.001) \
             or centimetres (--scale 0.01)?"
        ),
        PathWarning::TimesFall { first } => format!(
            "times do not rise: frame {first} is not later than the one before it; are the frames in \
             order?"
        ),
    }
}

fn verdict_warning(check: &PoseCheck, from: PosesFrom) -> Option<String> {
    let read_as = from.read_as();
    let again = match from {
        PosesFrom::Recording(_) => {
            "import again with these options, and look at the verdict again: there may be a second mistake"
        }
        PosesFrom::Store => {
            "these are the options if the room was imported without any on poses; import it again, and look \
             at the verdict again: there may be a second mistake"
        }
    };
    let stated = 100.0 * check.explained;
    match &check.verdict {
        Verdict::OtherConvention { likely, explained } => Some(format!(
            "the images contradict the poses: read as {} they explain {stated:.0} % of how the images \
             move, and {:.0} % as {}; {again}",
            in_words(read_as),
            100.0 * explained,
            likely_in_words(likely)
        )),
        Verdict::MirroredImages { likely, explained } => Some(format!(
            "the images are mirrored: the poses explain {stated:.0} % of how they move, and {:.0} % of how \
             they would with left and right exchanged, read as {}; mirror the images back and import again",
            100.0 * explained,
            likely_in_words(likely)
        )),
        Verdict::TransposedRotations { explained } => Some(format!(
            "the images contradict the rotations: the poses explain {stated:.0} % of how the images move, \
             and {:.0} % with the rotations transposed and the translations as they are; mend the poses and \
             import again",
            100.0 * explained
        )),
        Verdict::OtherTranslations { likely, explained } => Some(format!(
            "the images contradict the translations: the poses explain {stated:.0} % of how the images move, \
             and {:.0} % with translations {}; mend the poses and import again",
            100.0 * explained,
            translations_in_words(*likely)
        )),
        Verdict::OtherRows { rows, explained } => Some(format!(
            "the images contradict the poses: they explain {stated:.0} % of how the images move, and {:.0} % \
             of how those move that are {} frames {}; do poses and images start at the same frame, and use \
             the same clock?",
            100.0 * explained,
            rows.abs(),
            if *rows > 0 { "later" } else { "earlier" }
        )),
        Verdict::Unclear { .. } => Some(format!(
            "the poses explain only {stated:.0} % of how the images move: they may be inexact, or the \
             images blurred"
        )),
        Verdict::Unrelated { explained } => Some(format!(
            "the images contradict the poses: no convention explains more than {:.0} % of how the images \
             move; are the poses in another order, of other frames or of another recording?",
            100.0 * explained
        )),
        Verdict::Agrees(_) | Verdict::TooFewPairs | Verdict::TooLittleMotion => None,
    }
}

/// Conventions in words, each with the options that read it.
fn likely_in_words(likely: &[Convention]) -> String {
    let words = likely
        .iter()
        .map(|convention| format!("{} ({})", in_words(*convention), flags_of(*convention)));

    words.collect::<Vec<_>>().join(", or as ")
}

fn translations_in_words(translations: Translations) -> String {
    match translations {
        Translations::OfTheInverse => "read as those of camera_from_world".to_owned(),
        Translations::Axes(axes) => {
            let axes = axes.map(|(axis, sign)| {
                let sign = if sign < 0.0 { "-" } else { "" };
                format!("{sign}{}", ["x", "y", "z"][axis])
            });
            format!("({})", axes.join(", "))
        }
    }
}

fn seen_warnings(seen: SceneEstimate, camera: Option<Pinhole>) -> Vec<String> {
    let mut warnings = Vec::new();
    if let Some(depth) = seen.depth.filter(|depth| !USUAL_DEPTH_M.contains(depth)) {
        let unit = match depth {
            _ if USUAL_DEPTH_M.contains(&(depth / 1_000.0)) && depth > 500.0 => {
                "are the translations in millimetres (--scale 0.001)?"
            }
            _ if USUAL_DEPTH_M.contains(&(depth / 100.0)) => {
                "are the translations in centimetres (--scale 0.01)?"
            }
            _ => "are the translations in metres? COLMAP's are not (--scale FACTOR)",
        };
        warnings.push(format!("things in view would be {depth:.2} m away: {unit}"));
    }

    if let Some(camera) = camera {
        let ratio = seen.focal / camera.focal();
        if !(FOCAL_FACTOR.recip()..FOCAL_FACTOR).contains(&ratio) {
            warnings.push(format!(
                "the images move as through a focal length of {:.2} image widths, and the room's camera has \
                 {:.2}: is --camera, or the recording's own camera, right?",
                seen.focal,
                camera.focal()
            ));
        }
    }
    warnings
}

/// What is wrong if the stated camera's images have another shape than those that are there.
fn camera_warning(room: &Room, sizes: &BTreeMap<(u32, u32), usize>) -> Option<String> {
    let stated = room.provenance().camera?.height();
    let (width, height) = sizes.keys().find(|(width, height)| {
        (f64::from(*height) / f64::from(*width) / stated - 1.0).abs() > 0.02
    })?;

    Some(format!(
        "the stated camera's images are {stated:.3} times as high as wide, and some are {width}x{height}: \
         were they cut, or turned by their EXIF orientation?"
    ))
}

fn path_json(path: &PathFacts) -> Value {
    let step = |(size, frame): (f64, FrameId)| json!({ "size": size, "to_frame": frame.0 });
    json!({
        "extent_m": path.extent_m,
        "length_m": path.length_m,
        "median_step_m": path.median_step_m,
        "largest_step_m": step(path.largest_step_m),
        "median_step_rad": path.median_step_rad,
        "largest_step_rad": step(path.largest_step_rad),
        "rate_hz": path.rate_hz,
    })
}

fn images_json(images: &Images) -> Value {
    let check = &images.check;
    let (verdict, likely, seen) = match &check.verdict {
        Verdict::Agrees(seen) => ("agrees", Vec::new(), Some(*seen)),
        Verdict::OtherConvention { likely, .. } => ("other_convention", likely.clone(), None),
        Verdict::MirroredImages { likely, .. } => ("mirrored_images", likely.clone(), None),
        Verdict::TransposedRotations { .. } => ("transposed_rotations", Vec::new(), None),
        Verdict::OtherTranslations { .. } => ("other_translations", Vec::new(), None),
        Verdict::OtherRows { .. } => ("other_rows", Vec::new(), None),
        Verdict::Unrelated { .. } => ("unrelated", Vec::new(), None),
        Verdict::Unclear { .. } => ("unclear", Vec::new(), None),
        Verdict::TooFewPairs => ("too_few_pairs", Vec::new(), None),
        Verdict::TooLittleMotion => ("too_little_motion", Vec::new(), None),
    };
    let likely: Vec<String> = likely.into_iter().map(flags_of).collect();
    let sizes = images.sizes.iter().map(
        |((width, height), count)| json!({ "width": width, "height": height, "count": count }),
    );

    let (rows, translations) = match &check.verdict {
        Verdict::OtherRows { rows, .. } => (Some(*rows), None),
        Verdict::OtherTranslations { likely, .. } => (None, Some(translations_in_words(*likely))),
        _ => (None, None),
    };

    json!({
        "verdict": verdict,
        "explained": check.explained,
        "pairs": check.pair_count,
        "likely": likely,
        "rows": rows,
        "translations": translations,
        "focal_widths": seen.map(|seen| seen.focal),
        "depth_m": seen.and_then(|seen| seen.depth),
        "sizes": sizes.collect::<Vec<_>>(),
    })
}

//! Prints the pose check of a room, at import and by `check`, with the options that mend it.

use std::path::Path;

use serde_json::{Value, json};

use super::camera::CameraOption;
use super::output::say;
use super::pose_options::flags_of;
use super::progress::bar;
use seese3_core::geometry::Pose;
use seese3_core::room::{FrameId, Room};
use seese3_data::pose_check::{
    CameraFitError, Convention, FittedCamera, ImageReport, LengthUnit, PathFacts, PathWarning,
    PoseCheck, PoseReport, PoseWarning, RoomImages, Verdict, check_room,
};
use seese3_encoder::{image_size, read_image};

/// Ratio of the median epipolar errors of the stated and the fitted camera from which the fitted
/// one is suggested.
const BETTER_CAMERA_RATIO: f64 = 1.1;

/// Origin of the poses that are compared with the images.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PosesFrom {
    /// A recording, read in this convention: the options of `import` can mend it.
    Recording(Convention),
    /// The store, which does not keep the options of the import.
    Store,
}

/// Checks a room against its images below `root`. `stated` are its poses before they were read in
/// their convention.
pub fn check_with_images(room: &Room, root: &Path, stated: &[Pose], from: PosesFrom) -> PoseReport {
    let progress = bar(0, "comparing poses with images");
    let report = check_room(
        room,
        Some(&RoomImages {
            size: &|image| image_size(root, image).map_err(|error| error.to_string()),
            read: &|image| read_image(root, image).ok(),
            stated,
            read_as: match from {
                PosesFrom::Recording(convention) => convention,
                PosesFrom::Store => Convention::default(),
            },
            progress: &|done, total| {
                progress.set_length(total as u64);
                progress.set_position(done as u64);
            },
        }),
    );
    progress.finish_and_clear();
    report
}

/// Prints the facts, and the warnings to standard error.
pub fn say_report(report: &PoseReport, from: PosesFrom) {
    if let Some(path) = &report.path {
        say_path(path);
    }
    if let Some(images) = &report.images {
        say_images(images);
    }
    for warning in &report.warnings {
        eprintln!("warning: {}", with_advice(warning, from));
    }
}

/// The report as JSON.
pub fn report_json(report: &PoseReport, room: &Room, from: PosesFrom) -> Value {
    let warnings = report.warnings.iter();
    let warnings: Vec<String> = warnings.map(|warning| with_advice(warning, from)).collect();
    json!({
        "room": room.id().as_str(),
        "frame_count": room.frame_count(),
        "path": report.path.as_ref().map(path_json),
        "images": report.images.as_ref().map(images_json),
        "warnings": warnings,
    })
}

/// The warning, followed by the options of `import` that would mend it.
fn with_advice(warning: &PoseWarning, from: PosesFrom) -> String {
    let advice = match warning {
        PoseWarning::Path(PathWarning::OtherUnit { .. }) => {
            Some("--scale 0.001 or --scale 0.01".to_owned())
        }
        PoseWarning::Depth { unit, .. } => Some(match unit {
            LengthUnit::Millimeters => "--scale 0.001".to_owned(),
            LengthUnit::Centimeters => "--scale 0.01".to_owned(),
            LengthUnit::Unknown => "--scale FACTOR".to_owned(),
        }),
        PoseWarning::Focal { .. } => Some("--camera".to_owned()),
        PoseWarning::Camera { fitted, .. } => Some(camera_flag(fitted)),
        PoseWarning::Verdict { check, .. } => verdict_advice(&check.verdict, from),
        _ => None,
    };

    match advice {
        Some(advice) => format!("{warning} ({advice})"),
        None => warning.to_string(),
    }
}

/// What to do about poses that the images contradict; `None` if they do not.
pub fn contradiction(report: &PoseReport, from: PosesFrom) -> Option<String> {
    report.warnings.iter().find_map(|warning| match warning {
        PoseWarning::Verdict { check, .. } if check.verdict.is_contradiction() => {
            let advice = verdict_advice(&check.verdict, from);
            Some(advice.unwrap_or_else(|| "correct the poses and import again".to_owned()))
        }
        _ => None,
    })
}

/// The option of `import` that states the fitted camera.
fn camera_flag(fitted: &FittedCamera) -> String {
    let (width, _) = fitted.image_size;
    format!("--camera {}", CameraOption(fitted.camera).text(width))
}

fn verdict_advice(verdict: &Verdict, from: PosesFrom) -> Option<String> {
    let flags = |likely: &[Convention]| {
        let flags: Vec<String> = likely.iter().copied().map(flags_of).collect();
        flags.join(", or ")
    };
    match verdict {
        Verdict::OtherConvention { likely, .. } => Some(match from {
            PosesFrom::Recording(_) => format!(
                "import again with: {}; then check the verdict again, as there may be a second mistake",
                flags(likely)
            ),
            PosesFrom::Store => format!(
                "if the room was imported without options on poses, import it again with: {}; then check \
                 the verdict again, as there may be a second mistake",
                flags(likely)
            ),
        }),
        Verdict::MirroredImages { likely, .. } => {
            Some(format!("then import again with: {}", flags(likely)))
        }
        Verdict::TransposedRotations { .. } | Verdict::OtherTranslations { .. } => {
            Some("correct the poses and import again".to_owned())
        }
        _ => None,
    }
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

fn say_images(images: &ImageReport) {
    for ((width, height), count) in &images.sizes {
        say(format_args!("image size: {count} of {width}x{height}"));
    }

    let PoseCheck {
        verdict,
        explained,
        pair_count,
    } = &images.check;
    let share = format!("{:.0} % of the image motion", 100.0 * explained);
    match verdict {
        _ if images.is_all_lost => {
            say("poses against images: no verdict, there are no usable poses")
        }
        Verdict::Agrees(seen) => {
            let depth = seen.depth.map_or(String::new(), |depth| {
                format!(", scene depth about {depth:.1} m")
            });
            say(format_args!(
                "poses against images: agree; they explain {share} ({pair_count} pairs; focal length about \
                 {:.2} image widths{depth})",
                seen.focal
            ));
        }
        Verdict::TooFewPairs => say(format_args!(
            "poses against images: no verdict, only {pair_count} pairs of images could be aligned"
        )),
        Verdict::TooLittleMotion => {
            say("poses against images: no verdict, the camera hardly moves");
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
    if let Some(fit) = &images.camera_fit {
        say(format_args!("focal length: {}", camera_text(fit)));
    }
}

fn camera_text(fit: &Result<FittedCamera, CameraFitError>) -> String {
    let fitted = match fit {
        Ok(fitted) => fitted,
        Err(error) => return format!("not estimated: {error}"),
    };
    let FittedCamera {
        matches, median_px, ..
    } = fitted;
    if !fitted.is_determined() {
        return format!(
            "not determined by the camera's motion, standard deviation {:.0} % ({matches} matches)",
            100.0 * fitted.focal_deviation
        );
    }

    let with_stated = match fitted.stated_median_px {
        Some(stated_px) if stated_px > BETTER_CAMERA_RATIO * median_px => format!(
            "{stated_px:.2} with the stated camera; better: {}",
            camera_flag(fitted)
        ),
        Some(stated_px) => format!("{stated_px:.2} with the stated camera"),
        None => format!("no camera is stated: {}", camera_flag(fitted)),
    };
    format!(
        "{:.1} +- {:.1} pixels, k1 {:.3}; median epipolar error {median_px:.2} pixels of images \
         320 wide ({matches} matches; {with_stated})",
        fitted.focal_px(),
        fitted.focal_px() * fitted.focal_deviation,
        fitted.k1(),
    )
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

fn images_json(images: &ImageReport) -> Value {
    let PoseCheck {
        verdict,
        explained,
        pair_count,
    } = &images.check;
    let likely = match verdict {
        Verdict::OtherConvention { likely, .. } | Verdict::MirroredImages { likely, .. } => {
            likely.as_slice()
        }
        _ => &[],
    };
    let likely: Vec<String> = likely.iter().copied().map(flags_of).collect();
    let (rows, translations) = match verdict {
        Verdict::OtherRows { rows, .. } => (Some(*rows), None),
        Verdict::OtherTranslations { likely, .. } => (None, Some(likely.to_string())),
        _ => (None, None),
    };
    let seen = match verdict {
        Verdict::Agrees(seen) => Some(*seen),
        _ => None,
    };
    let sizes = images.sizes.iter().map(
        |((width, height), count)| json!({ "width": width, "height": height, "count": count }),
    );

    json!({
        "verdict": verdict.name(),
        "explained": explained,
        "pair_count": pair_count,
        "likely": likely,
        "rows": rows,
        "translations": translations,
        "focal_widths": seen.map(|seen| seen.focal),
        "depth_m": seen.and_then(|seen| seen.depth),
        "sizes": sizes.collect::<Vec<_>>(),
        "camera_fit": images.camera_fit.as_ref().and_then(|fit| fit.as_ref().ok()).map(camera_json),
    })
}

fn camera_json(fitted: &FittedCamera) -> Value {
    json!({
        "focal_px": fitted.focal_px(),
        "k1": fitted.k1(),
        "median_px": fitted.median_px,
        "stated_median_px": fitted.stated_median_px,
        "matches": fitted.matches,
        "focal_deviation": fitted.focal_deviation,
    })
}

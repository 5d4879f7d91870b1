//! EuRoC MAV: `mav0/cam0/{data.csv,sensor.yaml,data/*.png}` and
//! `mav0/state_groundtruth_estimate0/data.csv`.
//!
//! The ground truth is `world_from_body`, where the body is the IMU; quaternions are (w, x, y, z).
//! The camera's pose on the body is `T_BS` in its `sensor.yaml`. An image takes the ground truth
//! nearest in time, at most 10 ms away.

use std::path::Path;

use nalgebra::{Matrix4, Quaternion};

use super::collect::{About, Collected};
use super::text::number;
use super::{DropReason, Error, Reader, Recording, read_text};
use seese3_core::Cause;
use seese3_core::geometry::{
    CameraIntrinsics, Distortion, PixelCamera, Pose, pose_from_matrix, pose_from_quaternion,
};

/// The longest time between an image and its pose, nanoseconds.
const MAX_DIFFERENCE_NS: u64 = 10_000_000;

/// Reads a sequence's folder, with or without `mav0`. `camera` is the camera's subfolder, such as
/// `cam0`.
///
/// # Errors
/// [`Error`] if a file cannot be read or is malformed, if no usable frame is left, or if a frame
/// is unusable and `reader.unusable` is `Refuse`.
pub fn read_euroc(
    folder: &Path,
    camera: &str,
    reader: &mut Reader<'_>,
) -> Result<Recording, Error> {
    let inner = folder.join("mav0");
    let folder = if inner.is_dir() {
        inner
    } else {
        folder.to_owned()
    };
    let camera_folder = folder.join(camera);

    let poses = read_ground_truth(&folder.join("state_groundtruth_estimate0/data.csv"))?;
    let sensor = read_sensor(&camera_folder.join("sensor.yaml"))?;
    let images = read_images(&camera_folder.join("data.csv"))?;

    let mut collected = Collected::default();
    for (done, (timestamp_ns, name)) in images.iter().enumerate() {
        (reader.progress)(done, images.len());
        let image = format!("data/{name}");
        if !camera_folder.join(&image).is_file() {
            let looked_for = camera_folder.join(&image).display().to_string();
            collected.drop_without(looked_for, name.clone(), DropReason::MissingImage);
            continue;
        }

        let nearest = poses
            .iter()
            .min_by_key(|(time, _)| time.abs_diff(*timestamp_ns))
            .filter(|(time, _)| time.abs_diff(*timestamp_ns) <= MAX_DIFFERENCE_NS);
        let Some((_, world_from_body)) = nearest else {
            collected.drop(name.clone(), DropReason::NoPoseWithinTolerance);
            continue;
        };

        let about = About {
            name: name.clone(),
            image: Some(image),
            timestamp_ns: Some(*timestamp_ns),
            ..About::default()
        };
        collected.keep(about, world_from_body * sensor.body_from_camera);
    }

    let mut recording = collected.finish(&camera_folder, reader)?;
    recording.stated.camera = sensor.camera;
    Ok(recording)
}

/// The rows of a CSV file: line number and columns. Empty lines and lines that begin with # are
/// skipped.
fn rows(file: &Path, text: &str) -> Result<Vec<(usize, Vec<String>)>, Error> {
    let lines = (1..).zip(text.lines());
    let data_lines = lines.filter(|(_, row)| !row.trim().is_empty() && !row.starts_with('#'));
    let columns = |(line, row): (usize, &str)| {
        let columns = row.split(',').map(|word| word.trim().to_owned());
        (line, columns.collect::<Vec<_>>())
    };
    let rows: Vec<_> = data_lines.map(columns).collect();

    match rows.iter().find(|(_, columns)| columns.len() < 2) {
        None => Ok(rows),
        Some((line, _)) => Err(wrong(
            file,
            *line,
            "has no columns separated by commas".into(),
        )),
    }
}

fn wrong(file: &Path, line: usize, problem: Cause) -> Error {
    Error::Line {
        file: file.to_owned(),
        line,
        problem,
    }
}

fn time(file: &Path, line: usize, word: &str) -> Result<i64, Error> {
    word.parse().map_err(|_| {
        wrong(
            file,
            line,
            format!("'{word}' is not a time in nanoseconds").into(),
        )
    })
}

/// Times, nanoseconds, and poses of the body, `world_from_body`.
fn read_ground_truth(file: &Path) -> Result<Vec<(i64, Pose)>, Error> {
    let text = read_text(file)?;
    let mut poses = Vec::new();
    for (line, columns) in rows(file, &text)? {
        if columns.len() < 8 {
            return Err(wrong(
                file,
                line,
                format!(
                    "has {} columns, expected time, position and quaternion",
                    columns.len()
                )
                .into(),
            ));
        }

        let mut numbers = [0.0; 7];
        for (value, word) in numbers.iter_mut().zip(&columns[1..8]) {
            *value = number(file, line, word)?;
        }
        let [x, y, z, qw, qx, qy, qz] = numbers;
        let pose = pose_from_quaternion([x, y, z], Quaternion::new(qw, qx, qy, qz))
            .map_err(|error| wrong(file, line, error.into()))?;
        poses.push((time(file, line, &columns[0])?, pose));
    }

    Ok(poses)
}

/// Times, nanoseconds, and names of images, in the order of time.
fn read_images(file: &Path) -> Result<Vec<(i64, String)>, Error> {
    let text = read_text(file)?;
    let mut images = Vec::new();
    for (line, columns) in rows(file, &text)? {
        images.push((time(file, line, &columns[0])?, columns[1].clone()));
    }

    images.sort();
    Ok(images)
}

/// A camera's pose on the body, and its intrinsics if the file states them.
struct Sensor {
    body_from_camera: Pose,
    camera: Option<CameraIntrinsics>,
}

fn read_sensor(file: &Path) -> Result<Sensor, Error> {
    let text = read_text(file)?;
    let malformed = |problem: Cause| Error::Malformed {
        file: file.to_owned(),
        problem,
    };

    let mounting = list(&text, "T_BS:").and_then(|numbers| <[f64; 16]>::try_from(numbers).ok());
    let mounting = mounting.ok_or_else(|| {
        malformed("has no T_BS with sixteen numbers, the camera's pose on the body".into())
    })?;
    let (body_from_camera, _) = pose_from_matrix(&Matrix4::from_row_slice(&mounting))
        .map_err(|error| malformed(error.into()))?;

    Ok(Sensor {
        body_from_camera,
        camera: camera_of(&text),
    })
}

/// The camera; `None` if it is incomplete, not valid, or of another model.
fn camera_of(text: &str) -> Option<CameraIntrinsics> {
    if word(text, "camera_model:").is_some_and(|model| model != "pinhole") {
        return None;
    }
    let [width, height] = <[f64; 2]>::try_from(list(text, "resolution:")?).ok()?;
    let [fx, fy, x, y] = <[f64; 4]>::try_from(list(text, "intrinsics:")?).ok()?;

    let model = word(text, "distortion_model:");
    let coefficients = list(text, "distortion_coefficients:");
    let distortion = match (model, coefficients.as_deref()) {
        (None | Some("none"), None | Some([])) => Distortion::None,
        (Some("radial-tangential" | "radtan"), Some(&[k1, k2, p1, p2])) => {
            Distortion::brown_conrady([k1, k2, p1, p2, 0.0])
        }
        (Some("equidistant"), Some(&[k1, k2, k3, k4])) => {
            Distortion::KannalaBrandt([k1, k2, k3, k4])
        }
        _ => return None,
    };

    // The calibration is OpenCV's: the center of the first pixel is at (0, 0).
    let camera = PixelCamera {
        width,
        height,
        focal: [fx, fy].into(),
        center: Some([x + 0.5, y + 0.5].into()),
        distortion,
    };
    CameraIntrinsics::new(camera).ok()
}

/// The text after a key, up to the end of the line or a comment.
fn word<'a>(text: &'a str, key: &str) -> Option<&'a str> {
    let after = &text[text.find(key)? + key.len()..];
    after.split(['\n', '#']).next().map(str::trim)
}

/// The numbers in the first brackets after a key: not general YAML, only the form of these files.
fn list(text: &str, key: &str) -> Option<Vec<f64>> {
    let after = &text[text.find(key)? + key.len()..];
    let inside = after.split_once('[')?.1.split_once(']')?.0;
    inside
        .split(',')
        .map(|word| word.trim().parse().ok())
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand, in the form of the published files.
    #[test]
    fn lists_are_found_by_their_keys() {
        let yaml = "sensor_type: camera\nT_BS:\n  cols: 4\n  data: [0.0, -1.0,\n         2.5]\nresolution: [752, 480]\n";
        assert_eq!(list(yaml, "T_BS:"), Some(vec![0.0, -1.0, 2.5]));
        assert_eq!(list(yaml, "resolution:"), Some(vec![752.0, 480.0]));
        assert_eq!(list(yaml, "intrinsics:"), None);
        assert_eq!(word(yaml, "sensor_type:"), Some("camera"));
        assert_eq!(word(yaml, "camera_model:"), None);
    }

    fn sensor(distortion: &str) -> String {
        format!(
            "resolution: [752, 480]\ncamera_model: pinhole\n\
             intrinsics: [458.654, 457.296, 367.215, 248.375] #fu, fv, cu, cv\n{distortion}"
        )
    }

    /// Oracle: the numbers of cam0 in the published recordings, in pixels whose centers are at
    /// whole numbers, by hand.
    #[test]
    fn the_published_calibration_is_read() {
        let text = sensor(
            "distortion_model: radial-tangential\n\
             distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]\n",
        );
        let camera = PixelCamera {
            width: 752.0,
            height: 480.0,
            focal: [458.654, 457.296].into(),
            center: Some([367.715, 248.875].into()),
            distortion: Distortion::BrownConrady([
                -0.283_408_11,
                0.073_959_07,
                0.000_193_59,
                1.761_871_14e-5,
                0.0,
            ]),
        };
        assert_eq!(camera_of(&text), CameraIntrinsics::new(camera).ok());
    }

    /// Oracle: by hand.
    #[test]
    fn other_lenses_are_read_or_left_out() {
        let lens = |text: &str| camera_of(&sensor(text)).map(|camera| camera.distortion());
        assert_eq!(lens(""), Some(Distortion::None));
        assert_eq!(
            lens(
                "distortion_model: equidistant\n\
                 distortion_coefficients: [0.003, 0.0007, -0.002, 0.0002]"
            ),
            Some(Distortion::KannalaBrandt([0.003, 0.0007, -0.002, 0.0002]))
        );
        assert_eq!(
            lens("distortion_model: fov\ndistortion_coefficients: [0.9]"),
            None
        );
        assert_eq!(camera_of(&sensor("").replace("pinhole", "omni")), None);
    }
}

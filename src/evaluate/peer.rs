//! A peer of matched views, run by a Python interpreter: SIFT, retrieval by VLAD, points that are
//! triangulated with the known poses, and PoseLib. `peer.py` is the method.

use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context, bail};
use nalgebra::{Matrix4, RowVector4};
use rayon::prelude::*;
use serde::Serialize;
use tempfile::TempDir;

use super::room_images::RoomImages;
use seese3_core::geometry::{CameraIntrinsics, Pose, pose_from_matrix};
use seese3_core::room::FrameId;
use seese3_encoder::encode_png;
use seese3_lab::experiments::matched_localization::PeerAnswer;

const SCRIPT: &str = include_str!("peer.py");
/// Packages that the script imports, as pip names them.
const PACKAGES: &str = "numpy opencv-python-headless poselib";

/// A Python interpreter with the packages of the script, and a temporary folder.
pub struct Peer<'a> {
    python: &'a Path,
    folder: TempDir,
}

/// What the peer maps and locates.
pub struct PeerTask<'a> {
    /// `world_from_camera` of all frames, meters.
    pub poses: &'a [Pose],
    /// Images of all frames.
    pub images: &'a RoomImages<'a>,
    /// The camera of the images.
    pub camera: CameraIntrinsics,
    /// Frames of the map.
    pub mapped: &'a [FrameId],
    /// Frames to locate.
    pub queries: &'a [FrameId],
}

/// The input of the script. The camera is in image widths.
#[derive(Serialize)]
struct Request {
    camera: CameraIntrinsics,
    mapped: Vec<MappedImage>,
    queries: Vec<QueryImage>,
}

#[derive(Serialize)]
struct MappedImage {
    image: PathBuf,
    world_from_camera: [[f64; 4]; 3],
}

#[derive(Serialize)]
struct QueryImage {
    image: PathBuf,
}

impl<'a> Peer<'a> {
    /// Checks that `python` runs and has the packages of the script.
    pub fn new(python: &'a Path) -> anyhow::Result<Self> {
        let folder = tempfile::tempdir().context("cannot create a temporary folder")?;
        let peer = Self { python, folder };
        std::fs::write(peer.script(), SCRIPT)
            .with_context(|| peer.script().display().to_string())?;

        let output = Command::new(python).arg(peer.script()).output();
        let output = output.with_context(|| {
            format!(
                "--peer: cannot run {}; give a Python interpreter",
                python.display()
            )
        })?;
        if !output.status.success() {
            let problem = last_line(&String::from_utf8_lossy(&output.stderr));
            bail!(
                "--peer: {problem}; install the packages with `{} -m pip install {PACKAGES}`",
                python.display()
            );
        }

        Ok(peer)
    }

    /// The peer's answers to the queries, in their order. `done` is called after each answer.
    pub fn locate(&self, task: &PeerTask<'_>, done: &dyn Fn()) -> anyhow::Result<Vec<PeerAnswer>> {
        let request = self.folder.path().join("request.json");
        let content = serde_json::to_vec(&self.request(task)?)?;
        std::fs::write(&request, content).with_context(|| request.display().to_string())?;

        // Errors go to a file: a pipe that is not read while answers are would fill up.
        let errors = self.folder.path().join("errors.txt");
        let stderr = File::create(&errors).with_context(|| errors.display().to_string())?;
        let mut process = Command::new(self.python)
            .arg(self.script())
            .arg(&request)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(stderr)
            .spawn()
            .with_context(|| format!("--peer: cannot run {}", self.python.display()))?;
        let stdout = process.stdout.take().context("--peer: no output")?;

        let mut answers = Vec::with_capacity(task.queries.len());
        for line in BufReader::new(stdout).lines() {
            answers.push(answer(&line?, answers.len() + 1)?);
            done();
        }

        let status = process.wait()?;
        if !status.success() {
            let problem = std::fs::read_to_string(&errors).unwrap_or_default();
            bail!(
                "--peer: {} failed ({status}): {}",
                self.python.display(),
                last_line(&problem)
            );
        }
        if answers.len() != task.queries.len() {
            bail!(
                "--peer: {} gave {} answers to {} views",
                self.python.display(),
                answers.len(),
                task.queries.len()
            );
        }

        let of_frame = |(&frame, pose)| PeerAnswer { frame, pose };
        Ok(task.queries.iter().zip(answers).map(of_frame).collect())
    }

    fn script(&self) -> PathBuf {
        self.folder.path().join("peer.py")
    }

    fn request(&self, task: &PeerTask<'_>) -> anyhow::Result<Request> {
        let mapped = task.mapped.par_iter().map(|frame| {
            Ok(MappedImage {
                image: self.image(task.images, frame.row())?,
                world_from_camera: rows(&task.poses[frame.row()]),
            })
        });
        let queries = task.queries.par_iter().map(|frame| {
            Ok(QueryImage {
                image: self.image(task.images, frame.row())?,
            })
        });

        Ok(Request {
            camera: task.camera,
            mapped: mapped.collect::<anyhow::Result<_>>()?,
            queries: queries.collect::<anyhow::Result<_>>()?,
        })
    }

    /// The file of a frame's image. An image without a file of its own is written as PNG.
    fn image(&self, images: &RoomImages<'_>, row: usize) -> anyhow::Result<PathBuf> {
        if let Some(file) = images.file(row) {
            return Ok(file);
        }

        let file = self.folder.path().join(format!("frame-{row:06}.png"));
        let image = encode_png(&images.image(row)?)?;
        std::fs::write(&file, image).with_context(|| file.display().to_string())?;
        Ok(file)
    }
}

/// The upper three rows of the matrix of a pose.
fn rows(pose: &Pose) -> [[f64; 4]; 3] {
    let matrix = pose.to_homogeneous();
    [0, 1, 2].map(|row| [0, 1, 2, 3].map(|column| matrix[(row, column)]))
}

/// The pose of line `number` of the output; `None` if the view was refused.
fn answer(line: &str, number: usize) -> anyhow::Result<Option<Pose>> {
    let wrong =
        || format!("--peer: line {number} of the output is neither null nor a pose: {line}");
    let rows: Option<[[f64; 4]; 3]> = serde_json::from_str(line).with_context(wrong)?;
    let Some(rows) = rows else { return Ok(None) };

    let [x, y, z] = rows.map(RowVector4::from);
    let matrix = Matrix4::from_rows(&[x, y, z, RowVector4::new(0.0, 0.0, 0.0, 1.0)]);
    let (pose, _) = pose_from_matrix(&matrix).with_context(wrong)?;
    Ok(Some(pose))
}

/// The last line that is not empty: Python's message of an error.
fn last_line(text: &str) -> String {
    let mut lines = text.lines().rev();
    let last = lines.find(|line| !line.trim().is_empty());
    last.unwrap_or("no message").trim().to_owned()
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;
    use nalgebra::Vector3;
    use seese3_core::geometry::{Distortion, PixelCamera};
    use seese3_encoder::read_image;
    use seese3_studio::Suite;

    /// An executable shell script that stands for a Python interpreter with the packages. It gets
    /// the script as $1 and the request as $2, and runs `body` if there is a request.
    fn interpreter(folder: &Path, body: &str) -> PathBuf {
        executable(folder, &format!("[ -z \"$2\" ] && exit 0\n{body}"))
    }

    /// Copied by another process: a file that is open for writing, here or in a test beside this
    /// one that starts a process, cannot be run.
    fn executable(folder: &Path, script: &str) -> PathBuf {
        let [source, file] = ["source", "python"].map(|name| folder.join(name));
        std::fs::write(&source, format!("#!/bin/sh\n{script}\n")).unwrap();
        std::fs::set_permissions(&source, std::fs::Permissions::from_mode(0o755)).unwrap();
        let copied = Command::new("cp").arg(&source).arg(&file).status();
        assert!(copied.unwrap().success());
        file
    }

    /// Three frames with one image: the first is mapped, the others are located.
    fn located(folder: &Path, body: &str) -> anyhow::Result<Vec<PeerAnswer>> {
        std::fs::write(folder.join("a.jpg"), "").unwrap();
        let names = ["a.jpg", "a.jpg", "a.jpg"].map(str::to_owned);
        let images = RoomImages::Folder {
            root: folder.to_owned(),
            images: &names,
        };
        located_in(folder, &images, body)
    }

    fn located_in(
        folder: &Path,
        images: &RoomImages<'_>,
        body: &str,
    ) -> anyhow::Result<Vec<PeerAnswer>> {
        let python = interpreter(folder, body);
        let poses = [Pose::new(Vector3::new(1.0, 2.0, 3.0), Vector3::zeros()); 3];
        let camera = PixelCamera {
            width: 640.0,
            height: 480.0,
            focal: [320.0, 320.0].into(),
            center: None,
            distortion: Distortion::BrownConrady([0.5, 0.0, 0.0, 0.0, 0.0]),
        };

        Peer::new(&python)?.locate(
            &PeerTask {
                poses: &poses,
                images,
                camera: CameraIntrinsics::new(camera)?,
                mapped: &[FrameId(0)],
                queries: &[FrameId(1), FrameId(2)],
            },
            &|| (),
        )
    }

    /// Oracle: by hand. The peer refuses one view, and puts the other at (4, 5, 6), turned by 90°
    /// about z: x becomes y.
    #[test]
    fn one_line_of_the_output_is_one_answer() {
        let folder = tempfile::tempdir().unwrap();
        let lines = "echo null; echo '[[0,-1,0,4],[1,0,0,5],[0,0,1,6]]'";
        let answers = located(folder.path(), lines).unwrap();

        assert_eq!(
            [answers[0].frame, answers[1].frame],
            [FrameId(1), FrameId(2)]
        );
        assert!(answers[0].pose.is_none());
        let pose = answers[1].pose.unwrap();
        assert_eq!(pose.translation.vector, Vector3::new(4.0, 5.0, 6.0));
        assert!((pose.rotation * Vector3::x() - Vector3::y()).norm() < 1e-12);
    }

    /// Oracle: the form that `peer.py` states, by hand. Lengths of the camera are in image widths:
    /// 320 / 640 and 480 / 640.
    #[test]
    fn the_request_holds_camera_poses_and_images() {
        let folder = tempfile::tempdir().unwrap();
        let copy = folder.path().join("copy.json");
        let body = format!("cp \"$2\" {}; echo null; echo null", copy.display());
        located(folder.path(), &body).unwrap();

        let text = std::fs::read_to_string(copy).unwrap();
        let request: serde_json::Value = serde_json::from_str(&text).unwrap();
        let image = folder.path().join("a.jpg");
        let expected = serde_json::json!({
            "camera": {
                "focal": [0.5, 0.5],
                "height": 0.75,
                "center": [0.5, 0.375],
                "distortion": {
                    "model": "brown_conrady", "coefficients": [0.5, 0.0, 0.0, 0.0, 0.0]
                },
            },
            "mapped": [{
                "image": image,
                "world_from_camera": [
                    [1.0, 0.0, 0.0, 1.0], [0.0, 1.0, 0.0, 2.0], [0.0, 0.0, 1.0, 3.0]
                ],
            }],
            "queries": [{ "image": image }, { "image": image }],
        });
        assert_eq!(request, expected);
    }

    /// Oracle: the film.
    #[test]
    fn drawn_images_are_written_for_the_peer() {
        let folder = tempfile::tempdir().unwrap();
        let film = Suite::Walks.film(5, 0, 3);
        let drawn = film.image(2, 32, 24);
        let images = RoomImages::Film {
            film: Box::new(film),
            size: (32, 24),
        };
        let body = format!(
            "cp \"$(dirname \"$2\")/frame-000002.png\" {}; echo null; echo null",
            folder.path().join("copy.png").display()
        );
        located_in(folder.path(), &images, &body).unwrap();
        assert_eq!(read_image(folder.path(), "copy.png").unwrap(), drawn);
    }

    /// Oracle: the ways in which a program can fail.
    #[test]
    fn a_peer_that_fails_is_named_with_its_message() {
        let folder = tempfile::tempdir().unwrap();
        let pose = "[[1,0,0,0],[0,1,0,0],[0,0,1,0]]";
        for (body, words) in [
            ("echo null", "gave 1 answers to 2 views"),
            ("echo no; echo null", "line 1 of the output is neither"),
            (
                "echo null; echo '[[1,2]]'",
                "line 2 of the output is neither",
            ),
            (
                "echo null; echo '[[1,0,0,0],[0,1,0,0],[0,0,0,0]]'",
                "line 2 of the output is neither",
            ),
            (
                &format!("echo '{pose}'; echo 'Error: no memory' >&2; exit 3"),
                "failed (exit status: 3): Error: no memory",
            ),
        ] {
            let error = located(folder.path(), body).unwrap_err().to_string();
            assert!(
                error.starts_with("--peer: ") && error.contains(words),
                "{body}: {error}"
            );
        }
    }

    /// Oracle: the packages that the script imports.
    #[test]
    fn missing_packages_and_interpreters_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let python = folder.path().join("python");
        let error = Peer::new(&python).err().unwrap().to_string();
        assert!(error.contains("--peer: cannot run"), "{error}");

        let python = executable(folder.path(), "echo \"No module named 'cv2'\" >&2; exit 1");
        let error = Peer::new(&python).err().unwrap().to_string();
        for words in [
            "No module named 'cv2'",
            "pip install numpy opencv-python-headless poselib",
        ] {
            assert!(error.contains(words), "{error}");
        }
    }
}

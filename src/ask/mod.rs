//! Requests to a running server: one file per command, and shared code.

mod catalog;
mod localize;
mod motion;
mod navigate;
mod plan;
mod relocalize;
mod wire_json;

pub use catalog::Catalog;
pub use localize::Localize;
pub use motion::Motion;
pub use navigate::Navigate;
#[cfg(feature = "lab")]
pub use navigate::say_navigation;
pub use plan::Plan;
pub use relocalize::Relocalize;
pub use wire_json::wire_json;

use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::time::Duration;

use anyhow::{Context, bail};
use clap::Args;

use crate::camera::CameraOption;
use seese3_client::proto::v1 as pb;
use seese3_client::{Client, ClientTls, ConnectOptions};
use seese3_data::datasets::read_features;
use seese3_server::camera_to_wire;

#[derive(Debug, Args)]
pub struct Server {
    /// The server's address, HOST:PORT
    #[arg(long, env = "SEESE3_SERVER", default_value = "127.0.0.1:50051")]
    server: String,
    /// Deadline of each call, seconds, 1 to 86400. For `push` and `pull`, it is the longest time
    /// without progress; for `track`, it limits only the opening of the stream
    #[arg(long, default_value_t = 30, value_parser = clap::value_parser!(u64).range(1..=86_400))]
    deadline: u64,
    /// File with the authentication token for the server
    #[arg(long, value_name = "FILE", env = "SEESE3_TOKEN_FILE")]
    token_file: Option<PathBuf>,
    /// Certificate authorities of the server, PEM; turns TLS on
    #[arg(long, value_name = "FILE", env = "SEESE3_TLS_CA")]
    tls_ca: Option<PathBuf>,
    /// Certificate of this client, PEM, if the server requires one
    #[arg(long, value_name = "FILE", requires_all = ["tls_key", "tls_ca"])]
    tls_cert: Option<PathBuf>,
    /// Private key of the certificate, PEM
    #[arg(long, value_name = "FILE", requires = "tls_cert")]
    tls_key: Option<PathBuf>,
}

impl Server {
    /// Connects to the server. The deadline applies to every later call.
    pub async fn connect(&self) -> anyhow::Result<Client> {
        let read = |option: &str, file: &PathBuf| {
            seese3_files::read(file, seese3_files::SMALL_FILE_BYTES)
                .with_context(|| format!("{option}: {} cannot be read", file.display()))
        };

        let token = match &self.token_file {
            None => None,
            Some(file) => {
                let text = String::from_utf8(read("--token-file", file)?);
                let text = text.ok().filter(|text| !text.trim().is_empty());
                let text =
                    text.with_context(|| format!("--token-file: {} has no token", file.display()))?;
                Some(text.trim().to_owned())
            }
        };

        let identity = match (&self.tls_cert, &self.tls_key) {
            (Some(cert), Some(key)) => Some((read("--tls-cert", cert)?, read("--tls-key", key)?)),
            _ => None,
        };
        let tls = match &self.tls_ca {
            None => None,
            Some(file) => Some(ClientTls {
                authorities: read("--tls-ca", file)?,
                identity,
            }),
        };

        let options = ConnectOptions {
            deadline: Duration::from_secs(self.deadline),
            token,
            tls,
        };
        Ok(Client::connect_with(&self.server, options).await?)
    }
}

/// A view from outside the room: one row of a NumPy file of features, or an image file.
#[derive(Debug, Args)]
struct FeatureRow {
    /// A JPEG or PNG file; the server must have been started with --encoder
    #[arg(long, value_name = "FILE", conflicts_with_all = ["feature_file", "row"])]
    image: Option<PathBuf>,
    /// A NumPy file of features, shape (n, d); --row chooses one
    #[arg(long, value_name = "FILE", requires = "row")]
    feature_file: Option<PathBuf>,
    /// The row of the --feature-file, counted from 0
    #[arg(long)]
    row: Option<usize>,
}

impl FeatureRow {
    /// The view: a frame of the room if one is given, else the image or the feature.
    fn or_frame(&self, frame: Option<u32>, missing: &'static str) -> anyhow::Result<pb::View> {
        match (frame, &self.image, &self.feature_file, self.row) {
            (_, _, None, Some(_)) => bail!("--row needs --feature-file FILE"),
            (Some(frame), ..) => Ok(frame_view(frame)),
            (_, Some(file), ..) => image_view(file),
            (_, _, Some(file), Some(row)) => feature_view(file, row),
            _ => bail!(missing),
        }
    }
}

/// The camera of the images of a request.
#[derive(Debug, Clone, Copy)]
pub enum ViewCamera {
    Stated(CameraOption),
    Mapping,
}

impl FromStr for ViewCamera {
    type Err = anyhow::Error;

    fn from_str(text: &str) -> anyhow::Result<Self> {
        match text {
            "mapping" => Ok(Self::Mapping),
            stated => Ok(Self::Stated(stated.parse()?)),
        }
    }
}

impl ViewCamera {
    pub fn to_wire(self) -> pb::ViewCamera {
        use pb::view_camera::Camera;

        let camera = match self {
            Self::Stated(CameraOption(camera)) => Camera::Intrinsics(camera_to_wire(&camera)),
            Self::Mapping => Camera::MappingCamera(pb::MappingCamera {}),
        };
        pb::ViewCamera {
            camera: Some(camera),
        }
    }
}

/// The method of a pose in words.
fn method_text(method: pb::LocalizationMethod) -> &'static str {
    match method {
        pb::LocalizationMethod::Unspecified => "no pose",
        pb::LocalizationMethod::MatchedKeypoints => "matched keypoints",
        pb::LocalizationMethod::FittedAdapter => "fitted adapter",
        pb::LocalizationMethod::SimilarFrames => "similar frames",
        pb::LocalizationMethod::NearestFrame => "nearest frame",
        pb::LocalizationMethod::Recorded => "recorded",
    }
}

/// A pose with its standard deviations and the method that gave it.
fn estimate_text(pose: &pb::PoseWithCovariance, method: pb::LocalizationMethod) -> String {
    format!(
        "camera at {}{} ({})",
        pose_text(pose.pose.as_ref()),
        deviations_text(&pose.covariance),
        method_text(method)
    )
}

fn matches_text(matches: &pb::KeypointMatches) -> String {
    format!(
        "{} of {} keypoints agree with {} frames",
        matches.inliers,
        matches.keypoints,
        matches.frame_ids.len()
    )
}

fn fitted_text(fitted: &pb::FittedEstimate) -> String {
    format!(
        "adapter {}, from frame {}, distance {:.3}: translation {} × gain {:.1}, rotation {} × gain {:.1}",
        revision(fitted.adapter.as_ref()),
        fitted.frame_id,
        fitted.distance,
        estimator_text(fitted.translation_estimator()),
        fitted.translation_gain,
        estimator_text(fitted.rotation_estimator()),
        fitted.rotation_gain
    )
}

fn estimator_text(estimator: pb::RelativeEstimator) -> &'static str {
    match estimator {
        pb::RelativeEstimator::Unspecified => "unknown",
        pb::RelativeEstimator::Fitted => "fitted",
        pb::RelativeEstimator::ZeroShot => "zero-shot",
        pb::RelativeEstimator::NearestFrame => "nearest frame",
    }
}

fn feature_view(file: &Path, row: usize) -> anyhow::Result<pb::View> {
    let features = read_features(file)?;
    if row >= features.nrows() {
        bail!(
            "{} has {} rows; --row {row} is out of range (rows are counted from 0)",
            file.display(),
            features.nrows()
        );
    }

    // A NumPy file does not name its features, so the name of the set stays empty and the server
    // can only check the width.
    let feature = pb::Feature {
        values: features.row(row).to_vec(),
        feature_set: String::new(),
    };

    Ok(pb::View {
        view: Some(pb::view::View::Feature(feature)),
    })
}

fn image_view(file: &Path) -> anyhow::Result<pb::View> {
    let bytes = seese3_files::read(file, seese3_files::IMAGE_FILE_BYTES);
    let bytes = bytes.with_context(|| file.display().to_string())?;
    Ok(pb::View {
        view: Some(pb::view::View::Image(bytes)),
    })
}

fn frame_view(frame: u32) -> pb::View {
    pb::View {
        view: Some(pb::view::View::FrameId(frame)),
    }
}

fn error_text(error: &pb::PoseError) -> String {
    // ‖Δ‖ is the norm of the difference between the wanted and the retrieved motion, meters and
    // radians mixed: Hit@ε compares it with ε.
    format!(
        "  error {:.3} m {:.2}°, ‖Δ‖ {:.3}",
        error.translation_m,
        error.rotation_rad.to_degrees(),
        error.twist_norm,
    )
}

fn frame_text(frame: &pb::RetrievedFrame) -> String {
    format!(
        "frame {:5}  distance {:.4}  at {}",
        frame.frame_id,
        frame.distance,
        pose_text(frame.pose.as_ref())
    )
}

fn pose_text(pose: Option<&pb::Pose>) -> String {
    let pose = pose.cloned().unwrap_or_default();
    let p = pose.position.unwrap_or_default();
    let q = pose.orientation.unwrap_or_default();

    format!(
        "({:.3}, {:.3}, {:.3}) m, xyzw ({:.3}, {:.3}, {:.3}, {:.3}) in {}",
        p.x, p.y, p.z, q.x, q.y, q.z, q.w, pose.parent_frame
    )
}

/// Standard deviations of position and rotation, one number each: the root of the sum of the
/// variances along the three axes. Empty if the covariance is unknown.
fn deviations_text(covariance: &[f64]) -> String {
    let Some(variances) = diagonal(covariance) else {
        return String::new();
    };

    let deviation = |part: &[f64]| part.iter().sum::<f64>().sqrt();
    let meters = deviation(&variances[..3]);
    let degrees = deviation(&variances[3..]).to_degrees();

    // A rotation error is at most 180°.
    if degrees < 180.0 {
        format!(", ± {meters:.3} m, ± {degrees:.2}°")
    } else {
        format!(", ± {meters:.3} m, rotation unknown")
    }
}

fn motion_text(motion: &pb::Twist) -> String {
    let v = motion.linear.unwrap_or_default();
    let w = motion.angular.unwrap_or_default();

    format!(
        "v ({:.4}, {:.4}, {:.4}) m, ω ({:.4}, {:.4}, {:.4}) rad",
        v.x, v.y, v.z, w.x, w.y, w.z
    )
}

/// "1 room", "3 rooms".
fn rooms_text(count: u32) -> String {
    match count {
        1 => "1 room".to_owned(),
        count => format!("{count} rooms"),
    }
}

fn revision(revision: Option<&pb::Revision>) -> String {
    revision.map_or(String::new(), |revision| {
        revision_text(&revision.name, revision.revision)
    })
}

fn revision_text(name: &str, revision: u64) -> String {
    format!("'{name}' revision {revision}")
}

/// The name of an enum's value without the name of the enum, in small letters.
fn value_text(name: &str, of: &str) -> String {
    name.trim_start_matches(of).to_lowercase().replace('_', "-")
}

/// The diagonal of a row-major 6×6 matrix; `None` for another length.
fn diagonal(matrix: &[f64]) -> Option<[f64; 6]> {
    (matrix.len() == 36).then(|| std::array::from_fn(|row| matrix[7 * row]))
}

//! `seese3 navigate`, `localize`, `motion` and `catalog`: requests to a running server.

use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, bail};
use clap::Args;

use super::camera::CameraOption;
use super::named::one_of;
use super::say;
use crate::datasets::read_features;
use seese3_client::proto::v1 as pb;
use seese3_client::{Client, ClientTls, ConnectOptions};
use seese3_core::adapter::Reading;
use seese3_core::navigation::Mode;

#[derive(Debug, Args)]
pub struct Server {
    /// The server's address, HOST:PORT
    #[arg(long, env = "SEESE3_SERVER", default_value = "127.0.0.1:50051")]
    server: String,
    /// Deadline of each call, seconds, 1 to 86400; of a stream (`track`) only until it is open
    #[arg(long, default_value_t = 30, value_parser = clap::value_parser!(u64).range(1..=86_400))]
    deadline: u64,
    /// File with the token that the server asks for
    #[arg(long, value_name = "FILE", env = "SEESE3_TOKEN_FILE")]
    token_file: Option<PathBuf>,
    /// Authorities of the server's certificate, in PEM: the connection is TLS
    #[arg(long, value_name = "FILE", env = "SEESE3_TLS_CA")]
    tls_ca: Option<PathBuf>,
    /// This client's certificate in PEM, if the server asks for one
    #[arg(long, value_name = "FILE", requires_all = ["tls_key", "tls_ca"])]
    tls_cert: Option<PathBuf>,
    /// The private key of the certificate, in PEM
    #[arg(long, value_name = "FILE", requires = "tls_cert")]
    tls_key: Option<PathBuf>,
}

impl Server {
    /// Connects to the server, with the deadline for every later call.
    pub async fn connect(&self) -> anyhow::Result<Client> {
        let read = |option: &str, file: &PathBuf| {
            std::fs::read(file)
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
    #[arg(long, value_name = "FILE", conflicts_with_all = ["feature", "row"])]
    image: Option<PathBuf>,
    /// A NumPy file of features, shape (n, d); --row chooses one
    #[arg(long, value_name = "FILE", requires = "row")]
    feature: Option<PathBuf>,
    /// The row of the --feature file, counted from 0
    #[arg(long)]
    row: Option<usize>,
}

impl FeatureRow {
    fn view(&self) -> anyhow::Result<Option<pb::View>> {
        if let Some(file) = &self.image {
            return Ok(Some(image_view(file)?));
        }

        match (&self.feature, self.row) {
            (Some(file), Some(row)) => Ok(Some(feature_view(file, row)?)),
            (None, Some(_)) => bail!("--row needs --feature FILE"),
            _ => Ok(None),
        }
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

    // A NumPy file does not say which encoder made it, so the source name stays empty and the
    // server can only check the width.
    let feature = pb::Feature {
        values: features.row(row).to_vec(),
        source_name: String::new(),
    };

    Ok(pb::View {
        view: Some(pb::view::View::Feature(feature)),
    })
}

fn image_view(file: &Path) -> anyhow::Result<pb::View> {
    let bytes = std::fs::read(file).with_context(|| file.display().to_string())?;
    Ok(pb::View {
        view: Some(pb::view::View::Image(bytes)),
    })
}

fn frame_view(frame: u32) -> pb::View {
    pb::View {
        view: Some(pb::view::View::FrameId(frame)),
    }
}

#[derive(Debug, Args)]
pub struct Navigate {
    #[command(flatten)]
    server: Server,
    /// Name of the room to navigate in
    #[arg(long)]
    room: String,
    /// Name of the adapter; if empty, the default of the room: one that was fitted to it, then one that
    /// was trained in it, then the newest that fits
    #[arg(long, default_value = "")]
    adapter: String,
    /// Start at this frame of the room (its row, counted from 0)
    #[arg(long, conflicts_with_all = ["feature", "image"])]
    from: Option<u32>,
    #[command(flatten)]
    feature: FeatureRow,
    /// Go to this frame of the room: the motion is computed from the recorded poses
    #[arg(long, conflicts_with = "twist")]
    to: Option<u32>,
    /// The motion as vx,vy,vz,wx,wy,wz (se(3) twist), metres and radians, in the body frame of the
    /// start camera (x right, y down, z forward)
    #[arg(long, value_delimiter = ',', allow_hyphen_values = true)]
    twist: Option<Vec<f64>>,
    /// Number of equal steps that the motion is divided into
    #[arg(long, default_value_t = 1)]
    steps: u32,
    /// Where each step starts from
    #[arg(long, value_parser = one_of::<Mode>(), default_value = "open-loop")]
    mode: Mode,
    /// How the mean μ and deviation σ of the training motions enter the inverse of W; the server
    /// takes homogeneous if neither this nor --navigator is given
    #[arg(long, value_parser = one_of::<Reading>(), conflicts_with = "navigator")]
    reading: Option<Reading>,
    /// Navigator by name, instead of inverse Poincaré: corrector-mlp-3, ridge-refit,
    /// inverse-poincare-affine+motion, …; if empty, inverse Poincaré in the given --reading
    #[arg(long, default_value = "")]
    navigator: String,
    /// Number of nearest frames returned for each step
    #[arg(long, default_value_t = 1)]
    top_k: u32,
    /// Never retrieve the frame that a step starts from
    #[arg(long)]
    exclude_source: bool,
}

impl Navigate {
    pub async fn run(self) -> anyhow::Result<()> {
        use pb::displacement::Displacement;

        // A navigation starts from exactly one view. Clap refuses two of them together; here it
        // remains to check that there is one.
        let source = match (self.from, self.feature.view()?) {
            (Some(frame), _) => frame_view(frame),
            (None, Some(view)) => view,
            (None, None) => {
                bail!("--from FRAME, --feature FILE --row ROW or --image FILE is required")
            }
        };

        let displacement = match (self.to, &self.twist) {
            (Some(frame), _) => Displacement::TargetFrameId(frame),
            (None, Some(numbers)) => Displacement::Twist(twist(numbers)?),
            (None, None) => bail!("--to FRAME or --twist vx,vy,vz,wx,wy,wz is required"),
        };

        let mode = match self.mode {
            Mode::OpenLoop => pb::Mode::OpenLoop,
            Mode::Snap => pb::Mode::Snap,
            Mode::ClosedLoop => pb::Mode::ClosedLoop,
        };

        // An unspecified reading leaves the choice to the server: homogeneous, unless --navigator
        // already names one.
        let reading = match self.reading {
            None => pb::Reading::Unspecified,
            Some(Reading::Affine) => pb::Reading::Affine,
            Some(Reading::Homogeneous) => pb::Reading::Homogeneous,
            Some(Reading::Literal) => pb::Reading::Literal,
        };

        // Fields left at their defaults are filled in by the server, the thresholds of Hit@ε
        // among them.
        let request = pb::NavigateRequest {
            room: self.room,
            adapter: self.adapter,
            source: Some(source),
            displacement: Some(pb::Displacement {
                displacement: Some(displacement),
            }),
            steps: Some(self.steps),
            mode: mode.into(),
            reading: reading.into(),
            navigator: self.navigator,
            top_k: Some(self.top_k),
            exclude_source: self.exclude_source,
            ..pb::NavigateRequest::default()
        };

        let answer = self.server.connect().await?.navigate(request).await?;
        say_navigation(&answer);

        Ok(())
    }
}

fn twist(numbers: &[f64]) -> anyhow::Result<pb::Twist> {
    let &[vx, vy, vz, wx, wy, wz] = numbers else {
        bail!(
            "--twist needs six numbers, vx,vy,vz,wx,wy,wz, got {}",
            numbers.len()
        );
    };

    let vector = |x, y, z| Some(pb::Vector3 { x, y, z });
    Ok(pb::Twist {
        linear: vector(vx, vy, vz),
        angular: vector(wx, wy, wz),
    })
}

/// Prints a navigation: the revisions used, the whole motion, and each step's nearest frames. Also
/// used by `seese3 demo`.
pub fn say_navigation(answer: &pb::NavigateResponse) {
    let room = revision(answer.room.as_ref());
    let adapter = revision(answer.adapter.as_ref());
    say(format_args!(
        "room {room}, adapter {adapter}, {}",
        answer.navigator
    ));

    if let Some(motion) = &answer.displacement {
        say(format_args!("motion {}", motion_text(motion)));
    }

    for step in &answer.steps {
        // The best frame carries the step's number and its pose error; the others are listed
        // below it.
        for (rank, frame) in step.frames.iter().enumerate() {
            let label = if rank == 0 {
                format!("step {}", step.step)
            } else {
                String::new()
            };

            let error = step
                .error
                .as_ref()
                .filter(|_| rank == 0)
                .map_or(String::new(), error_text);
            say(format_args!("{label:8}{}{error}", frame_text(frame)));
        }
    }
}

fn error_text(error: &pb::PoseError) -> String {
    let checks: Vec<String> = error
        .thresholds
        .iter()
        .map(|check| {
            format!(
                "@{} {}",
                check.threshold,
                if check.met { "hit" } else { "miss" }
            )
        })
        .collect();

    // ‖Δ‖ is the norm of the difference between the wanted and the retrieved motion, metres and
    // radians mixed: what Hit@ε compares with ε.
    format!(
        "  error {:.3} m {:.2}°, ‖Δ‖ {:.3} ({})",
        error.translation_m,
        error.rotation_rad.to_degrees(),
        error.twist_norm,
        checks.join(", ")
    )
}

fn frame_text(frame: &pb::RetrievedFrame) -> String {
    let pose = frame.pose.clone().unwrap_or_default();
    let p = pose.position.unwrap_or_default();
    let q = pose.orientation.unwrap_or_default();

    format!(
        "frame {:5}  distance {:.4}  at ({:.3}, {:.3}, {:.3}) m, wxyz ({:.3}, {:.3}, {:.3}, {:.3}) in {}",
        frame.frame_id, frame.distance, p.x, p.y, p.z, q.w, q.x, q.y, q.z, pose.parent_frame
    )
}

/// Where the camera is, and what told it.
fn located_text(located: &pb::LocatedPose) -> String {
    let pose = located.pose.clone().unwrap_or_default();
    let p = pose.position.unwrap_or_default();
    let q = pose.orientation.unwrap_or_default();

    // The diagonal of the covariance holds the variances of x, y, z and of the three rotations.
    let deviation = |first: usize| {
        let variances = (first..first + 3).filter_map(|axis| located.covariance.get(7 * axis));
        variances.sum::<f64>().sqrt()
    };

    format!(
        "camera at ({:.3}, {:.3}, {:.3}) m, wxyz ({:.3}, {:.3}, {:.3}, {:.3}) in {}, ± {:.3} m, ± {:.2}°\n\
         from frame {}, distance {:.3}: translation {} × {:.1}, rotation {} × {:.1}",
        p.x,
        p.y,
        p.z,
        q.w,
        q.x,
        q.y,
        q.z,
        pose.parent_frame,
        deviation(0),
        deviation(3).to_degrees(),
        located.frame_id,
        located.distance,
        located.translation_reader,
        located.translation_gain,
        located.rotation_reader,
        located.rotation_gain
    )
}

fn motion_text(motion: &pb::Twist) -> String {
    let v = motion.linear.unwrap_or_default();
    let w = motion.angular.unwrap_or_default();

    format!(
        "v ({:.4}, {:.4}, {:.4}) m, ω ({:.4}, {:.4}, {:.4}) rad",
        v.x, v.y, v.z, w.x, w.y, w.z
    )
}

fn revision(revision: Option<&pb::Revision>) -> String {
    revision.map_or(String::new(), |revision| {
        format!("'{}' revision {}", revision.name, revision.revision)
    })
}

#[derive(Debug, Args)]
pub struct Localize {
    #[command(flatten)]
    server: Server,
    /// A room to search; all rooms that the adapter fits if none is named; may be given several
    /// times
    #[arg(long = "room")]
    rooms: Vec<String>,
    /// Name of the adapter; may be omitted when only one fits all the rooms
    #[arg(long, default_value = "")]
    adapter: String,
    /// Use this frame as the view; exactly one --room must be given, and the frame is one of its
    /// rows
    #[arg(long, conflicts_with_all = ["feature", "image"])]
    frame: Option<u32>,
    #[command(flatten)]
    feature: FeatureRow,
    /// Number of frames returned, over all rooms, best first
    #[arg(long, default_value_t = 5)]
    top_k: u32,
}

impl Localize {
    pub async fn run(self) -> anyhow::Result<()> {
        let view = match (self.frame, self.feature.view()?) {
            (Some(frame), _) => frame_view(frame),
            (None, Some(view)) => view,
            (None, None) => {
                bail!("--feature FILE --row ROW, --image FILE or --frame FRAME is required")
            }
        };

        let request = pb::LocalizeRequest {
            rooms: self.rooms,
            adapter: self.adapter,
            view: Some(view),
            top_k: Some(self.top_k),
            ..pb::LocalizeRequest::default()
        };

        let answer = self.server.connect().await?.localize(request).await?;
        say(format_args!(
            "adapter {}, {} rooms",
            revision(answer.adapter.as_ref()),
            answer.room_count
        ));

        if let Some(located) = &answer.located {
            say(located_text(located));
        }

        // Only a view that is itself a frame of the room has a recorded pose, and hence an error.
        for place in &answer.places {
            let frame = place
                .frame
                .as_ref()
                .context("the server's answer has a place without a frame")?;
            say(format_args!(
                "{}{}",
                frame_text(frame),
                place.error.as_ref().map_or(String::new(), error_text)
            ));
        }

        Ok(())
    }
}

#[derive(Debug, Args)]
pub struct Motion {
    #[command(flatten)]
    server: Server,
    /// Name of the adapter; may be omitted when a room is named or the server has only one adapter
    #[arg(long, default_value = "")]
    adapter: String,
    /// Name of the room that --frames belong to
    #[arg(long, default_value = "")]
    room: String,
    /// Two frames of the room, A,B (rows, counted from 0); the motion is from A to B
    #[arg(
        long,
        value_delimiter = ',',
        value_name = "A,B",
        conflicts_with = "features"
    )]
    frames: Option<Vec<u32>>,
    /// Two JPEG or PNG files, A,B; the server must have been started with --encoder or --two-view
    #[arg(long, value_delimiter = ',', value_name = "A,B", conflicts_with_all = ["frames", "features"])]
    images: Option<Vec<PathBuf>>,
    /// The camera that took --images, in pixels. With it, a server started with --two-view compares
    /// the images themselves, unless --adapter names who reads the motion
    #[arg(long, value_name = "WIDTHxHEIGHT,FOCAL[,CX,CY]", requires = "images")]
    camera: Option<CameraOption>,
    /// A NumPy file of features, shape (n, d); --rows chooses two
    #[arg(long, value_name = "FILE", requires = "rows")]
    features: Option<PathBuf>,
    /// Two rows of the --features file, A,B, counted from 0
    #[arg(long, value_delimiter = ',', value_name = "A,B")]
    rows: Option<Vec<usize>>,
}

impl Motion {
    pub async fn run(self) -> anyhow::Result<()> {
        // Both views come from one kind of input: frames of a room, rows of a feature file, or
        // image files.
        let (first, second) = match (self.frames.as_deref(), &self.features, self.rows.as_deref()) {
            (Some(&[a, b]), _, _) => (frame_view(a), frame_view(b)),
            (None, Some(file), Some(&[a, b])) => (feature_view(file, a)?, feature_view(file, b)?),
            _ => match self.images.as_deref() {
                Some([a, b]) => (image_view(a)?, image_view(b)?),
                _ => bail!("--frames A,B, --features FILE --rows A,B or --images A,B is required"),
            },
        };

        let camera = self.camera.map(|CameraOption(camera)| pb::Pinhole {
            width: camera.width,
            height: camera.height,
            focal: camera.focal,
            centre_x: camera.centre.map(|centre| centre.x),
            centre_y: camera.centre.map(|centre| centre.y),
        });

        let request = pb::EstimateMotionRequest {
            adapter: self.adapter,
            room: self.room,
            first: Some(first),
            second: Some(second),
            camera,
            ..pb::EstimateMotionRequest::default()
        };

        let answer = self
            .server
            .connect()
            .await?
            .estimate_motion(request)
            .await?;
        let motion = answer
            .motion
            .as_ref()
            .context("the server sent no motion")?;

        match answer.reader() {
            pb::MotionReader::TwoView => say("read from where things are in both images"),
            pb::MotionReader::None => {
                say("the images show too little in common: no motion is read");
            }
            pb::MotionReader::Adapter | pb::MotionReader::Unspecified => say(format_args!(
                "adapter {}",
                revision(answer.adapter.as_ref())
            )),
        }

        say(format_args!(
            "motion {} in the body frame of the first camera",
            motion_text(motion)
        ));

        // Standard deviations: the roots of the means of the covariance's diagonal.
        if let Some(variances) = diagonal(&answer.covariance) {
            let deviation = |part: &[f64]| (part.iter().sum::<f64>() / 3.0).sqrt();
            say(format_args!(
                "give or take {:.3} m, {:.1}° along each axis",
                deviation(&variances[..3]),
                deviation(&variances[3..]).to_degrees()
            ));
        }

        // The true motion is only known when both views are frames of the room, whose poses were
        // recorded.
        if let (Some(truth), Some(error)) = (&answer.true_motion, &answer.error) {
            say(format_args!(
                "truth  {}{}",
                motion_text(truth),
                error_text(error)
            ));
        }

        Ok(())
    }
}

/// The diagonal of a 6×6 matrix, row by row; none for another length.
fn diagonal(matrix: &[f64]) -> Option<[f64; 6]> {
    (matrix.len() == 36).then(|| std::array::from_fn(|row| matrix[7 * row]))
}

#[derive(Debug, Args)]
pub struct Catalog {
    #[command(flatten)]
    server: Server,
}

impl Catalog {
    pub async fn run(self) -> anyhow::Result<()> {
        let client = self.server.connect().await?;
        for room in client.rooms().await? {
            let features: Vec<String> = room
                .features
                .iter()
                .map(|source| format!("{} ({})", source.name, source.dim))
                .collect();

            say(format_args!(
                "room {}: {} frames, features {}; adapters {}",
                revision(room.revision.as_ref()),
                room.frame_count,
                features.join(", "),
                room.adapters.join(", ")
            ));
        }

        for adapter in client.adapters().await? {
            // An adapter trained with --split whole has no test pairs, so its test R² is
            // undefined.
            let r2 = adapter
                .test
                .and_then(|test| test.overall)
                .map_or("undefined".to_owned(), |r2| format!("{r2:.3}"));

            say(format_args!(
                "adapter {}: preset {}, split {}, stride {}, test R² {r2}",
                revision(adapter.revision.as_ref()),
                adapter.preset,
                adapter.split,
                adapter.stride
            ));
        }

        Ok(())
    }
}

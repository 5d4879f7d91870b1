//! `seese3 track`: tracks a camera with a server, from features or images in files.

#[cfg_attr(not(feature = "bags"), path = "mcap_not_built.rs")]
mod mcap;

use std::path::PathBuf;

use anyhow::{Context, bail};
use clap::Args;
use tokio_stream::wrappers::ReceiverStream;

use crate::ask::{Server, ViewCamera, wire_json};
use crate::camera::CAMERA_FORM;
use crate::output::{JsonOutput, begin_output, say, write_file};
use crate::progress::bar;
use seese3_client::proto::v1 as pb;
use seese3_client::proto::v1::track_request::Message;
use seese3_client::proto::v1::track_response::Answer;
use seese3_client::{convert, one_line};
use seese3_core::geometry::Pose;
use seese3_data::datasets::read_features;
use seese3_data::export::tum_trajectory;

/// Capacity of the queue of unsent requests.
const WAITING: usize = 32;

#[derive(Debug, Args)]
pub struct Track {
    #[command(flatten)]
    server: Server,
    /// Name of the room; if omitted, the server finds it among all rooms that the adapter serves
    /// or, for images if no adapter can track, among all rooms with keypoints
    #[arg(long)]
    room: Option<String>,
    /// Name of the adapter. If omitted: in a named room, the first by the rule of `navigate` that
    /// can track; without a room, the only one that can. If none can, images are tracked by
    /// keypoints
    #[arg(long)]
    adapter: Option<String>,
    /// A NumPy file of features, shape (n, d), one row per frame
    #[arg(long, value_name = "FILE", required_unless_present = "images")]
    feature_file: Option<PathBuf>,
    /// A folder of JPEG or PNG files, one per frame, in the order of their names; the server must
    /// have been started with --encoder
    #[arg(long, value_name = "FOLDER", conflicts_with = "feature_file")]
    images: Option<PathBuf>,
    /// Camera of --images, as --camera of `seese3 import`, or "mapping" for the camera that mapped
    /// the room. In a room with keypoints, the focal length of an unknown camera is estimated
    #[arg(long, value_name = CAMERA_FORM, requires = "images")]
    camera: Option<ViewCamera>,
    /// First frame to send, counted from 0
    #[arg(long, default_value_t = 0)]
    first: usize,
    /// Number of frames to send; all remaining ones if omitted
    #[arg(long)]
    count: Option<usize>,
    /// Frame rate, frames per second: frame i gets the timestamp i / rate seconds
    #[arg(long, default_value_t = 30.0)]
    rate: f64,
    /// Dead reckoning only: no drift correction from the map
    #[arg(long)]
    no_fusion: bool,
    /// Continue an earlier stream from the resume token in this file, which --save-token wrote
    #[arg(long, value_name = "FILE", conflicts_with_all = ["room", "adapter", "no_fusion", "camera"])]
    resume: Option<PathBuf>,
    /// Write the resume token of the last answer to this file
    #[arg(long, value_name = "FILE")]
    save_token: Option<PathBuf>,
    /// Write the camera's trajectory in the frame `map`, the room's world frame, as a TUM file
    #[arg(long, value_name = "FILE")]
    tum: Option<PathBuf>,
    /// Write the camera's trajectory in the frame `odom`, continuous but drifting, as a TUM file
    #[arg(long, value_name = "FILE")]
    odom_tum: Option<PathBuf>,
    /// Write poses, transforms and images as an MCAP file, which Foxglove opens
    #[arg(long = "mcap", value_name = "FILE")]
    recording: Option<PathBuf>,
    #[command(flatten)]
    json: JsonOutput,
}

/// The server's answers, sorted by kind, with the frame names and the last resume token.
#[derive(Default)]
struct ReceivedAnswers {
    updates: Vec<pb::TrackUpdate>,
    refusals: Vec<pb::TrackRefusal>,
    names: pb::FrameNames,
    token: Vec<u8>,
}

impl ReceivedAnswers {
    /// Number of answers to frames.
    fn answered(&self) -> usize {
        self.updates.len() + self.refusals.len()
    }
}

impl Track {
    #[expect(
        clippy::too_many_lines,
        reason = "one command, from its arguments to what it prints"
    )]
    pub async fn run(self) -> anyhow::Result<()> {
        self.json.begin()?;

        // Check the output paths before the stream starts.
        for path in [&self.save_token, &self.tum, &self.odom_tum, &self.recording]
            .into_iter()
            .flatten()
        {
            begin_output(path)?;
        }

        if !(self.rate.is_finite() && self.rate > 0.0) {
            bail!("--rate must be above 0, got {}", self.rate);
        }

        let views = self.views()?;
        if self.first >= views.len() {
            bail!("--first {}: there are {} frames", self.first, views.len());
        }

        let end = self.count.map_or(views.len(), |count| {
            self.first.saturating_add(count).min(views.len())
        });

        let config = self.config()?;

        // The sending task consumes the views; the MCAP file needs the image paths afterwards.
        let images = views.clone();
        let client = self.server.connect().await?;
        let (sender, requests) = tokio::sync::mpsc::channel(WAITING);

        let from = self.first;
        let hz = self.rate;

        // A separate task sends the frames while this one reads answers: with unread answers, the
        // server would stop accepting frames.
        tokio::spawn(async move {
            let frames =
                (from..end).map(|row| Some(Message::Frame(frame(row, views[row].view()?, hz))));

            // An image that has disappeared since the folder was listed ends the stream early.
            for message in [Some(Message::Config(config))]
                .into_iter()
                .chain(frames)
                .map_while(|message| message)
            {
                // The stream is closed; the reading side receives the reason as its error.
                if sender
                    .send(pb::TrackRequest {
                        message: Some(message),
                    })
                    .await
                    .is_err()
                {
                    return;
                }
            }
        });

        let mut answers = client.track(ReceiverStream::new(requests)).await?;
        let progress = bar((end - from) as u64, "tracking");
        let mut heard = ReceivedAnswers::default();
        let mut ended = Ok(());
        let mut lines = self.json.lines()?;

        loop {
            let answer = match answers.message().await {
                Ok(Some(answer)) => answer,
                Ok(None) if heard.answered() < end - from => {
                    ended = Err(anyhow::anyhow!(
                        "the stream ended after answers to {} of {} frames",
                        heard.answered(),
                        end - from
                    ));
                    break;
                }
                Ok(None) => break,
                // Keep the answers received so far: with the last token, another server can
                // continue the stream.
                Err(status) => {
                    ended = Err(seese3_client::Error::from(status).into());
                    break;
                }
            };

            // A token holds the tracker's state after its answer; only the newest is needed.
            if !answer.resume_token.is_empty() {
                heard.token = answer.resume_token;
            }

            match answer.answer {
                Some(Answer::Started(started)) => {
                    heard.names = started.frame_names.unwrap_or_default()
                }
                Some(Answer::Update(update)) => {
                    if let Some(lines) = &mut lines {
                        lines.write(&wire_json("TrackUpdate", &update)?)?;
                    }
                    heard.updates.push(update);
                }
                Some(Answer::Refusal(refusal)) => {
                    if let Some(lines) = &mut lines {
                        lines.write(&wire_json("TrackRefusal", &refusal)?)?;
                    }
                    heard.refusals.push(refusal);
                }
                _ => {}
            }

            if heard.answered() > end - from {
                ended = Err(anyhow::anyhow!(
                    "the server answered more frames than were sent"
                ));
                break;
            }
            progress.inc(1);
        }

        progress.finish_and_clear();

        // Report what was received even if the stream failed; then return the error.
        self.report(&heard, &images)?;
        ended?;

        match heard.refusals.as_slice() {
            [] => Ok(()),
            [first, ..] => bail!(
                "{} of {} frames were refused: {}",
                heard.refusals.len(),
                end - from,
                first.message
            ),
        }
    }

    fn views(&self) -> anyhow::Result<Vec<RecordedView>> {
        if let Some(file) = &self.feature_file {
            return Ok(read_features(file)?
                .outer_iter()
                .map(|row| RecordedView::Feature(row.to_vec()))
                .collect());
        }

        let folder = self
            .images
            .as_ref()
            .context("give --feature-file FILE or --images FOLDER")?;
        let entries = std::fs::read_dir(folder)
            .with_context(|| format!("{} cannot be read", folder.display()))?;

        let mut files = Vec::new();
        for entry in entries {
            let path = entry?.path();
            let extension = path
                .extension()
                .map(|extension| extension.to_string_lossy().to_lowercase());

            if matches!(extension.as_deref(), Some("jpg" | "jpeg" | "png")) {
                files.push(path);
            }
        }

        // Frames are ordered by name, so the numbers in the names need equal length.
        files.sort();
        if files.is_empty() {
            bail!("{} has no .jpg, .jpeg or .png file", folder.display());
        }

        Ok(files.into_iter().map(RecordedView::Image).collect())
    }

    fn config(&self) -> anyhow::Result<pb::TrackConfig> {
        if let Some(file) = &self.resume {
            let resume_token = seese3_files::read(file, seese3_files::SMALL_FILE_BYTES)
                .with_context(|| format!("{} cannot be read", file.display()))?;
            if resume_token.is_empty() {
                bail!("{} is empty; it needs a resume token", file.display());
            }

            // A token carries the configuration of its stream, so every other field has to be
            // empty.
            return Ok(pb::TrackConfig {
                resume_token,
                ..pb::TrackConfig::default()
            });
        }

        // Located views correct the drift of dead reckoning.
        let fusion = if self.no_fusion {
            pb::Fusion::None
        } else {
            pb::Fusion::Anchors
        };

        Ok(pb::TrackConfig {
            camera: self.camera.map(ViewCamera::to_wire),
            room: self.room.clone().unwrap_or_default(),
            adapter: self.adapter.clone().unwrap_or_default(),
            fusion: fusion as i32,
            // Tokens are most of an answer's bytes, so they are requested only for --save-token.
            token_every: self.save_token.is_none().then_some(0),
            ..pb::TrackConfig::default()
        })
    }

    fn report(&self, heard: &ReceivedAnswers, seen: &[RecordedView]) -> anyhow::Result<()> {
        // Print only changes of the tracking status, each with its reason.
        let mut before = None;
        for update in &heard.updates {
            if before != Some(update.status()) {
                let room = update.room.as_ref().map_or("", |room| &room.name);

                let status = update
                    .status()
                    .as_str_name()
                    .trim_start_matches("TRACK_STATUS_");

                let place = if room.is_empty() {
                    String::new()
                } else {
                    format!(" in {room}")
                };

                // Sequence numbers start at 1, rows of the input at 0.
                say(format_args!(
                    "frame {}: {status}{place}: {}",
                    update.sequence_number.saturating_sub(1),
                    one_line(&update.reason)
                ));

                before = Some(update.status());
            }
        }

        let tracking = heard
            .updates
            .iter()
            .filter(|update| update.status() == pb::TrackStatus::Tracking)
            .count();
        say(format_args!(
            "{} frames, {tracking} of them TRACKING",
            heard.updates.len()
        ));

        for (file, of) in [(&self.tum, map as PoseOf), (&self.odom_tum, odom as PoseOf)] {
            if let Some(file) = file {
                // Frames without a pose in that frame are omitted, for example in `map` before the
                // camera has been localized.
                let known = heard
                    .updates
                    .iter()
                    .filter_map(|update| Some((update.timestamp_ns, of(update)?)));
                let (times, poses): (Vec<i64>, Vec<Pose>) = known.unzip();
                write_file(file, tum_trajectory(&times, &poses).as_bytes())?;

                say(format_args!(
                    "wrote {} ({} poses)",
                    file.display(),
                    poses.len()
                ));
            }
        }

        if let Some(file) = &self.recording {
            write_file(file, &mcap::recorded(heard, seen)?)?;
            say(format_args!("wrote {}", file.display()));
        }
        if let Some(file) = &self.save_token
            && heard.token.is_empty()
        {
            say(format_args!(
                "no resume token came; {} is unchanged",
                file.display()
            ));
        } else if let Some(file) = &self.save_token {
            write_file(file, &heard.token)?;
            say(format_args!("wrote {}", file.display()));
        }

        Ok(())
    }
}

/// One frame of the input.
#[derive(Clone)]
enum RecordedView {
    Feature(Vec<f32>),
    Image(PathBuf),
}

impl RecordedView {
    /// The view in wire format; `None` if the image file cannot be read.
    fn view(&self) -> Option<pb::view::View> {
        match self {
            Self::Feature(values) => Some(pb::view::View::Feature(pb::Feature {
                values: values.clone(),
                feature_set: String::new(),
            })),
            Self::Image(file) => {
                let bytes = seese3_files::read(file, seese3_files::IMAGE_FILE_BYTES).ok();
                bytes.map(pb::view::View::Image)
            }
        }
    }
}

fn frame(row: usize, view: pb::view::View, hz: f64) -> pb::TrackFrame {
    let view = Some(pb::View { view: Some(view) });
    pb::TrackFrame {
        timestamp_ns: (row as f64 / hz * 1e9) as i64,
        sequence_number: row as u64 + 1,
        view,
        ..pb::TrackFrame::default()
    }
}

type PoseOf = fn(&pb::TrackUpdate) -> Option<Pose>;

fn map(update: &pb::TrackUpdate) -> Option<Pose> {
    plain(update.map_from_camera().cloned())
}

fn odom(update: &pb::TrackUpdate) -> Option<Pose> {
    plain(update.odom_from_camera().cloned())
}

/// Converts a pose without checking its frame names, which the caller knows.
fn plain(pose: Option<pb::Pose>) -> Option<Pose> {
    convert::pose(&pose?).ok()
}

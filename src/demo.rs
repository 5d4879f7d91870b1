//! `seese3 demo`: the whole pipeline in one command, on a newly rendered room.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;
use clap::Args;
use ndarray::Array2;
use rayon::prelude::*;
use serde_json::json;
use tokio::net::TcpListener;

use super::ask::{say_navigation, wire_json};
use super::output::{JsonOutput, say, say_published, write_file};
use super::progress::bar;
use super::train::{default_name, train_with_progress};
use seese3_client::proto::v1 as pb;
use seese3_client::{Client, convert};
use seese3_core::adapter::{Adapter, Preset, TrainingRecord};
use seese3_core::cancel::Cancellation;
use seese3_core::eval::{Protocol, evaluate};
use seese3_core::features::Features;
use seese3_core::navigation::NavigatorKind;
use seese3_core::navigation::{IndexKind, Navigator, StepKind};
use seese3_core::room::{Frames, Provenance, Room, RoomId, Timeline};
use seese3_core::splits::Split;
use seese3_core::training::TrainingPlan;
use seese3_encoder::{BUILTIN_DIM, builtin_source, encode_builtin};
use seese3_lab::experiments::seeds::SeededTraining;
use seese3_lab::report::{Figure, PathPlot, evaluation_table, training_json, training_table};
use seese3_store::{Store, StoredRoom};
use seese3_studio::{Camera, Scene, camera_path, render};

const ROOM: &str = "studio";
const FEATURES: &str = "builtin";
const STRIDE: u32 = 40;
const STEPS: u32 = 4;
/// Maximum number of polls, 50 ms apart, while the server loads its store: 60 s in all.
const LOADING_POLLS: u32 = 1_200;
const MOST_FRAMES: usize = 100_000;
/// Enough frames to learn motions from.
const DEFAULT_FRAMES: usize = 2_000;

#[derive(Debug, Args)]
pub struct Demo {
    /// Output folder for the store and the plot of the path; created if it does not exist
    #[arg(long, default_value = "demo-output")]
    out: PathBuf,
    /// Seed of the room, the camera path and the training, 0 to 2³² − 1
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(..=u64::from(u32::MAX)))]
    seed: u64,
    /// Number of images to render, at most 100000
    #[arg(long, default_value_t = DEFAULT_FRAMES)]
    frames: usize,
    #[command(flatten)]
    json: JsonOutput,
}

impl Demo {
    #[expect(
        clippy::too_many_lines,
        reason = "one command, from its arguments to what it prints"
    )]
    pub async fn run(self) -> anyhow::Result<()> {
        self.json.begin()?;

        // The last 20 % of the path must hold at least one test pair. A path too short for that
        // would only fail after rendering and training.
        Split::Time
            .test_pairs(&Timeline::unbroken(self.frames), STRIDE)
            .context("--frames")?;

        if self.frames > MOST_FRAMES {
            anyhow::bail!(
                "--frames must be at most {MOST_FRAMES}, got {}",
                self.frames
            );
        }

        let store_path = self.out.join("store");
        let location = store_path.to_str().context("--out is not valid UTF-8")?;

        // Creating the store first lets an unusable --out fail before anything is rendered.
        let store = Store::create(location)?;

        say(format_args!(
            "1. Drawing a room and walking a camera through it: {} images",
            self.frames
        ));

        let (room, features) = draw(self.frames, self.seed)?;
        let published = store
            .publish_room(&room, std::slice::from_ref(&features))
            .await?;
        say(format_args!(
            "   room '{ROOM}' revision {}: {location}/{}",
            published.revision, published.manifest
        ));

        say("2. Training a Poincaré adapter on the first 80 % of the path (preset paper-range)");
        let plan = TrainingPlan::of(Preset::PaperRange, Split::Time, STRIDE, self.seed);

        // `train_seeds` takes rooms in the form that the store returns. This one is built from the
        // published data, instead of being loaded again.
        let stored = StoredRoom {
            room,
            revision: published.revision,
            created: String::new(),
            features: Vec::new(),
            keypoints: None,
            tracking: None,
        };
        let rooms = [(stored, features)];

        let SeededTraining { adapter, runs } = train_with_progress(&rooms, &plan, 1)?;
        say(training_table(&runs));
        warn_if_too_short(&runs[0].record, self.frames);
        let name = default_name(&rooms, &plan);
        let adapter_published = store
            .publish_adapter(&name, &adapter, &runs[0].record, rooms[0].1.rows())
            .await?;
        say_published(&store, &format!("adapter '{name}'"), &adapter_published);

        say(format_args!(
            "3. Navigating the last 20 %, which the adapter never saw, {STRIDE} frames ahead"
        ));

        // The adapter was trained on the first 80 % of the path; the table scores it on the rest.
        let [(stored, features)] = rooms;
        let room = Arc::new(stored.room);
        say(score(&room, &features, adapter)?);

        say(format_args!(
            "4. Serving the store and querying it over gRPC: one motion of {STRIDE} frames in {STEPS} steps, closed loop"
        ));

        let picture = self.out.join("path.svg");
        let answer = serve_and_ask(&store, &room, &name, &picture).await?;

        say("Files written:");

        // Listing the files shows what a store consists of.
        for folder in [
            store_path.join("rooms").join(ROOM),
            store_path.join("adapters").join(&name),
        ] {
            for file in files_under(&folder)? {
                say(format_args!("   {}", file.display()));
            }
        }

        say(format_args!("   {}", picture.display()));
        let from = example_source(room.frame_count());
        say("Next steps:");
        say(format_args!("   seese3 serve --store {location}"));

        say(format_args!(
            "   seese3 navigate --room {ROOM} --from {from} --to {} --steps {STEPS} --mode closed-loop",
            from + STRIDE
        ));

        say(format_args!(
            "   seese3 evaluate --store {location} --room {ROOM} --exclude-source"
        ));

        say("(in a checkout, run `cargo run --release --` instead of `seese3`)");
        self.json.write(&json!({
            "store": location,
            "room": ROOM,
            "training": training_json(&runs, &name, adapter_published.revision),
            "navigation": wire_json("NavigateResponse", &answer)?,
            "picture": picture,
        }))
    }
}

/// Renders a room along a camera path and encodes every image with the built-in encoder.
fn draw(frame_count: usize, seed: u64) -> anyhow::Result<(Room, Features)> {
    let scene = Scene::new(seed);
    let poses = camera_path(&scene, frame_count, seed);
    let progress = bar(frame_count as u64, "drawing");

    // Every image is encoded as soon as it is rendered and then dropped, so that memory holds
    // features only.
    let rows: Vec<Vec<f32>> = poses
        .par_iter()
        .map(|pose| {
            let feature = encode_builtin(&render(&scene, Camera::small(), pose));
            progress.inc(1);
            feature
        })
        .collect();

    progress.finish_and_clear();
    let rows = Array2::from_shape_vec((frame_count, BUILTIN_DIM), rows.concat())?;
    let features = Features::new(builtin_source(FEATURES), rows)?;

    let provenance = Provenance {
        format: "studio".to_owned(),
        ..Provenance::default()
    };

    let room = Room::new(
        RoomId::new(ROOM)?,
        Frames {
            poses,
            ..Frames::default()
        },
        provenance,
    )?;

    Ok((room, features))
}

fn score(room: &Arc<Room>, features: &Features, adapter: Adapter) -> anyhow::Result<String> {
    let navigator = Navigator::new(room.clone(), features, Arc::new(adapter), IndexKind::Exact)?;

    // A refit fitted on the test pairs would top the table without measuring navigation.
    let leaks = |kind: &NavigatorKind| matches!(kind, NavigatorKind::Step(StepKind::Refit(refit), _) if refit.in_sample);
    let navigators = NavigatorKind::table(navigator.adapter())
        .into_iter()
        .filter(|kind| !leaks(kind))
        .collect();
    let protocol = Protocol {
        navigators,
        ..Protocol::paper(STRIDE)
    };

    let report = evaluate(
        &navigator,
        &protocol,
        &Cancellation::default(),
        &mut |_, _| (),
    )?;

    Ok(evaluation_table(&report))
}

/// Starts a server on a free loopback port, sends it one navigation, draws the answer to `picture`,
/// stops the server, and returns the answer.
async fn serve_and_ask(
    store: &Store,
    room: &Arc<Room>,
    adapter: &str,
    picture: &Path,
) -> anyhow::Result<pb::NavigateResponse> {
    let listener = TcpListener::bind("127.0.0.1:0")
        .await
        .context("cannot listen on a loopback port")?;
    let address = listener.local_addr()?.to_string();

    // The server runs in this process, with the code of `seese3 serve`, until `stop` is sent or
    // dropped.
    let (stop, stopped) = tokio::sync::oneshot::channel::<()>();
    let mut server = tokio::spawn(seese3_server::run(
        listener,
        store.clone(),
        seese3_server::Config::default(),
        async {
            // An error means that the demo failed and dropped the sender. The server stops in
            // either case.
            let _ = stopped.await;
        },
    ));

    say(format_args!("   listening on {address}"));

    let answer = tokio::select! {
        // If the server ends first, its error explains why there is no answer.
        ended = &mut server => {
            ended??;
            anyhow::bail!("the server ended before it answered");
        }
        answer = ask(&address, adapter, room.frame_count()) => answer?,
    };

    say_navigation(&answer);
    write_file(picture, &Figure::from(&plot_of(room, &answer)?).svg()?)?;

    say(format_args!(
        "   the path from above: {}",
        picture.display()
    ));

    // Sending fails only if the server has already ended; then the next line returns its error.
    let _ = stop.send(());
    server.await??;
    say("   server stopped");

    Ok(answer)
}

/// Says so if the adapter predicts held-out motions worse than their own mean does.
fn warn_if_too_short(record: &TrainingRecord, frames: usize) {
    let r2 = record.test.overall;
    if r2 < 0.0 && frames < DEFAULT_FRAMES {
        say(format_args!(
            "   {frames} images are too few to learn motions from (R² {r2:.2} on held-out frames; \
             their mean motion has 0); use --frames {DEFAULT_FRAMES} or more"
        ));
    }
}

/// Start frame of the example: five sixths into the held-out frames that have a successor STRIDE
/// frames later.
fn example_source(frame_count: usize) -> u32 {
    let held_out = Split::Time
        .candidates(&Timeline::unbroken(frame_count))
        .len() as u32;

    let frame_count = frame_count as u32;
    frame_count - held_out + (held_out - STRIDE) * 5 / 6
}

/// Every file under a folder, recursively, in sorted order.
fn files_under(folder: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).with_context(|| folder.display().to_string())? {
        let entry = entry?;
        if entry.file_type()?.is_dir() {
            files.extend(files_under(&entry.path())?);
        } else {
            files.push(entry.path());
        }
    }

    files.sort();
    Ok(files)
}

/// Asks the server for a closed loop of STEPS steps, from the example frame to the frame STRIDE
/// later. Retries while the server is still loading its store.
async fn ask(
    address: &str,
    adapter: &str,
    frame_count: usize,
) -> anyhow::Result<pb::NavigateResponse> {
    let client = Client::connect(address, Duration::from_secs(30)).await?;
    let source = example_source(frame_count);

    // The goal is a frame of the room, so that the server has its pose for the closed loop.
    let request = pb::NavigateRequest {
        room: ROOM.to_owned(),
        adapter: adapter.to_owned(),
        source: Some(pb::View {
            view: Some(pb::view::View::FrameId(source)),
        }),
        motion: Some(pb::RequestedMotion {
            motion: Some(pb::requested_motion::Motion::TargetFrameId(source + STRIDE)),
        }),
        steps: Some(STEPS),
        step_mode: pb::StepMode::ClosedLoop.into(),
        ..pb::NavigateRequest::default()
    };

    for _ in 0..LOADING_POLLS {
        match client.navigate(request.clone()).await {
            // The port accepts connections before the store is loaded; until then every call is
            // UNAVAILABLE.
            Err(error) if error.code() == Some(tonic::Code::Unavailable) => {
                tokio::time::sleep(Duration::from_millis(50)).await;
            }
            answer => return Ok(answer?),
        }
    }

    anyhow::bail!("the server did not finish loading its store")
}

fn plot_of(room: &Room, answer: &pb::NavigateResponse) -> anyhow::Result<PathPlot> {
    // The plot is a top view: position x and y in meters, and the heading of the optical axis in
    // that plane, radians.
    let place = |pose: &seese3_core::geometry::Pose| {
        let at = pose.translation.vector;
        let view = pose.rotation * nalgebra::Vector3::z();
        [at.x, at.y, view.y.atan2(view.x)]
    };
    let wire_place = |pose: Option<&pb::Pose>| -> anyhow::Result<[f64; 3]> {
        let pose = convert::pose(pose.context("the server sent no pose")?)?;
        Ok(place(&pose))
    };

    let source = example_source(room.frame_count()) as usize;
    Ok(PathPlot {
        title: format!("{STEPS} steps, closed loop, {STRIDE} frames ahead"),
        map: room
            .poses()
            .iter()
            .map(|pose| [pose.translation.x, pose.translation.y])
            .collect(),
        source: place(&room.poses()[source]),
        target: place(&room.poses()[source + STRIDE as usize]),
        requested: answer
            .steps
            .iter()
            .map(|step| wire_place(step.requested_pose.as_ref()))
            .collect::<Result<_, _>>()?,
        retrieved: answer
            .steps
            .iter()
            .map(|step| wire_place(step.frames.first().and_then(|hit| hit.pose.as_ref())))
            .collect::<Result<_, _>>()?,
    })
}

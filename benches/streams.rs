//! How many cameras one machine follows: streams of 768-column features at a camera's rate over
//! loopback, beside a server that answers the same messages without looking at them.
//!
//! `cargo bench --bench streams -- [STREAMS] [HZ] [SECONDS]`; 1,000 at 10 Hz for 20 s if nothing is
//! said. Clients and server share the machine.
#![allow(
    missing_docs,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::too_many_lines,
    reason = "a failed step is a failed run here, and a case may be long"
)]

use std::sync::Arc;
use std::time::{Duration, Instant};

use ndarray::Array2;
use rand::{RngExt, SeedableRng};
use seese3_client::Client;
use seese3_client::proto::v1 as pb;
use seese3_client::proto::v1::odometry_service_server::{OdometryService, OdometryServiceServer};
use seese3_client::proto::v1::track_request::Message;
use seese3_client::proto::v1::track_response::Answer;
use seese3_core::adapter::{Adapter, Preset};
use seese3_core::features::{FeatureSource, Features};
use seese3_core::geometry::{Pose, Twist, exp};
use seese3_core::room::{Frames, Provenance, Room, RoomId};
use seese3_core::splits::Split;
use seese3_core::training::{RoomData, TrainingPlan, train_adapter};
use seese3_robot::calibration::calibrate;
use seese3_server::{Config, run};
use seese3_store::Store;
use tokio::net::TcpListener;
use tokio_stream::{Stream, StreamExt, wrappers::ReceiverStream};

const COLUMNS: usize = 768;
const FRAMES: usize = 400;
/// Streams of one connection.
const SHARED: usize = 50;

/// A camera on a wavy path, and smooth features of where it is.
fn room(name: &str, seed: u64) -> (Room, Features) {
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    let mut pose = Pose::identity();
    let phases: Vec<f64> = (0..6).map(|_| random.random_range(0.0..6.0)).collect();
    let wave = |t: f64, axis: usize| 0.02 * (t / (9.0 + 3.0 * axis as f64) + phases[axis]).sin();

    let poses: Vec<Pose> = (0..FRAMES)
        .map(|t| {
            let twist =
                |from: usize| nalgebra::Vector3::from_fn(|axis, _| wave(t as f64, from + axis));
            pose *= exp(&Twist {
                linear: twist(0),
                angular: twist(3),
            });

            pose
        })
        .collect();

    let weights = Array2::from_shape_simple_fn((COLUMNS, 13), || random.random_range(-1.0..1.0));
    let features = Array2::from_shape_fn((FRAMES, COLUMNS), |(row, column)| {
        let numbers = poses[row].to_homogeneous();
        let sum: f64 = (0..12)
            .map(|i| weights[(column, i)] * numbers[(i / 4, i % 4)])
            .sum();

        ((sum + weights[(column, 12)]).sin() + 0.01 * random.random_range(-1.0..1.0)) as f32
    });

    let frames = Frames {
        poses,
        ..Frames::default()
    };
    let room = Room::new(RoomId::new(name).unwrap(), frames, Provenance::default()).unwrap();

    (
        room,
        Features::new(FeatureSource::imported("bench", COLUMNS), features).unwrap(),
    )
}

fn adapter(rooms: &[(Room, Features)]) -> (Adapter, seese3_core::adapter::TrainingRecord) {
    let room_data: Vec<RoomData<'_>> = rooms
        .iter()
        .map(|(room, features)| RoomData {
            room,
            revision: 1,
            features,
        })
        .collect();

    let plan = TrainingPlan::of(Preset::PaperBase, Split::Whole, 20, 0);
    let (adapter, record) = train_adapter(&room_data[..1], &plan, &mut |_| ()).unwrap();
    let calibrated = calibrate(adapter, record, &room_data[1..]).unwrap();
    assert!(
        calibrated.can_track,
        "the streams need an adapter that tracks"
    );

    (calibrated.adapter, calibrated.record)
}

/// Answers every message with as many bytes as a tracker's answer has.
struct Echo;

#[tonic::async_trait]
impl OdometryService for Echo {
    type TrackStream =
        std::pin::Pin<Box<dyn Stream<Item = Result<pb::TrackResponse, tonic::Status>> + Send>>;

    async fn estimate_motion(
        &self,
        _: tonic::Request<pb::EstimateMotionRequest>,
    ) -> Result<tonic::Response<pb::EstimateMotionResponse>, tonic::Status> {
        Err(tonic::Status::unimplemented("an echo"))
    }

    async fn encode(
        &self,
        _: tonic::Request<pb::EncodeRequest>,
    ) -> Result<tonic::Response<pb::EncodeResponse>, tonic::Status> {
        Err(tonic::Status::unimplemented("an echo"))
    }

    async fn track(
        &self,
        request: tonic::Request<tonic::Streaming<pb::TrackRequest>>,
    ) -> Result<tonic::Response<Self::TrackStream>, tonic::Status> {
        let answers = request.into_inner().map(|message| {
            let sequence = match message?.message {
                Some(Message::Frame(frame)) => frame.sequence,
                _ => 0,
            };
            let update = pb::TrackUpdate {
                sequence,
                ..pb::TrackUpdate::default()
            };

            Ok(pb::TrackResponse {
                answer: Some(Answer::Update(update)),
                resume_token: vec![0; 3_000],
            })
        });

        Ok(tonic::Response::new(Box::pin(answers)))
    }
}

/// What was held.
struct Held {
    answered: usize,
    asked: usize,
    seconds: f64,
    latencies_ms: Vec<f64>,
}

impl Held {
    fn line(&self, what: &str) -> String {
        let at =
            |share: f64| self.latencies_ms[((self.latencies_ms.len() - 1) as f64 * share) as usize];

        format!(
            "{what}: {:.0} answers a second of {:.0} asked; p50 {:.2} ms, p95 {:.2} ms, p99 {:.2} ms, largest {:.1} ms",
            self.answered as f64 / self.seconds,
            self.asked as f64 / self.seconds,
            at(0.5),
            at(0.95),
            at(0.99),
            at(1.0)
        )
    }
}

/// Follows `streams` cameras at `hz` for `seconds`; a frame's time runs from when it is due.
async fn load(
    address: &str,
    features: &Arc<Features>,
    streams: usize,
    hz: f64,
    seconds: f64,
) -> Held {
    let period = Duration::from_secs_f64(1.0 / hz);
    let count = (hz * seconds) as usize;
    let mut clients = Vec::new();
    for _ in 0..streams.div_ceil(SHARED) {
        clients.push(
            Client::connect(address, Duration::from_secs(60))
                .await
                .unwrap(),
        );
    }

    let begin = Instant::now() + Duration::from_secs(2);
    let mut tasks = Vec::new();
    for stream in 0..streams {
        let client = clients[stream / SHARED].clone();
        let features = features.clone();

        // Cameras are not in step.
        let first = begin + period.mul_f64(stream as f64 / streams as f64);
        tasks.push(tokio::spawn(async move {
            let (sender, requests) = tokio::sync::mpsc::channel(4);

            let config = pb::TrackConfig {
                room: "map".to_owned(),
                ..pb::TrackConfig::default()
            };

            sender
                .send(pb::TrackRequest {
                    message: Some(Message::Config(config)),
                })
                .await
                .unwrap();

            tokio::spawn(async move {
                for number in 0..count {
                    tokio::time::sleep_until((first + period * number as u32).into()).await;
                    let row = (stream * 7 + number) % FRAMES;
                    let feature = pb::Feature {
                        values: features.rows().row(row).to_vec(),
                        source_name: String::new(),
                    };
                    let view = Some(pb::View {
                        view: Some(pb::view::View::Feature(feature)),
                    });

                    let timestamp_ns = (number as i64 + 1) * 100_000_000;
                    let sequence = number as u64 + 1;
                    let frame = pb::TrackFrame {
                        timestamp_ns,
                        sequence,
                        view,
                        ..pb::TrackFrame::default()
                    };

                    if sender
                        .send(pb::TrackRequest {
                            message: Some(Message::Frame(frame)),
                        })
                        .await
                        .is_err()
                    {
                        return;
                    }
                }
            });

            let mut answers = client.track(ReceiverStream::new(requests)).await.unwrap();
            let mut latencies = Vec::with_capacity(count);
            while let Some(answer) = answers.message().await.unwrap() {
                if let Some(Answer::Update(update)) = answer.answer
                    && update.sequence > 0
                {
                    let due = first + period * (update.sequence as u32 - 1);
                    latencies.push(due.elapsed().as_secs_f64() * 1e3);
                }
            }

            latencies
        }));
    }

    let mut latencies_ms = Vec::new();
    for task in tasks {
        latencies_ms.extend(task.await.unwrap());
    }

    let elapsed = begin.elapsed().as_secs_f64();
    latencies_ms.sort_by(f64::total_cmp);

    Held {
        answered: latencies_ms.len(),
        asked: streams * count,
        seconds: elapsed,
        latencies_ms,
    }
}

#[tokio::main]
async fn main() {
    let given: Vec<f64> = std::env::args()
        .skip(1)
        .filter_map(|word| word.parse().ok())
        .collect();
    let [streams, hz, seconds] =
        [(0, 1_000.0), (1, 10.0), (2, 20.0)].map(|(at, plain)| *given.get(at).unwrap_or(&plain));

    let rooms: Vec<(Room, Features)> = [("map", 1), ("second", 2), ("third", 3)]
        .map(|(name, seed)| room(name, seed))
        .into();
    let (adapter, record) = adapter(&rooms);

    let folder = tempfile::tempdir().unwrap();
    let store = Store::create(folder.path().to_str().unwrap()).unwrap();
    store
        .publish_room(&rooms[0].0, std::slice::from_ref(&rooms[0].1))
        .await
        .unwrap();

    store
        .publish_adapter("bench", &adapter, &record, rooms[0].1.rows())
        .await
        .unwrap();

    let features = Arc::new(rooms[0].1.clone());
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap().to_string();

    tokio::spawn(run(
        listener,
        store,
        Config::default(),
        std::future::pending(),
    ));

    let ready = Client::connect(&address, Duration::from_secs(20))
        .await
        .unwrap();
    while ready.rooms().await.is_err() {
        tokio::time::sleep(Duration::from_millis(20)).await;
    }

    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let echo = listener.local_addr().unwrap().to_string();
    let incoming = tonic::transport::server::TcpIncoming::from(listener).with_nodelay(Some(true));
    let service = OdometryServiceServer::new(Echo);
    tokio::spawn(
        tonic::transport::Server::builder()
            .add_service(service)
            .serve_with_incoming(incoming),
    );

    println!(
        "{streams} streams at {hz} Hz for {seconds} s, {COLUMNS} columns, room of {FRAMES} frames"
    );

    let peer = load(&echo, &features, streams as usize, hz, seconds).await;
    println!("{}", peer.line("echo "));
    let ours = load(&address, &features, streams as usize, hz, seconds).await;
    println!("{}", ours.line("track"));
}

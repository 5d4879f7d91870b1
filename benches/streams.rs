//! How many cameras one machine follows over loopback. Clients and server share the machine.
//!
//! - `cargo bench --bench streams -- [STREAMS] [HZ] [SECONDS]`: streams of 768-column features,
//!   1,000 at 10 Hz for 20 s by default, beside a server that answers the same messages without
//!   processing them.
//! - `cargo bench --features full --bench streams -- [STREAMS] [HZ] [SECONDS] --images STORE ROOM
//!   FOLDER MODEL`: streams of the images in FOLDER, 8 at 10 Hz for 20 s by default, in a room with
//!   keypoints of the encoder MODEL; beside the encoder alone, on one image and on eight at a time.
//!   onnxruntime if ORT_DYLIB_PATH names its library.
#![allow(
    missing_docs,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::too_many_lines,
    reason = "a failed step is a failed run here, and a case may be long"
)]

use std::sync::Arc;
use std::time::{Duration, Instant};

use seese3_client::Client;
use seese3_client::proto::v1 as pb;
use seese3_client::proto::v1::odometry_service_server::{OdometryService, OdometryServiceServer};
use seese3_client::proto::v1::track_request::Message;
use seese3_client::proto::v1::track_response::Answer;
use seese3_core::features::Features;
use seese3_core::room::Room;
use seese3_encoder::{Bounds, Device, Encoder, Runtime, RuntimeKind, decode};
use seese3_server::{Config, ImageEncoders, run};
use seese3_store::Store;
use seese3_testing::wave_room::{COLUMNS, calibrated, wave_room};
use tokio::net::TcpListener;
use tokio_stream::{Stream, StreamExt, wrappers::ReceiverStream};

const FRAMES: usize = 400;
/// Streams of one connection.
const SHARED: usize = 50;

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
            let sequence_number = match message?.message {
                Some(Message::Frame(frame)) => frame.sequence_number,
                _ => 0,
            };
            let update = pb::TrackUpdate {
                sequence_number,
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

/// The view of a frame, by stream and number.
type Views = Arc<dyn Fn(usize, usize) -> pb::view::View + Send + Sync>;

/// Follows `streams` cameras at `hz` for `seconds`; a frame's time runs from when it is due.
async fn load(
    address: &str,
    config: &pb::TrackConfig,
    views: &Views,
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
        let (config, views) = (config.clone(), views.clone());

        // Cameras are not in step.
        let first = begin + period.mul_f64(stream as f64 / streams as f64);
        tasks.push(tokio::spawn(async move {
            let (sender, requests) = tokio::sync::mpsc::channel(4);

            sender
                .send(pb::TrackRequest {
                    message: Some(Message::Config(config)),
                })
                .await
                .unwrap();

            tokio::spawn(async move {
                for number in 0..count {
                    tokio::time::sleep_until((first + period * number as u32).into()).await;
                    let view = Some(pb::View {
                        view: Some(views(stream, number)),
                    });

                    let timestamp_ns = ((number as f64 + 1.0) / hz * 1e9) as i64;
                    let sequence_number = number as u64 + 1;
                    let frame = pb::TrackFrame {
                        timestamp_ns,
                        sequence_number,
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
                    && update.sequence_number > 0
                {
                    let due = first + period * (update.sequence_number as u32 - 1);
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

/// CPU time of this process, seconds.
fn cpu_s() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap();
    let numbers = stat.rsplit(") ").next().unwrap().split(' ');
    let ticks: f64 = numbers
        .skip(11)
        .take(2)
        .map(|n| n.parse::<f64>().unwrap())
        .sum();
    // Linux counts 100 ticks a second.
    ticks / 100.0
}

/// Starts a server of a store, and waits until it answers.
async fn serve(store: Store, config: Config) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap().to_string();
    tokio::spawn(run(listener, store, config, std::future::pending()));

    let ready = Client::connect(&address, Duration::from_secs(60))
        .await
        .unwrap();
    while ready.rooms().await.is_err() {
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    address
}

/// Streams of images, beside the encoder alone.
async fn images([streams, hz, seconds]: [f64; 3], [store, room, folder, model]: [&str; 4]) {
    let mut files: Vec<_> = std::fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| {
            path.extension()
                .is_some_and(|ext| ext == "jpg" || ext == "png")
        })
        .collect();
    files.sort();
    let files: Vec<Vec<u8>> = files
        .iter()
        .map(|file| std::fs::read(file).unwrap())
        .collect();

    let library = std::env::var_os("ORT_DYLIB_PATH").map(std::path::PathBuf::from);
    let kind = match library {
        Some(_) => RuntimeKind::OnnxRuntime,
        None => RuntimeKind::Tract,
    };
    let runtime = Runtime {
        kind,
        threads: 1,
        library,
        device: Device::Cpu,
    };
    let encoders = ImageEncoders {
        models: vec![model.to_owned()],
        runtime: runtime.clone(),
        bounds: Bounds::LOCAL,
        request_pixels: ImageEncoders::REQUEST_PIXELS,
    };

    let store = Store::open(store).unwrap();
    let stored = store.load_room(room, None).await.unwrap();
    let source = &stored
        .keypoints
        .as_ref()
        .expect("a room with keypoints")
        .source;
    let encoder = Encoder::of_keypoints(source, &encoders.models, &runtime)
        .unwrap()
        .expect("the encoder of the room's keypoints");
    let some = &files[..files.len().min(200)];
    for batch in [1, 8] {
        let mut latencies_ms = Vec::new();
        let begin = cpu_s();
        for files in some.chunks_exact(batch) {
            let began = Instant::now();
            let prepared: Vec<_> = files
                .iter()
                .map(|file| decode("image", file, Bounds::LOCAL).unwrap())
                .map(|image| encoder.prepare(image).unwrap())
                .collect();
            let clips: Vec<_> = prepared.iter().map(|image| vec![image]).collect();
            encoder.encode_frames(&clips).unwrap();
            latencies_ms.push(began.elapsed().as_secs_f64() * 1e3);
        }
        latencies_ms.sort_by(f64::total_cmp);
        let count = latencies_ms.len();
        println!(
            "encoder alone, {batch} at a time: {:.1} ms of CPU an image; p50 {:.2} ms, p99 {:.2} ms a batch",
            (cpu_s() - begin) * 1e3 / (count * batch) as f64,
            latencies_ms[count / 2],
            latencies_ms[(count - 1) * 99 / 100],
        );
    }

    let config = Config {
        encoders: Some(encoders),
        ..Config::default()
    };
    let address = serve(store, config).await;
    let config = pb::TrackConfig {
        room: room.to_owned(),
        camera: Some(pb::ViewCamera {
            camera: Some(pb::view_camera::Camera::MappingCamera(pb::MappingCamera {})),
        }),
        token_every: Some(1000),
        ..pb::TrackConfig::default()
    };
    let files = Arc::new(files);
    // Each stream begins elsewhere, and turns back at the ends.
    let views: Views = Arc::new(move |stream, number| {
        let period = 2 * files.len() - 2;
        let at = (stream * 40 + number) % period;
        pb::view::View::Image(files[at.min(period - at)].clone())
    });
    // The first load is not counted: the room is loaded, and caches are warm.
    load(&address, &config, &views, 1, 10.0, 3.0).await;
    for (streams, hz) in [(1.0, hz), (streams, hz)] {
        let begin = cpu_s();
        let held = load(&address, &config, &views, streams as usize, hz, seconds).await;
        let cpu_ms = (cpu_s() - begin) * 1e3 / held.answered as f64;
        println!(
            "{} ({cpu_ms:.1} ms of CPU an image, with its client)",
            held.line(&format!("{streams} streams at {hz} Hz"))
        );
    }
}

#[tokio::main]
async fn main() {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let given: Vec<f64> = words.iter().map_while(|word| word.parse().ok()).collect();
    let of = |usual: f64| {
        let usual = [usual, 10.0, 20.0];
        [0, 1, 2].map(|at| *given.get(at).unwrap_or(&usual[at]))
    };
    let paths: Vec<&str> = words
        .iter()
        .skip_while(|word| *word != "--images")
        .skip(1)
        .take(4)
        .map(String::as_str)
        .collect();
    match paths[..] {
        [store, room, folder, model] => images(of(8.0), [store, room, folder, model]).await,
        _ => features(of(1_000.0)).await,
    }
}

/// Streams of features, beside a server that only answers.
async fn features([streams, hz, seconds]: [f64; 3]) {
    let rooms: Vec<(Room, Features)> = [("map", 1), ("second", 2), ("third", 3)]
        .map(|(name, seed)| wave_room(name, seed, FRAMES))
        .into();
    let (adapter, record) = calibrated(&rooms);

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

    let address = serve(store, Config::default()).await;
    let features = rooms[0].1.clone();
    let views: Views = Arc::new(move |stream, number| {
        let row = (stream * 7 + number) % FRAMES;
        pb::view::View::Feature(pb::Feature {
            values: features.rows().row(row).to_vec(),
            feature_set: String::new(),
        })
    });
    let config = pb::TrackConfig {
        room: "map".to_owned(),
        ..pb::TrackConfig::default()
    };

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

    let peer = load(&echo, &config, &views, streams as usize, hz, seconds).await;
    println!("{}", peer.line("echo "));
    let ours = load(&address, &config, &views, streams as usize, hz, seconds).await;
    println!("{}", ours.line("track"));
}

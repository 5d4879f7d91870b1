//! Cases whose instructions are counted by `.ci/instructions`.
//!
//! - `instructions make FOLDER` makes a store of a room with a calibrated adapter.
//! - `instructions CASE COUNT FOLDER` runs a case COUNT times. The difference between two counts leaves out the
//!   start.
#![allow(
    missing_docs,
    clippy::unwrap_used,
    clippy::expect_used,
    reason = "a failed step is a failed run here"
)]

use std::hint::black_box;
use std::sync::Arc;
use std::time::Duration;

use seese3_client::Client;
use seese3_client::proto::v1 as pb;
use seese3_client::proto::v1::track_request::Message;
use seese3_core::adapter::{Mixture, Samples, TrainConfig, Trainer, Widths};
use seese3_core::features::Features;
use seese3_core::index::{ExactIndex, Index};
use seese3_core::navigation::{IndexKind, Navigator};
use seese3_core::room::{FrameId, Room};
use seese3_robot::tracking::Map;
use seese3_server::Config;
use seese3_store::{Store, StoredAdapter};
use seese3_testing::wave_room::{COLUMNS, calibrated, wave_room};
use tokio::net::TcpListener;

const FRAMES: usize = 1_000;
/// Frames of the rooms in which the adapter is calibrated.
const OTHER_FRAMES: usize = 400;
/// Pairs of a batch of training.
const PAIRS: usize = 512;

fn main() {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    // One worker, so that the order of the work varies little.
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .unwrap();
    match words[..] {
        ["make", folder] => runtime.block_on(make(folder)),
        [case, count, folder] => {
            let count = count.parse().expect("a count");
            runtime.block_on(run(case, count, folder));
        }
        // `cargo bench` runs every benchmark; this one needs a folder.
        _ => println!("see .ci/instructions"),
    }
}

async fn make(folder: &str) {
    let rooms: Vec<(Room, Features)> = [("bench", 1), ("second", 2), ("third", 3)]
        .map(|(name, seed)| {
            let frames = if seed == 1 { FRAMES } else { OTHER_FRAMES };
            wave_room(name, seed, frames)
        })
        .into();
    let (adapter, record) = calibrated(&rooms);

    let store = Store::create(folder).unwrap();
    let (room, features) = &rooms[0];
    let sets = std::slice::from_ref(features);
    store.publish_room(room, sets).await.unwrap();
    store
        .publish_adapter("bench", &adapter, &record, features.rows())
        .await
        .unwrap();

    // The first server keeps what it derives, so that all later ones start alike.
    Made::load(folder).await.client().await;
}

/// The room and the adapter of the store.
struct Made {
    store: Store,
    room: Arc<Room>,
    features: Features,
    adapter: StoredAdapter,
}

impl Made {
    async fn load(folder: &str) -> Self {
        let store = Store::open(folder).unwrap();
        let stored = store.load_room("bench", None).await.unwrap();
        let adapter = store.load_adapter("bench", None).await.unwrap();
        Self {
            store,
            room: Arc::new(stored.room),
            features: stored.features.into_iter().next().unwrap(),
            adapter,
        }
    }

    fn frames(&self) -> Vec<FrameId> {
        (0..self.room.frame_count() as u32).map(FrameId).collect()
    }

    fn navigator(&self) -> Navigator {
        let adapter = self.adapter.adapter.clone();
        Navigator::new(self.room.clone(), &self.features, adapter, IndexKind::Exact).unwrap()
    }

    /// The view of a frame, as a feature.
    fn view(&self, number: usize) -> Option<pb::View> {
        let row = self.features.rows();
        let values = row.row(number * 7 % FRAMES).to_vec();
        Some(pb::View {
            view: Some(pb::view::View::Feature(pb::Feature {
                values,
                feature_set: String::new(),
            })),
        })
    }

    /// A motion in four steps from a view.
    fn navigation(&self, number: usize) -> pb::NavigateRequest {
        let vector = |x, y, z| Some(pb::Vector3 { x, y, z });
        let motion = pb::requested_motion::Motion::Twist(pb::Twist {
            linear: vector(0.2, 0.0, 0.4),
            angular: vector(0.0, 0.2, 0.0),
        });
        pb::NavigateRequest {
            room: "bench".to_owned(),
            source: self.view(number),
            motion: Some(pb::RequestedMotion {
                motion: Some(motion),
            }),
            steps: Some(4),
            ..pb::NavigateRequest::default()
        }
    }

    /// A client of a server of the store.
    async fn client(&self) -> Client {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap().to_string();
        let config = Config {
            threads: 1,
            ..Config::default()
        };
        let store = self.store.clone();
        tokio::spawn(seese3_server::run(
            listener,
            store,
            config,
            std::future::pending(),
        ));
        let client = Client::connect(&address, Duration::from_mins(10)).await;
        let client = client.unwrap();
        while client.rooms().await.is_err() {
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
        client
    }
}

async fn run(case: &str, count: usize, folder: &str) {
    let made = Made::load(folder).await;
    match case {
        "nearest" => nearest(&made, count),
        "map" => map(&made, count),
        "train" => train(&made, count),
        "navigate" => {
            let client = made.client().await;
            for number in 0..count {
                client.navigate(made.navigation(number)).await.unwrap();
            }
        }
        "batch-navigate" => {
            let client = made.client().await;
            for _ in 0..count {
                let requests = (0..64).map(|number| made.navigation(number)).collect();
                client.batch_navigate(requests).await.unwrap();
            }
        }
        "track" => track(&made, count).await,
        other => panic!("no case '{other}'"),
    }
}

/// The ten nearest of each latent.
fn nearest(made: &Made, count: usize) {
    let navigator = made.navigator();
    let index = ExactIndex::new(navigator.latents(), &made.frames());
    for number in 0..count {
        let query = navigator.latents().row(number % FRAMES).to_vec();
        black_box(index.nearest(&query, 10, None));
    }
}

/// What a server derives from a room.
fn map(made: &Made, count: usize) {
    let frames = made.frames();
    for _ in 0..count {
        let map = Map::new(Arc::new(made.navigator()), &frames).unwrap();
        black_box(map.with_features(made.features.rows(), &frames));
    }
}

/// Batches of training.
fn train(made: &Made, count: usize) {
    let pairs: Vec<[usize; 2]> = (0..PAIRS).map(|at| [at, at + 10 + at % 31]).collect();
    let poses = made.room.poses().to_vec();
    let samples = Samples::<f32>::new(made.features.rows(), poses, pairs).unwrap();
    let widths = Widths {
        feature: COLUMNS,
        hidden: 64,
        latent: 20,
    };
    let network = Mixture::initial(widths, 1, 0);
    let mut trainer = Trainer::new(&samples, network, TrainConfig::default());
    let batch: Vec<usize> = (0..PAIRS).collect();
    for _ in 0..count {
        black_box(trainer.step(&batch).loss);
    }
}

/// Frames of a stream.
async fn track(made: &Made, count: usize) {
    let client = made.client().await;
    let (sender, requests) = tokio::sync::mpsc::channel(1);
    let send = async |message| {
        let message = Some(message);
        sender.send(pb::TrackRequest { message }).await.unwrap();
    };
    let config = pb::TrackConfig {
        room: "bench".to_owned(),
        ..pb::TrackConfig::default()
    };
    send(Message::Config(config)).await;
    let requests = tokio_stream::wrappers::ReceiverStream::new(requests);
    let mut answers = client.track(requests).await.unwrap();
    answers.message().await.unwrap().expect("the first answer");

    for number in 0..count {
        let frame = pb::TrackFrame {
            timestamp_ns: 100_000_000 * (number as i64 + 1),
            sequence_number: number as u64 + 1,
            view: made.view(number),
            ..pb::TrackFrame::default()
        };
        send(Message::Frame(frame)).await;
        answers.message().await.unwrap().expect("an answer");
    }
}

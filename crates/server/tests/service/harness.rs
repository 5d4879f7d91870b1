//! A server with the oracle's room and adapter.

use std::time::Duration;

use ndarray::Array2;
use seese3_client::Client;
use seese3_client::proto::v1 as pb;
use seese3_core::adapter::{
    Adapter, PairPlan, Samples, Siamese, TENSOR_NAMES, TrainConfig, TrainingRecord,
};
use seese3_core::features::{FeatureSource, Features};
use seese3_core::motion_scores::MotionScores;
use seese3_core::room::{Frames, Provenance, Room, RoomId, Timeline};
use seese3_core::splits::Split;
use seese3_server::{Config, RunError, run};
use seese3_store::Store;
use tokio::net::TcpListener;
use tokio::sync::oneshot;
use tokio::task::JoinHandle;

use seese3_testing::{Tensors, features, golden, poses};

/// A running server; its store is removed with it.
pub struct TestServer {
    pub address: String,
    pub client: Client,
    pub stop: oneshot::Sender<()>,
    pub ended: JoinHandle<Result<(), RunError>>,
    pub folder: tempfile::TempDir,
}

pub fn room_of(name: &str, golden_room: &str) -> Room {
    let frames = Frames {
        poses: poses(&golden().join(format!("rooms/{golden_room}/poses.npy"))),
        ..Frames::default()
    };
    Room::new(RoomId::new(name).unwrap(), frames, Provenance::default()).unwrap()
}

pub fn features_of(golden_room: &str) -> Features {
    Features::new(
        FeatureSource::imported("oracle", 0),
        features(&golden(), golden_room),
    )
    .unwrap()
}

/// The oracle's adapter with the scale of its training pairs.
pub fn oracle_adapter() -> Adapter {
    let tensors = Tensors::open(&golden().join("m4_adapter/synthetic_k1_trained.safetensors"));
    let network =
        Siamese::from_tensors(TENSOR_NAMES.map(|name| tensors.rows(name).mapv(|x| x as f32)))
            .unwrap();

    let room = room_of("a", "synthetic");
    let pairs = Split::Time
        .train_pairs(&Timeline::unbroken(room.frame_count()), 40)
        .unwrap();
    let rows = pairs
        .iter()
        .map(|p| [p.source.row(), p.target.row()])
        .collect();

    let samples =
        Samples::<f32>::new(features_of("synthetic").rows(), room.poses().to_vec(), rows).unwrap();

    Adapter::new(
        features_of("synthetic").source().clone(),
        network,
        samples.scale().clone(),
    )
    .unwrap()
}

pub fn record() -> TrainingRecord {
    let scores = MotionScores {
        n: 1,
        components: [0.5; 6],
        overall: 0.5,
        translation: 0.5,
        rotation: 0.5,
        direction: f64::NAN,
        magnitude: 0.5,
        direction_pairs_dropped: 0,
    };

    TrainingRecord {
        preset: "paper-base".to_owned(),
        split: Split::Time,
        stride: 40,
        pairs: PairPlan::Stride(40),
        rooms: vec![(RoomId::new("synthetic").unwrap(), 1)],
        calibrated_on: Vec::new(),
        config: TrainConfig::default(),
        pair_count: 440,
        test: scores,
        room_tests: vec![scores],
        train: scores,
        train_mean_r2: -0.1,
    }
}

/// A store with rooms `synthetic` and `synthetic_b` and the adapter `oracle`.
pub async fn filled_store() -> (tempfile::TempDir, Store) {
    let folder = tempfile::tempdir().unwrap();
    let store = Store::create(folder.path().to_str().unwrap()).unwrap();
    for name in ["synthetic", "synthetic_b"] {
        store
            .publish_room(&room_of(name, name), &[features_of(name)])
            .await
            .unwrap();
    }

    store
        .publish_adapter(
            "oracle",
            &oracle_adapter(),
            &record(),
            features_of("synthetic").rows(),
        )
        .await
        .unwrap();

    (folder, store)
}

/// Starts a server on a free port and waits until it serves.
pub async fn start(config: Config) -> TestServer {
    let (folder, store) = filled_store().await;
    start_on(folder, store, config).await
}

/// Starts a server of a store on a free port and waits until it serves.
pub async fn start_on(folder: tempfile::TempDir, store: Store, config: Config) -> TestServer {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap().to_string();
    let (stop, stopped) = oneshot::channel();
    let ended = tokio::spawn(run(listener, store, config, async {
        let _ = stopped.await;
    }));

    let client = Client::connect(&address, Duration::from_secs(20))
        .await
        .unwrap();
    for _ in 0..1_000 {
        if client.rooms().await.is_ok() {
            break;
        }

        assert!(!ended.is_finished(), "the server ended");

        tokio::time::sleep(Duration::from_millis(10)).await;
    }

    TestServer {
        address,
        client,
        stop,
        ended,
        folder,
    }
}

pub fn frame(frame: u32) -> Option<pb::View> {
    Some(pb::View {
        view: Some(pb::view::View::FrameId(frame)),
    })
}

pub fn feature(values: Vec<f32>) -> Option<pb::View> {
    let feature = pb::Feature {
        values,
        source_name: String::new(),
    };
    Some(pb::View {
        view: Some(pb::view::View::Feature(feature)),
    })
}

pub fn latent(values: Vec<f64>) -> Option<pb::View> {
    Some(pb::View {
        view: Some(pb::view::View::Latent(pb::Latent { values })),
    })
}

pub fn feature_row(row: usize) -> Vec<f32> {
    features_of("synthetic").rows().row(row).to_vec()
}

pub fn by_twist(numbers: [f64; 6]) -> Option<pb::Displacement> {
    Some(pb::Displacement {
        displacement: Some(pb::displacement::Displacement::Twist(twist(numbers))),
    })
}

pub fn twist([vx, vy, vz, wx, wy, wz]: [f64; 6]) -> pb::Twist {
    let vector = |x, y, z| Some(pb::Vector3 { x, y, z });
    pb::Twist {
        linear: vector(vx, vy, vz),
        angular: vector(wx, wy, wz),
    }
}

pub fn to_frame(frame: u32) -> Option<pb::Displacement> {
    Some(pb::Displacement {
        displacement: Some(pb::displacement::Displacement::TargetFrameId(frame)),
    })
}

/// From frame 500 to frame 540, one step.
pub fn question() -> pb::NavigateRequest {
    pb::NavigateRequest {
        room: "synthetic".to_owned(),
        source: frame(500),
        displacement: to_frame(540),
        ..pb::NavigateRequest::default()
    }
}

/// A tensor of the navigation oracle.
pub fn oracle(name: &str) -> Array2<f64> {
    Tensors::open(&golden().join("navigation/synthetic_expected.safetensors")).rows(name)
}

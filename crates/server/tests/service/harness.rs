//! A server with the oracle's room and adapter.

use std::fmt::Debug;
use std::sync::mpsc;
use std::time::Duration;

use ndarray::Array2;
use pb::requested_motion::Motion;
use seese3_client::proto::v1 as pb;
use seese3_client::{Client, Error};
use seese3_core::adapter::{
    Adapter, PairPlan, Samples, Siamese, TENSOR_NAMES, TrainConfig, TrainingRecord,
};
use seese3_core::features::{FeatureSource, Features};
use seese3_core::motion_scores::MotionScores;
use seese3_core::room::{Frames, Provenance, Room, RoomId, Timeline};
use seese3_core::splits::Split;
use seese3_server::{Config, Metrics, RunError, run};
use seese3_store::Store;
use tokio::net::TcpListener;
use tokio::sync::oneshot;
use tokio::task::JoinHandle;
use tonic::Code;

use seese3_testing::{Tensors, features, golden, poses};

/// A change that makes a valid message unfit, and the field that the refusal names.
pub type Unfit<M> = (fn(&mut M), &'static str);

/// How long an event may take on a busy machine. A test that passes does not wait for it.
pub const PATIENCE: Duration = Duration::from_secs(60);

/// Waits for an event for at most [`PATIENCE`] of real time, also while tokio's clock is stopped.
pub async fn soon<T>(what: &str, event: impl Future<Output = T>) -> T {
    let (_ended, waits) = mpsc::channel::<()>();
    let patience = tokio::task::spawn_blocking(move || waits.recv_timeout(PATIENCE));

    tokio::select! {
        happened = event => happened,
        _ = patience => panic!("never happened: {what}"),
    }
}

/// Asks until the answer is as wanted.
pub async fn until<T>(
    what: &str,
    mut ask: impl AsyncFnMut() -> T,
    is_wanted: impl Fn(&T) -> bool,
) -> T {
    let waited = async {
        loop {
            let answer = ask().await;
            if is_wanted(&answer) {
                return answer;
            }

            // Spaces out the questions, in real time.
            let pause = || std::thread::sleep(Duration::from_millis(5));
            tokio::task::spawn_blocking(pause).await.unwrap();
        }
    };
    soon(what, waited).await
}

/// Tokio's clock, stopped: time limits end when the test says so, however busy the machine is.
pub struct StoppedClock(#[expect(dead_code, reason = "ends the blocking task")] mpsc::Sender<()>);

impl StoppedClock {
    pub fn new() -> Self {
        // A paused clock jumps to the next timer when every task waits for a socket, but not while
        // a blocking task runs.
        let (running, waits) = mpsc::channel();
        tokio::task::spawn_blocking(move || waits.recv());
        tokio::time::pause();
        Self(running)
    }

    /// Lets some time pass, and a millisecond, because timers end at whole milliseconds.
    pub async fn advance(&self, by: Duration) {
        tokio::time::advance(by + Duration::from_millis(1)).await;
    }
}

/// The value of the metric that begins with `name`, its labels included; `None` if there is none.
pub fn metric(metrics: &Metrics, name: &str) -> Option<f64> {
    let text = metrics.text();
    let mut lines = text.lines();
    let value = lines.find_map(|line| line.strip_prefix(name)?.strip_prefix(' '));
    value.map(|value| value.parse().expect(name))
}

/// A running server; its store is removed with it.
pub struct TestServer {
    pub address: String,
    pub client: Client,
    pub stop: oneshot::Sender<()>,
    pub ended: JoinHandle<Result<(), RunError>>,
    pub folder: tempfile::TempDir,
}

impl TestServer {
    /// The answer to the question with this change.
    pub async fn navigated(
        &self,
        change: impl FnOnce(&mut pb::NavigateRequest),
    ) -> pb::NavigateResponse {
        let mut request = question();
        change(&mut request);
        self.client.navigate(request).await.unwrap()
    }

    /// The answer to a localization with this change.
    pub async fn localized(
        &self,
        change: impl FnOnce(&mut pb::LocalizeRequest),
    ) -> pb::LocalizeResponse {
        let mut request = pb::LocalizeRequest::default();
        change(&mut request);
        self.client.localize(request).await.unwrap()
    }
}

/// A twist's numbers, ordered (v, ω).
pub fn six(twist: &pb::Twist) -> [f64; 6] {
    let (v, w) = (twist.linear.unwrap(), twist.angular.unwrap());
    [v.x, v.y, v.z, w.x, w.y, w.z]
}

/// The code of an answer.
pub fn code_of<T>(answer: Result<T, Error>) -> Code {
    match answer {
        Ok(_) => Code::Ok,
        Err(error) => error.code().unwrap_or_else(|| panic!("{error}")),
    }
}

#[track_caller]
pub fn refused<T: Debug>(what: &str, answer: Result<T, Error>, code: Code, field: &str) {
    let error = answer.expect_err(what);
    assert_eq!(error.code(), Some(code), "{what}: {error}");
    assert_eq!(error.field().unwrap_or_default(), field, "{what}: {error}");
    assert!(!error.to_string().contains('\n'), "{what}: one line");
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
        relational: None,
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

    publish_oracle(&store, "oracle").await;
    (folder, store)
}

/// Publishes the oracle's adapter under this name.
pub async fn publish_oracle(store: &Store, name: &str) {
    let features = features_of("synthetic");
    let (adapter, record) = (oracle_adapter(), record());
    let published = store.publish_adapter(name, &adapter, &record, features.rows());
    published.await.unwrap();
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

    let client = Client::connect(&address, PATIENCE).await.unwrap();
    let serves = async || {
        assert!(!ended.is_finished(), "the server ended");
        client.serves("").await.unwrap_or(false)
    };
    until("the server serves", serves, |serves| *serves).await;

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
        feature_set: String::new(),
    };
    Some(pb::View {
        view: Some(pb::view::View::Feature(feature)),
    })
}

/// A latent of the adapter `oracle`.
pub fn latent(values: Vec<f64>) -> Option<pb::View> {
    latent_of("oracle", values)
}

/// A latent of the first revision of an adapter.
pub fn latent_of(adapter: &str, values: Vec<f64>) -> Option<pb::View> {
    let adapter = pb::Revision {
        name: adapter.to_owned(),
        revision: 1,
    };
    Some(pb::View {
        view: Some(pb::view::View::Latent(pb::Latent {
            values,
            adapter: Some(adapter),
        })),
    })
}

pub fn feature_row(row: usize) -> Vec<f32> {
    features_of("synthetic").rows().row(row).to_vec()
}

/// A camera of these intrinsics.
pub fn of_intrinsics(intrinsics: pb::CameraIntrinsics) -> Option<pb::ViewCamera> {
    Some(pb::ViewCamera {
        camera: Some(pb::view_camera::Camera::Intrinsics(intrinsics)),
    })
}

pub fn displaced(by: Motion) -> Option<pb::RequestedMotion> {
    Some(pb::RequestedMotion { motion: Some(by) })
}

pub fn by_twist(numbers: [f64; 6]) -> Option<pb::RequestedMotion> {
    displaced(Motion::Twist(twist(numbers)))
}

pub fn by_twists(twists: Vec<pb::Twist>) -> Option<pb::RequestedMotion> {
    displaced(Motion::Twists(pb::TwistList { twists }))
}

pub fn to_pose(pose: pb::Pose) -> Option<pb::RequestedMotion> {
    displaced(Motion::TargetPose(pose))
}

pub fn twist([vx, vy, vz, wx, wy, wz]: [f64; 6]) -> pb::Twist {
    let vector = |x, y, z| Some(pb::Vector3 { x, y, z });
    pb::Twist {
        linear: vector(vx, vy, vz),
        angular: vector(wx, wy, wz),
    }
}

pub fn to_frame(frame: u32) -> Option<pb::RequestedMotion> {
    displaced(Motion::TargetFrameId(frame))
}

/// From frame 500 to frame 540, one step.
pub fn question() -> pb::NavigateRequest {
    pb::NavigateRequest {
        room: "synthetic".to_owned(),
        source: frame(500),
        motion: to_frame(540),
        ..pb::NavigateRequest::default()
    }
}

/// A tensor of the navigation oracle.
pub fn oracle(name: &str) -> Array2<f64> {
    Tensors::open(&golden().join("navigation/synthetic_expected.safetensors")).rows(name)
}

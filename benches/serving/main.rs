//! Navigation over loopback beside an empty service, which answers each request with the same stored bytes.
//!
//! - `cargo bench --bench serving -- make FOLDER FRAMES` makes a store with a room and an adapter.
//! - `cargo bench --bench serving -- run FOLDER SECONDS ROUNDS [NAME=ADDRESS]...` serves it, and prints what it
//!   answers per second beside the empty service and beside other services of the same store.
//! - `cargo bench --bench serving -- frames MOST HNSW_MOST`, `widths MOST`, `rooms FOLDER MOST FRAMES` and
//!   `clients FOLDER MOST SECONDS` print how costs grow.
//!
//! Servers and clients run on the same machine, each with its own threads. A number is the median of the rounds,
//! with the least and the largest; in each round the services take turns.
#![allow(
    missing_docs,
    clippy::unwrap_used,
    clippy::expect_used,
    reason = "a failed step is a failed run here"
)]

mod growth;

use std::sync::Arc;
use std::time::{Duration, Instant};

use seese3_client::Client;
use seese3_client::proto::v1 as pb;
use seese3_client::proto::v1::navigation_service_server::{
    NavigationService, NavigationServiceServer,
};
use seese3_core::adapter::Preset;
use seese3_core::features::Features;
use seese3_core::room::Room;
use seese3_core::splits::Split;
use seese3_core::training::{RoomData, TrainingPlan, train_adapter};
use seese3_store::Store;
use seese3_testing::wave_room::{COLUMNS, wave_room};
use tokio::net::TcpListener;
use tokio::runtime::Runtime;
use tokio::task::JoinHandle;
use tonic::{Request, Response, Status};

const STEPS: u32 = 4;
/// Connections of a comparison.
const CONNECTIONS: usize = 4;

/// Answers every request with the same response.
struct Empty {
    one: pb::NavigateResponse,
}

#[tonic::async_trait]
impl NavigationService for Empty {
    async fn navigate(
        &self,
        _: Request<pb::NavigateRequest>,
    ) -> Result<Response<pb::NavigateResponse>, Status> {
        Ok(Response::new(self.one.clone()))
    }

    async fn batch_navigate(
        &self,
        request: Request<pb::BatchNavigateRequest>,
    ) -> Result<Response<pb::BatchNavigateResponse>, Status> {
        let one = pb::BatchNavigateResult {
            result: Some(pb::batch_navigate_result::Result::Response(
                self.one.clone(),
            )),
        };
        let results = vec![one; request.get_ref().requests.len()];
        Ok(Response::new(pb::BatchNavigateResponse { results }))
    }

    async fn plan_route(
        &self,
        _: Request<pb::PlanRouteRequest>,
    ) -> Result<Response<pb::Route>, Status> {
        Err(Status::unimplemented("an empty service"))
    }
}

/// Makes a store with a room and an adapter that was trained in it.
async fn make(folder: &str, frame_count: usize) {
    let (room, features) = wave_room("bench", 1, frame_count);
    let data = [RoomData {
        room: &room,
        revision: 1,
        features: &features,
    }];
    let plan = TrainingPlan::of(Preset::PaperBase, Split::Whole, 20, 0);
    let (adapter, record) = train_adapter(&data, &plan, &mut |_| ()).unwrap();

    let store = Store::create(folder).unwrap();
    published(&store, &room, &features).await;
    let rows = features.rows();
    store
        .publish_adapter("bench", &adapter, &record, rows)
        .await
        .unwrap();
}

async fn published(store: &Store, room: &Room, features: &Features) {
    let sets = std::slice::from_ref(features);
    store.publish_room(room, sets).await.unwrap();
}

/// The address of a server of the store, and its task.
async fn serve(store: Store) -> (String, JoinHandle<()>) {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap().to_string();
    let config = seese3_server::Config::default();
    let serving = seese3_server::run(listener, store, config, std::future::pending());
    let task = tokio::spawn(async { serving.await.unwrap() });
    (address, task)
}

async fn serve_empty(one: pb::NavigateResponse) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap().to_string();
    let incoming = tonic::transport::server::TcpIncoming::from(listener).with_nodelay(Some(true));
    let service = NavigationServiceServer::new(Empty { one });
    let router = tonic::transport::Server::builder().add_service(service);
    tokio::spawn(async { router.serve_with_incoming(incoming).await.unwrap() });
    address
}

/// The requests of a client, in turn.
fn requests(features: &Features) -> Vec<pb::NavigateRequest> {
    let every = features.rows().nrows().div_ceil(64);
    let rows = features.rows();
    let rows = rows.outer_iter().step_by(every);
    rows.map(|row| pb::NavigateRequest {
        room: "bench".to_owned(),
        source: Some(pb::View {
            view: Some(pb::view::View::Feature(pb::Feature {
                values: row.to_vec(),
                feature_set: String::new(),
            })),
        }),
        motion: Some(pb::RequestedMotion {
            motion: Some(pb::requested_motion::Motion::Twists(pb::TwistList {
                twists: vec![pb::Twist {
                    linear: Some(pb::Vector3 {
                        x: 0.2,
                        y: 0.0,
                        z: 0.4,
                    }),
                    angular: Some(pb::Vector3 {
                        x: 0.0,
                        y: 0.2,
                        z: 0.0,
                    }),
                }],
            })),
        }),
        steps: Some(STEPS),
        ..pb::NavigateRequest::default()
    })
    .collect()
}

/// How requests are sent.
#[derive(Clone, Copy)]
struct Load {
    in_flight: usize,
    /// Requests of a BatchNavigate; `None` for Navigate.
    batch: Option<usize>,
    /// Connections that share the requests in flight.
    connections: usize,
}

/// Answers per second and the median time of a call, microseconds.
async fn measured(
    address: &str,
    requests: &Arc<Vec<pb::NavigateRequest>>,
    load: Load,
    time: Duration,
) -> [f64; 2] {
    let connections = load.connections.min(load.in_flight);
    let mut clients = Vec::new();
    for _ in 0..connections {
        clients.push(
            Client::connect(address, Duration::from_secs(10))
                .await
                .unwrap(),
        );
    }

    let began = Instant::now();
    let senders: Vec<_> = (0..load.in_flight)
        .map(|sender| {
            let client = clients[sender % connections].clone();
            let requests = requests.clone();
            tokio::spawn(async move {
                let mut times = Vec::new();
                let next = |at: usize| requests[(sender * 17 + at) % requests.len()].clone();
                while began.elapsed() < time {
                    let sent = Instant::now();
                    match load.batch {
                        None => drop(client.navigate(next(times.len())).await.unwrap()),
                        Some(count) => {
                            let batch = (0..count).map(next).collect();
                            drop(client.batch_navigate(batch).await.unwrap());
                        }
                    }
                    times.push(sent.elapsed().as_secs_f64() * 1e6);
                }
                times
            })
        })
        .collect();

    let mut times = Vec::new();
    for sender in senders {
        times.extend(sender.await.unwrap());
    }
    let elapsed = began.elapsed().as_secs_f64();
    let answers = times.len() * load.batch.unwrap_or(1);
    [answers as f64 / elapsed, median(&mut times)]
}

/// Number of requests that two services answer with the same frames.
async fn same_frames(addresses: [&str; 2], requests: &[pb::NavigateRequest]) -> usize {
    let [mut first, mut second] = [Vec::new(), Vec::new()];
    for (address, found) in addresses.into_iter().zip([&mut first, &mut second]) {
        let client = Client::connect(address, Duration::from_secs(10)).await;
        let client = client.unwrap();
        for request in requests {
            let answer = client.navigate(request.clone()).await.unwrap();
            let frames = answer.steps.iter().flat_map(|step| &step.frames);
            found.push(frames.map(|frame| frame.frame_id).collect::<Vec<u32>>());
        }
    }
    first.iter().zip(&second).filter(|(a, b)| a == b).count()
}

fn median(numbers: &mut [f64]) -> f64 {
    numbers.sort_by(f64::total_cmp);
    numbers[numbers.len() / 2]
}

/// The median, the least and the largest.
fn spread(numbers: &[f64], digits: usize) -> String {
    let mut numbers = numbers.to_vec();
    let median = median(&mut numbers);
    let (least, largest) = (numbers[0], numbers[numbers.len() - 1]);
    format!("{median:.digits$} [{least:.digits$}, {largest:.digits$}]")
}

/// Answers and rates of one service, a number for each round.
#[derive(Default)]
struct Rates {
    per_second: Vec<f64>,
    p50_us: Vec<f64>,
}

fn main() {
    let words: Vec<String> = std::env::args()
        .skip(1)
        .filter(|word| word != "--bench")
        .collect();
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    match words[..] {
        ["make", folder, frames] => {
            let frames = frames.parse().expect("a number of frames");
            Runtime::new().unwrap().block_on(make(folder, frames));
        }
        ["run", folder, seconds, rounds, ref others @ ..] => {
            let time = Duration::from_secs_f64(seconds.parse().expect("seconds"));
            compare(
                folder,
                time,
                rounds.parse().expect("a number of rounds"),
                others,
            );
        }
        ["frames", most, hnsw] => growth::frames(number(most), number(hnsw)),
        ["widths", most] => growth::widths(number(most)),
        ["rooms", folder, most, frames] => growth::rooms(folder, number(most), number(frames)),
        ["clients", folder, most, seconds] => {
            growth::clients(folder, number(most), seconds.parse().expect("seconds"));
        }
        // `cargo bench` runs every benchmark.
        _ => {
            let folder = tempfile::tempdir().unwrap();
            let folder = folder.path().join("store");
            let folder = folder.to_str().unwrap();
            Runtime::new().unwrap().block_on(make(folder, 5_000));
            compare(folder, Duration::from_secs(2), 5, &[]);
        }
    }
}

fn number(word: &str) -> usize {
    word.parse().expect("a number")
}

fn compare(folder: &str, time: Duration, rounds: usize, others: &[&str]) {
    let [served, empty, clients] = [(); 3].map(|()| Runtime::new().unwrap());
    let store = Store::open(folder).unwrap();
    let stored = served.block_on(store.load_room("bench", None)).unwrap();
    let features = &stored.features[0];
    let frame_count = features.rows().nrows();
    let requests = Arc::new(requests(features));

    let (address, _server) = served.block_on(serve(store));
    let one = clients.block_on(async {
        let client = Client::connect(&address, Duration::from_secs(60))
            .await
            .unwrap();
        while client.rooms().await.is_err() {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
        client.navigate(requests[0].clone()).await.unwrap()
    });
    let empty_address = empty.block_on(serve_empty(one));

    let others = others
        .iter()
        .map(|other| other.split_once('=').expect("NAME=ADDRESS"));
    let services: Vec<(&str, &str)> = [
        ("seese3", address.as_str()),
        ("empty service", empty_address.as_str()),
    ]
    .into_iter()
    .chain(others)
    .collect();

    for (name, other) in &services[2..] {
        let same = clients.block_on(same_frames([&address, other], &requests));
        println!(
            "{name} answers {same} of {} requests with the frames of seese3",
            requests.len()
        );
    }
    println!(
        "{frame_count} frames, {COLUMNS} columns, {STEPS} steps, {rounds} rounds of {:.1} s",
        time.as_secs_f64()
    );
    println!("load | service | answers per second | of the empty service | p50 µs");
    let loads = [
        ("64 in flight", 64, None),
        ("1 in flight", 1, None),
        ("batches of 64, 4 in flight", 4, Some(64)),
    ];
    for (name, in_flight, batch) in loads {
        let load = Load {
            in_flight,
            batch,
            connections: CONNECTIONS,
        };
        let mut rates: Vec<Rates> = services.iter().map(|_| Rates::default()).collect();
        for _ in 0..rounds {
            for ((_, address), found) in services.iter().zip(&mut rates) {
                let [rate, p50] = clients.block_on(measured(address, &requests, load, time));
                found.per_second.push(rate);
                found.p50_us.push(p50);
            }
        }

        print_rates(name, &services, &rates);
    }
}

fn print_rates(load: &str, services: &[(&str, &str)], rates: &[Rates]) {
    for ((service, _), found) in services.iter().zip(rates) {
        let of_empty = found.per_second.iter().zip(&rates[1].per_second);
        let of_empty: Vec<f64> = of_empty.map(|(one, empty)| one / empty).collect();
        println!(
            "{load} | {service} | {} | {} | {}",
            spread(&found.per_second, 0),
            spread(&of_empty, 3),
            spread(&found.p50_us, 0),
        );
    }
}

//! How costs grow: with frames per room, columns of a feature, rooms, and requests in flight.
//!
//! Each table has the exponent between successive rows: 1 is proportional, 0 is constant.

use std::hint::black_box;
use std::sync::Arc;
use std::time::{Duration, Instant};

use ndarray::Array2;
use seese3_client::Client;
use seese3_client::proto::v1 as pb;
use seese3_core::adapter::{Adapter, Samples, Siamese, Widths};
use seese3_core::cancel::Cancellation;
use seese3_core::features::{FeatureSource, Features};
use seese3_core::geometry::Twist;
use seese3_core::index::{ExactIndex, HnswIndex, HnswParameters, Index};
use seese3_core::navigation::{
    FitOn, IndexKind, Limits, Method, Mode, Navigator, Query, Reading, RequestedMotion,
    RetrievalMetric, Source, SourceAt, StepKind,
};
use seese3_core::room::FrameId;
use seese3_core::splits::Split;
use seese3_store::Store;
use seese3_testing::noise;
use seese3_testing::wave_room::wave_room;
use tokio::runtime::Runtime;

use super::{Load, make, measured, median, published, requests, serve};

/// Queries of a measurement in this process.
const QUERIES: usize = 201;
/// Coordinates of a latent.
const LATENT: usize = 20;

/// The exponent b of cost = a nᵇ between two measurements.
fn exponent(before: Option<(f64, f64)>, now: (f64, f64)) -> String {
    before.map_or("–".to_owned(), |before| {
        let grown = (now.1 / before.1).ln() / (now.0 / before.0).ln();
        format!("{grown:.2}")
    })
}

/// The median time of a call, microseconds.
fn time_us(mut call: impl FnMut(usize)) -> f64 {
    let mut times: Vec<f64> = (0..QUERIES)
        .map(|query| {
            let began = Instant::now();
            call(query);
            began.elapsed().as_secs_f64() * 1e6
        })
        .collect();
    median(&mut times)
}

/// The search among latents, by frames: exact, and hnsw_rs up to `hnsw_frames`.
pub fn frames(most: usize, hnsw_frames: usize) {
    println!(
        "frames | exact, 1 nearest, us | exponent | 10 nearest, us | build, ms | bytes a frame | hnsw_rs, 10 nearest, us | build, ms | recall"
    );
    let mut before = None;
    for frames in sizes(100, most) {
        // A smooth path of six coordinates bent into twenty; longer recordings cover more of the room.
        let latents = Array2::from_shape_fn((frames, LATENT), |(row, column)| {
            let t = row as f64 / 50.0;
            let wave = |axis: usize| {
                let bent = 1.0 + column as f64 / 7.0;
                ((t / ((axis * axis + 2) as f64 + 0.618)) * bent + axis as f64).sin()
            };
            (0..6).map(wave).sum()
        });
        let ids: Vec<FrameId> = (0..frames as u32).map(FrameId).collect();
        let queries: Vec<Vec<f64>> = (0..QUERIES)
            .map(|query| {
                let row = latents.row(query * 7_919 % frames);
                let away = |column: usize| 0.3 * noise(3, query * LATENT + column);
                (0..LATENT)
                    .map(|column| row[column] + away(column))
                    .collect()
            })
            .collect();

        let began = Instant::now();
        let exact = ExactIndex::of_frames(latents.view(), &ids);
        let build = began.elapsed().as_secs_f64() * 1e3;
        let [one, ten] = [1, 10]
            .map(|k| time_us(|query| drop(black_box(exact.nearest(&queries[query], k, None)))));

        let hnsw = (frames <= hnsw_frames).then(|| {
            let began = Instant::now();
            let hnsw = HnswIndex::new(latents.view(), &ids, HnswParameters::default());
            let build = began.elapsed().as_secs_f64() * 1e3;
            let time = time_us(|query| drop(black_box(hnsw.nearest(&queries[query], 10, None))));
            let found: usize = queries
                .iter()
                .map(|query| {
                    let truth = exact.nearest(query, 10, None);
                    let found = hnsw.nearest(query, 10, None);
                    found.iter().filter(|hit| truth.contains(hit)).count()
                })
                .sum();
            let recall = found as f64 / (10 * QUERIES) as f64;
            format!("{time:.0} | {build:.0} | {recall:.4}")
        });
        println!(
            "{frames} | {one:.1} | {} | {ten:.1} | {build:.1} | {} | {}",
            exponent(before, (frames as f64, one)),
            exact.memory_bytes() / frames,
            hnsw.unwrap_or("– | – | –".to_owned()),
        );
        before = Some((frames as f64, one));
    }
}

/// One answer in this process, by columns of the feature.
pub fn widths(most: usize) {
    println!("columns | Navigate in the process, 4 steps, 1,000 frames, us | exponent");
    let mut before = None;
    for columns in (6..)
        .map(|power| 1 << power)
        .take_while(|&columns| columns <= most)
    {
        let (room, _) = wave_room("width", 1, 1_000);
        let rows = Array2::from_shape_fn((1_000, columns), |(row, column)| {
            let t = row as f64 / 50.0;
            (t * (1.0 + (column % 7) as f64 / 3.0) + column as f64).sin() as f32
        });
        let pairs = (0..900).map(|row| [row, row + 40]).collect();
        let samples = Samples::<f32>::new(rows.view(), room.poses().to_vec(), pairs).unwrap();
        let source = FeatureSource::imported("width", columns);
        let widths = Widths {
            feature: columns,
            hidden: 64,
            latent: LATENT,
        };
        let scale = samples.scale().clone();
        let adapter = Adapter::new(source.clone(), Siamese::initial(widths, 0), scale).unwrap();
        let features = Features::new(source, rows).unwrap();
        let navigator = Navigator::new(
            Arc::new(room),
            &features,
            Arc::new(adapter),
            IndexKind::Exact,
        )
        .unwrap();

        let query = |row: usize| Query {
            source: SourceAt {
                source: Source::Feature(features.rows().row(row * 4).to_vec()),
                pose: None,
            },
            motion: RequestedMotion::Twists(vec![Twist {
                linear: [0.1, 0.0, 0.3].into(),
                angular: [0.0, 0.2, 0.0].into(),
            }]),
            steps: 4,
            mode: Mode::OpenLoop,
            method: Method::Latent(
                StepKind::InversePoincare(Reading::Homogeneous),
                RetrievalMetric::Full,
            ),
            fit_on: FitOn {
                split: Split::Time,
                stride: 40,
            },
            top_k: 1,
            exclude_source: None,
        };
        let time = time_us(|row| {
            let answer = navigator.answer(&query(row), Limits::default(), &Cancellation::default());
            black_box(answer.unwrap());
        });
        println!(
            "{columns} | {time:.1} | {}",
            exponent(before, (columns as f64, time))
        );
        before = Some((columns as f64, time));
    }
}

/// A server by the number of its rooms, of `frames` frames each.
pub fn rooms(folder: &str, most: usize, frames: usize) {
    let served = Runtime::new().unwrap();
    let clients = Runtime::new().unwrap();
    println!(
        "rooms of {frames} frames | published, ms a room | start, s | exponent | memory, kB a room | Navigate in one of them, p50 us | Localize in all, p50 us | exponent"
    );
    let mut before: [Option<(f64, f64)>; 2] = [None; 2];
    let mut made = 0;
    for count in sizes(1, most) {
        if made == 0 {
            clients.block_on(make(folder, frames));
            made = 1;
        }
        let began = Instant::now();
        let store = Store::open(folder).unwrap();
        for room in made..count {
            let (room, features) = wave_room(&format!("room-{room}"), room as u64 + 2, frames);
            clients.block_on(published(&store, &room, &features));
        }
        let each = began.elapsed().as_secs_f64() * 1e3 / (count - made).max(1) as f64;
        made = count;

        let memory = resident();
        let began = Instant::now();
        let (address, server) = served.block_on(serve(store));
        let client = clients.block_on(ready(&address));
        let start = began.elapsed().as_secs_f64();
        let memory = resident().saturating_sub(memory) as f64 / 1e3 / count as f64;

        let (_, features) = wave_room("bench", 1, frames);
        let requests = requests(&features);
        let localize = pb::LocalizeRequest {
            view: requests[0].source.clone(),
            ..pb::LocalizeRequest::default()
        };
        let navigate = time_us(|query| {
            let room = query * 7_919 % count;
            let mut request = requests[query % requests.len()].clone();
            if room > 0 {
                request.room = format!("room-{room}");
            }
            black_box(clients.block_on(client.navigate(request)).unwrap());
        });
        let everywhere = time_us(|_| {
            let answer = clients.block_on(client.localize(localize.clone()));
            black_box(answer.unwrap());
        });
        let n = count as f64;
        println!(
            "{count} | {each:.1} | {start:.2} | {} | {memory:.0} | {navigate:.0} | {everywhere:.0} | {}",
            exponent(before[0], (n, start)),
            exponent(before[1], (n, everywhere)),
        );
        before = [Some((n, start)), Some((n, everywhere))];
        server.abort();
    }
}

/// A server by requests in flight, each on a connection of its own.
pub fn clients(folder: &str, most: usize, seconds: f64) {
    let served = Runtime::new().unwrap();
    let clients = Runtime::new().unwrap();
    let store = Store::open(folder).unwrap();
    let stored = served.block_on(store.load_room("bench", None)).unwrap();
    let requests = Arc::new(requests(&stored.features[0]));
    let (address, _server) = served.block_on(serve(store));
    clients.block_on(ready(&address));
    println!("clients | answers per second | p50 us | exponent of p50");
    let mut before = None;
    for in_flight in sizes(1, most) {
        let load = Load {
            in_flight,
            batch: None,
            connections: in_flight,
        };
        let time = Duration::from_secs_f64(seconds);
        let [rate, p50] = clients.block_on(measured(&address, &requests, load, time));
        println!(
            "{in_flight} | {rate:.0} | {p50:.0} | {}",
            exponent(before, (in_flight as f64, p50))
        );
        before = Some((in_flight as f64, p50));
    }
}

/// 1, 10, 100, … from `least` to `most`.
fn sizes(least: usize, most: usize) -> impl Iterator<Item = usize> {
    std::iter::successors(Some(least), |size| Some(size * 10)).take_while(move |&size| size <= most)
}

/// A client of a server that has loaded its rooms.
async fn ready(address: &str) -> Client {
    let client = Client::connect(address, Duration::from_secs(60))
        .await
        .unwrap();
    while client.rooms().await.is_err() {
        tokio::time::sleep(Duration::from_millis(2)).await;
    }
    client
}

/// Memory of this process, bytes.
fn resident() -> usize {
    let pages = std::fs::read_to_string("/proc/self/statm").unwrap_or_default();
    let pages = pages.split(' ').nth(1).and_then(|pages| pages.parse().ok());
    pages.map_or(0, |pages: usize| pages * 4_096)
}

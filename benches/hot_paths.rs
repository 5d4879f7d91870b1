//! Baselines of the hot paths: one answer by room size, the indexes' scans, a training epoch.
//!
//! No targets: each group has a simpler peer beside it, so that what is read is a ratio of the same
//! run.
#![allow(
    missing_docs,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::too_many_lines,
    reason = "a failed step is a failed run here, and a case may be long"
)]

use std::hint::black_box;
use std::sync::Arc;

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use ndarray::Array2;
use rand::{RngExt, SeedableRng};
use seese3_core::adapter::{Adapter, Mixture, Samples, Siamese, TrainConfig, Trainer, Widths};
use seese3_core::cancel::Cancellation;
use seese3_core::features::{FeatureSource, Features};
use seese3_core::geometry::Twist;
use seese3_core::index::{ExactIndex, HnswIndex, HnswParameters, Index};
use seese3_core::navigation::{
    FitOn, IndexKind, Limits, Method, Mode, Navigator, Query, Reading, RequestedMotion,
    RetrievalMetric, Source, SourceAt, StepKind,
};
use seese3_core::room::{FrameId, Room};
use seese3_core::splits::Split;
use seese3_lab::probes::{MutualKnn, intrinsic_dimension, mutual_knn, ridge_probe};
use seese3_robot::matched_views::ViewKeypoints;
use seese3_robot::two_view::estimate;
use seese3_testing::keypoint_scene::{Random, Scene, camera_path, distorted_camera};
use seese3_testing::panorama::{self, Panorama};
use seese3_testing::wave_room::{COLUMNS, wave_room};

fn random(rows: usize, columns: usize, seed: u64) -> Array2<f64> {
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    Array2::from_shape_simple_fn((rows, columns), || random.random_range(-1.0..1.0))
}

/// A smooth path of six coordinates bent into 20, as latents of a camera's path are.
fn trajectory(rows: usize) -> Array2<f64> {
    Array2::from_shape_fn((rows, 20), |(row, column)| {
        let t = row as f64 / 50.0;
        (0..6)
            .map(|axis| ((t / (axis + 2) as f64) * (1.0 + column as f64 / 7.0) + axis as f64).sin())
            .sum()
    })
}

fn room(frame_count: usize) -> (Arc<Room>, Features) {
    let (room, features) = wave_room("bench", 1, frame_count);
    (Arc::new(room), features)
}

fn adapter() -> Arc<Adapter> {
    let widths = Widths {
        feature: COLUMNS,
        hidden: 64,
        latent: 20,
    };

    let (room, features) = room(200);
    let samples = Samples::<f32>::new(
        features.rows(),
        room.poses().to_vec(),
        (0..100).map(|i| [i, i + 40]).collect(),
    )
    .unwrap();

    let scale = samples.scale().clone();
    Arc::new(
        Adapter::new(
            FeatureSource::imported("bench", COLUMNS),
            Siamese::initial(widths, 0),
            scale,
        )
        .unwrap(),
    )
}

fn query(steps: u32) -> Query {
    let twist = Twist {
        linear: [0.1, 0.0, 0.3].into(),
        angular: [0.0, 0.2, 0.0].into(),
    };

    Query {
        source: SourceAt {
            source: Source::Frame(FrameId(7)),
            pose: None,
        },
        motion: RequestedMotion::Twists(vec![twist]),
        steps,
        mode: Mode::OpenLoop,
        method: Method::Latent(
            StepKind::InversePoincare(Reading::Homogeneous),
            RetrievalMetric::Full,
        ),
        fit_on: FitOn {
            split: Split::Time,
            stride: 40,
        },
        top_k: 10,
        exclude_source: None,
    }
}

/// One answer of four steps; the peer is the same with a source feature, which has to be embedded
/// first.
fn one_answer(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("answer");
    for frame_count in [200, 1_000, 5_000] {
        let (room, features) = room(frame_count);
        let navigator = Navigator::new(room, &features, adapter(), IndexKind::Exact).unwrap();
        let by_frame = query(4);
        let feature = Source::Feature(features.rows().row(7).to_vec());

        let by_feature = Query {
            source: SourceAt {
                source: feature,
                pose: None,
            },
            ..query(4)
        };

        for (name, query) in [("frame", by_frame), ("feature", by_feature)] {
            group.bench_with_input(
                BenchmarkId::new(name, frame_count),
                &query,
                |bencher, query| {
                    bencher.iter(|| {
                        navigator
                            .answer(query, Limits::default(), &Cancellation::default())
                            .unwrap()
                    });
                },
            );
        }
    }

    group.finish();
}

/// One answer of the relational reader, by the number of candidate frames; the peer is inverse
/// Poincaré with the same adapter. The reader of the tests is small: 16 hidden columns, two members.
fn relational(criterion: &mut Criterion) {
    let (adapter, _) = panorama::adapter(true);
    let adapter = Arc::new(adapter);
    let mut group = criterion.benchmark_group("relational");
    for frame_count in [128, 1_024] {
        let seen = Panorama::new("bench", 7, frame_count);
        let room = Arc::new(seen.room.clone());
        let navigator =
            Navigator::new(room, &seen.joined, adapter.clone(), IndexKind::Exact).unwrap();
        group.throughput(Throughput::Elements(frame_count as u64));

        for (name, method) in [
            ("relational", Method::Relational),
            ("inverse-poincare", query(1).method),
        ] {
            let query = Query { method, ..query(1) };
            group.bench_function(BenchmarkId::new(name, frame_count), |bencher| {
                bencher.iter(|| {
                    navigator
                        .answer(&query, Limits::default(), &Cancellation::default())
                        .unwrap()
                });
            });
        }
    }

    group.finish();
}

/// The motion between two views by their matched keypoints. A quarter of the points moves by itself. The peer is
/// `benches/peers/two_view_sift.py`.
fn two_views(criterion: &mut Criterion) {
    let camera = distorted_camera();
    let scene = Scene::in_box(3_000, 5);
    let mut random = Random::new(6);
    let mut later = scene.clone();
    for point in later.points.iter_mut().step_by(4) {
        *point += random.normals() * 0.3;
    }
    let [first, second] = [0, 8].map(|step| camera_path(100)[step]);
    let first = scene.view(&first, &camera, 0.5, &mut random).keypoints;
    let second = later.view(&second, &camera, 0.5, &mut random).keypoints;
    let view = |keypoints| ViewKeypoints {
        keypoints,
        camera: &camera,
    };

    criterion.bench_function("two-views", |bencher| {
        bencher.iter(|| estimate(view(&first), view(&second)));
    });
}

/// Ten nearest of a path's latents: the exact scan beside hnsw_rs.
fn scan(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("scan");
    for frame_count in [1_000usize, 5_000, 20_000] {
        let latents = trajectory(frame_count);
        let frames: Vec<FrameId> = (0..frame_count as u32).map(FrameId).collect();
        let queries = random(64, 20, 3);
        let exact = ExactIndex::new(latents.view(), &frames);

        let hnsw = HnswIndex::new(latents.view(), &frames, HnswParameters::default());
        group.throughput(Throughput::Elements(frame_count as u64));

        for (name, index) in [("exact", &exact as &dyn Index), ("hnsw_rs", &hnsw)] {
            group.bench_function(BenchmarkId::new(name, frame_count), |bencher| {
                let mut next = queries.outer_iter().cycle();
                bencher.iter(|| index.nearest(black_box(&next.next().unwrap().to_vec()), 10, None));
            });
        }
    }

    group.finish();
}

/// An epoch of 30,000 pairs of 1,000 frames; the peer is its first layer's products alone, which no
/// implementation can do without: one forward and one backward product for each distinct frame of each batch.
/// Another peer is `benches/peers/training.py`. On each processor an epoch of its own, as in sweeps, should
/// take as long as one alone.
fn epoch(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("epoch");
    group.sample_size(10);
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    for columns in [256, 768] {
        let data = EpochData::new(columns);
        let mut trainer = data.trainer();
        group.bench_function(BenchmarkId::new("train", columns), |bencher| {
            bencher.iter(|| data.train(&mut trainer));
        });

        let mut trainers: Vec<_> = (0..threads).map(|_| data.trainer()).collect();
        group.bench_function(
            BenchmarkId::new(format!("train-on-each-of-{threads}-processors"), columns),
            |bencher| {
                bencher.iter(|| {
                    std::thread::scope(|scope| {
                        for trainer in &mut trainers {
                            scope.spawn(|| black_box(data.train(trainer)));
                        }
                    });
                });
            },
        );

        let weight = random(64, columns, 5).mapv(|x| x as f32);
        let gathered = data.gathered();
        group.bench_function(
            BenchmarkId::new("first-layer-products", columns),
            |bencher| {
                bencher.iter(|| {
                    for batch in &gathered {
                        let hidden = batch.dot(&weight.t());
                        black_box(hidden.t().dot(batch));
                    }
                });
            },
        );
    }

    group.finish();
}

struct EpochData {
    columns: usize,
    pairs: Vec<[usize; 2]>,
    features: Array2<f32>,
    samples: Samples<f32>,
    batches: Vec<Vec<usize>>,
}

impl EpochData {
    const PAIRS: usize = 30_000;
    const BATCH: usize = 512;

    fn new(columns: usize) -> Self {
        let (room, _) = room(1_000);
        let features = random(1_000, columns, 6).mapv(|x| x as f32);
        let mut rows = rand_chacha::ChaCha8Rng::seed_from_u64(4);
        let pairs: Vec<[usize; 2]> = (0..Self::PAIRS)
            .map(|_| {
                let source = rows.random_range(0..960usize);
                [source, source + rows.random_range(10..=40usize)]
            })
            .collect();

        let every: Vec<usize> = (0..Self::PAIRS).collect();
        let poses = room.poses().to_vec();
        Self {
            columns,
            samples: Samples::new(features.view(), poses, pairs.clone()).unwrap(),
            features,
            pairs,
            batches: every.chunks(Self::BATCH).map(<[usize]>::to_vec).collect(),
        }
    }

    fn trainer(&self) -> Trainer<'_, f32, Mixture<f32>> {
        let widths = Widths {
            feature: self.columns,
            hidden: 64,
            latent: 20,
        };
        let network = Mixture::initial(widths, 1, 0);
        Trainer::new(&self.samples, network, TrainConfig::default())
    }

    fn train(&self, trainer: &mut Trainer<'_, f32, Mixture<f32>>) -> f64 {
        let batches = self.batches.iter();
        batches.map(|batch| trainer.step(batch).loss).sum()
    }

    /// The features of each batch's distinct frames.
    fn gathered(&self) -> Vec<Array2<f32>> {
        let of_batch = |batch: &Vec<usize>| {
            let mut rows: Vec<usize> = batch.iter().flat_map(|&pair| self.pairs[pair]).collect();
            rows.sort_unstable();
            rows.dedup();
            self.features.select(ndarray::Axis(0), &rows)
        };
        self.batches.iter().map(of_batch).collect()
    }
}

/// M1 to M3 of 5,000 frames; the peer is `benches/peers/probes.py`.
fn probes(criterion: &mut Criterion) {
    const FRAMES: usize = 5_000;
    const COLUMNS: usize = 768;

    let (room, _) = room(FRAMES);
    let mut noise = rand_chacha::ChaCha8Rng::seed_from_u64(5);
    let features = Array2::from_shape_fn((FRAMES, COLUMNS), |(row, column)| {
        let t = row as f64 / FRAMES as f64;
        let smooth = (40.0 * t * (1 + column % 7) as f64 + column as f64).sin();
        (smooth + noise.random_range(-0.05..0.05)) as f32
    });

    let mut group = criterion.benchmark_group("probes");
    group.sample_size(10);
    let options = MutualKnn {
        frames: FRAMES,
        ..MutualKnn::default()
    };
    group.bench_function("m1", |bencher| {
        bencher.iter(|| mutual_knn(features.view(), room.poses(), &options).unwrap());
    });
    group.bench_function("m2", |bencher| {
        bencher.iter(|| intrinsic_dimension(features.view(), 10).unwrap());
    });
    group.bench_function("m3", |bencher| {
        bencher.iter(|| ridge_probe(features.view(), &room, Split::Time, 10).unwrap());
    });
    group.finish();
}

criterion_group!(
    benches, one_answer, relational, two_views, scan, epoch, probes
);
criterion_main!(benches);

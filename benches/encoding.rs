//! What it costs to make a feature: decode, resize, draw, run, and all of it together.
//!
//! With the folder of large inputs (`SEESE3_SHARED`, else `../shared`) and `--features full`;
//! onnxruntime where ORT_DYLIB_PATH names its library. The peer of a whole room is the runtime
//! alone on images that are ready.
#![allow(
    missing_docs,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::too_many_lines,
    reason = "a failed step is a failed run here, and a case may be long"
)]

use std::hint::black_box;
use std::path::{Path, PathBuf};
use std::time::Duration;

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use seese3_core::cancel::Cancellation;
use seese3_core::image::RgbImage;
use seese3_core::room::Timeline;
use seese3_encoder::{
    Device, Encoder, Layer, ModelTask, OnBadImage, Runtime, RuntimeKind, Task, encode_room,
    read_image, recipe,
};
use seese3_studio::{Camera, SuiteRoom, render};

const FRAMES: usize = 64;
const BATCH: usize = 8;

fn shared() -> Option<PathBuf> {
    let given = std::env::var_os("SEESE3_SHARED").map(PathBuf::from);
    let folder = given.unwrap_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared"));
    folder.join("rooms/kitchen").is_dir().then_some(folder)
}

fn threads() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

fn encoder(shared: &Path, kind: RuntimeKind) -> Option<Encoder> {
    let library = std::env::var_os("ORT_DYLIB_PATH").map(PathBuf::from);
    let runtime = Runtime {
        kind,
        threads: threads(),
        library,
        device: Device::Cpu,
    };

    let recipe = recipe("effnetlite0").unwrap();

    let layer = Layer {
        name: "block14".to_owned(),
        base: "0".to_owned(),
        norm: "none".to_owned(),
        pooling: "mean".parse().unwrap(),
    };

    let file = shared.join("models/effnetlite0.onnx");
    let task = ModelTask {
        file,
        preparation: recipe.preparation.clone(),
        layers: vec![layer],
        window: 1,
        keypoints: None,
        is_prefix_stated: true,
    };

    Encoder::model(task, &runtime)
        .inspect_err(|error| eprintln!("SKIPPED {}: {error}", kind.name()))
        .ok()
}

fn parts(criterion: &mut Criterion) {
    let suite = SuiteRoom::new(7, 0);
    let pose = suite.path(400)[200];
    let mut group = criterion.benchmark_group("one image, one thread");
    group.bench_function("draw 320x240", |b| {
        b.iter(|| render(&suite.scene, Camera::sized(320, 240), black_box(&pose)));
    });

    let Some(shared) = shared() else {
        return eprintln!("SKIPPED photographs: no folder SEESE3_SHARED or ../shared");
    };
    let kitchen = shared.join("rooms/kitchen");

    let name = "seq-01/frame-000000.color.jpg";
    group.bench_function("read and decode a JPEG of 640x480", |b| {
        b.iter(|| read_image(&kitchen, name).unwrap())
    });

    let image = read_image(&kitchen, name).unwrap();
    let preparation = recipe("effnetlite0").unwrap().preparation.clone();
    group.bench_function("resize it to 320x240", |b| {
        b.iter(|| preparation.pixels(image.clone()).unwrap())
    });
}

fn rooms(criterion: &mut Criterion) {
    let Some(shared) = shared() else { return };
    let kitchen = shared.join("rooms/kitchen");
    let read = |row: usize| read_image(&kitchen, &format!("seq-01/frame-{row:06}.color.jpg"));
    let timeline = Timeline::unbroken(FRAMES);

    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads())
        .build()
        .unwrap();

    for kind in [RuntimeKind::OnnxRuntime, RuntimeKind::Tract] {
        let Some(encoder) = encoder(&shared, kind) else {
            continue;
        };
        let images: Vec<RgbImage> = (0..FRAMES)
            .map(|row| encoder.prepare(read(row).unwrap()).unwrap())
            .collect();
        let clips: Vec<Vec<&RgbImage>> = images.iter().map(|image| vec![image]).collect();

        let mut group =
            criterion.benchmark_group("64 photographs, EfficientNet-lite0, all threads");
        group
            .sample_size(10)
            .measurement_time(Duration::from_secs(12))
            .throughput(Throughput::Elements(FRAMES as u64));

        group.bench_function(BenchmarkId::new("runtime alone", kind.name()), |b| {
            b.iter(|| {
                pool.install(|| {
                    clips
                        .chunks(BATCH)
                        .for_each(|clips| drop(black_box(encoder.encode(clips).unwrap())))
                });
            });
        });

        group.bench_function(
            BenchmarkId::new("from files to features", kind.name()),
            |b| {
                let cancel = Cancellation::default();
                let task = Task {
                    timeline: &timeline,
                    image: &read,
                    batch: BATCH,
                    on_bad: OnBadImage::Stop,
                    cancel: &cancel,
                };

                b.iter(|| pool.install(|| encode_room(&task, &encoder, None, &|_| ()).unwrap()));
            },
        );
    }
}

criterion_group!(benches, parts, rooms);
criterion_main!(benches);

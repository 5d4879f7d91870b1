//! Every parser of outside bytes, given files that were valid once: bits flipped, parts cut,
//! doubled, overwritten with extremes. Anything but an answer or an error is a defect: a panic, an
//! abort, an endless loop, memory without bound.
//!
//! Each parser gets half a second, or SEESE3_FUZZ_SECONDS; `just fuzz` gives ten minutes. A file
//! that makes a parser panic is written beside the test program, and its name is printed.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use seese3_core::features::Features;
use seese3_core::keypoints::{KeypointSource, Keypoints};
use seese3_data::datasets::{self, Reader, Unusable};
use seese3_encoder::{self as encoder, Bounds};
use seese3_robot::matched_views::{Mapping, MappingParameters};
use seese3_server::Keyring;
use seese3_store::{
    ResourceName, RoomContents, RoomKeypoints, Store, check_adapter_files, stated_weights_size,
};
use sha2::{Digest, Sha256};

use seese3_testing::golden;
use seese3_testing::keypoint_scene::{Random, Scene, camera_path, distorted_camera};
use seese3_testing::recording::{adapter, room, set};

/// An issuer in a file of credentials.
const ISSUER: &str = "[[issuer]]\nissuer = \"https://login.example.org\"\naudience = \"seese3\"\n\
    public_keys = [\"rsa.pem\"]\nverbs = [\"navigate\"]\nrooms = [\"*\"]\n";

fn time_for_each() -> Duration {
    let given = std::env::var("SEESE3_FUZZ_SECONDS").ok();
    let seconds = given.map_or(0.5, |text| {
        text.parse().expect("SEESE3_FUZZ_SECONDS is a number")
    });
    Duration::from_secs_f64(seconds)
}

/// Numbers that lengths and counts are most often wrong at.
const EXTREMES: [u64; 8] = [
    0,
    1,
    0x7f,
    0xffff,
    0x7fff_ffff,
    0xffff_ffff,
    i64::MAX as u64,
    u64::MAX,
];

/// One to six changes of a file.
fn mutated(seed: &[u8], random: &mut ChaCha8Rng) -> Vec<u8> {
    let mut bytes = seed.to_vec();
    for _ in 0..random.random_range(1..=6) {
        if bytes.is_empty() {
            bytes.push(0);
        }
        let at = random.random_range(0..bytes.len());
        let count = random.random_range(1..=64).min(bytes.len() - at);

        match random.random_range(0..8) {
            0 => bytes[at] ^= 1 << random.random_range(0..8),
            1 => bytes[at] = random.random(),
            2 => bytes.truncate(at),
            3 => drop(bytes.drain(at..at + count)),
            4 => {
                let part = bytes[at..at + count].to_vec();
                bytes.splice(at..at, part);
            }
            5 => random.fill_bytes(&mut bytes[at..at + count]),
            _ => {
                let extreme = EXTREMES[random.random_range(0..EXTREMES.len())];
                let width = [1, 2, 4, 8][random.random_range(0..4)];
                let value = match random.random() {
                    true => extreme.to_le_bytes()[..width].to_vec(),
                    false => extreme.to_be_bytes()[8 - width..].to_vec(),
                };
                let end = (at + width).min(bytes.len());
                bytes.splice(at..end, value);
            }
        }
    }

    bytes
}

/// Gives a parser mutations of each seed in turn until its time is up. Returns how many it got.
fn feed(name: &str, seeds: &[Vec<u8>], mut parse: impl FnMut(&[u8])) -> u64 {
    let mut random = ChaCha8Rng::seed_from_u64(Sha256::digest(name)[0].into());
    let until = Instant::now() + time_for_each();
    let mut fed = 0;

    while Instant::now() < until || fed < 20 {
        for seed in seeds {
            let bytes = mutated(seed, &mut random);
            fed += 1;
            if catch_unwind(AssertUnwindSafe(|| parse(&bytes))).is_err() {
                let file = std::env::current_exe()
                    .unwrap()
                    .with_file_name(format!("hostile-{name}-{fed}"));
                std::fs::write(&file, &bytes).unwrap();
                panic!("{name} panicked at {}", file.display());
            }
        }
    }

    fed
}

/// The same for a parser that reads a file.
fn feed_file(name: &str, seeds: &[&Path], parse: impl Fn(&Path)) {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join(seeds[0].file_name().unwrap());
    let seeds: Vec<Vec<u8>> = seeds
        .iter()
        .map(|seed| std::fs::read(seed).unwrap())
        .collect();

    let fed = feed(name, &seeds, |bytes| {
        std::fs::write(&file, bytes).unwrap();
        parse(&file);
    });
    println!("{name}: {fed}");
}

/// Oracle: no panic, here and below.
#[test]
fn recordings() {
    let golden = golden();
    let poses = golden.join("rooms/synthetic/poses.npy");
    let features = golden.join("rooms/synthetic/features.npy");
    feed_file("poses", &[&poses], |file| {
        drop(datasets::read_poses(file));
    });
    feed_file("features", &[&features], |file| {
        drop(datasets::read_features(file));
    });
    feed_file("timestamps", &[&poses, &features], |file| {
        drop(datasets::read_timestamps(file));
    });

    let tum = golden.join("datasets/tum/groundtruth.txt");
    feed_file("tum", &[&tum], |file| {
        drop(datasets::read_tum_trajectory(file));
    });

    let sens = golden.join("datasets/scannet_sens/tiny.sens");
    feed_file("sens", &[&sens], |file| {
        let mut reader = Reader {
            unusable: Unusable::Drop,
            progress: &mut |_, _| (),
        };
        drop(datasets::read_sens(file, &mut reader));
    });
}

/// Bags of ROS 2, by both of their formats.
#[cfg(feature = "full")]
#[test]
fn bags() {
    let folder = tempfile::tempdir().unwrap();
    for bag in ["bag.mcap", "bag.db3", "foxglove.mcap"] {
        let seed = golden().join("datasets").join(bag);
        feed_file(bag, &[&seed], |file| {
            let mut reader = Reader {
                unusable: Unusable::Drop,
                progress: &mut |_, _| (),
            };
            let bag = datasets::Bag {
                images: folder.path().join("images"),
                ..datasets::Bag::default()
            };
            drop(datasets::read_bag(file, &bag, &mut reader));
        });
    }
}

#[test]
fn images() {
    let datasets = golden().join("datasets");
    let seeds = [
        "tum/rgb/1700000000.100000.png",
        "tum/depth/1700000000.101500.png",
        "scannet/scene0000_00/color/0.jpg",
    ]
    .map(|seed| std::fs::read(datasets.join(seed)).unwrap());
    let bounds = Bounds {
        bytes: 4 << 20,
        pixels: 1_000_000,
    };

    feed("image", &seeds, |bytes| {
        drop(encoder::decode("image", bytes, bounds));
    });
}

#[test]
fn headers_of_models() {
    let golden = golden().join("encoder");
    let models =
        ["image.onnx", "clip_time_first.onnx", "turned.onnx"].map(|name| golden.join(name));
    let models: Vec<&Path> = models.iter().map(std::path::PathBuf::as_path).collect();

    feed_file("model", &models, |file| {
        drop(encoder::identity(file.to_str().unwrap()));
        drop(encoder::declared_outputs(file));
        drop(encoder::declared_size(file));
    });
}

#[test]
fn credentials_and_names() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("auth.toml");
    let credentials = format!(
        "[[principal]]\nname = \"robot\"\ntoken_sha256 = \"{}\"\nverbs = [\"navigate\"]\nrooms = [\"lab-*\"]\nstreams = 4\n",
        "ab".repeat(32)
    );
    let issuer = ISSUER.as_bytes().to_vec();
    let seeds = [credentials.into_bytes(), issuer];
    feed("credentials", &seeds, |bytes| {
        std::fs::write(&file, bytes).unwrap();
        drop(Keyring::open(file.clone()));
    });

    let names = [b"rooms/kitchen/revisions/3".to_vec()];
    feed("name", &names, |bytes| {
        drop(String::from_utf8_lossy(bytes).parse::<ResourceName>());
    });
}

/// Tokens that an issuer signed, and the issuer's public keys.
#[cfg(feature = "full")]
#[test]
fn tokens_of_issuers() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("auth.toml");
    let key = folder.path().join("rsa.pem");
    let pem = std::fs::read(golden().join("jwt/rsa.pem")).unwrap();
    std::fs::write(&key, &pem).unwrap();
    std::fs::write(&file, ISSUER).unwrap();
    feed("public key", std::slice::from_ref(&pem), |bytes| {
        std::fs::write(&key, bytes).unwrap();
        drop(Keyring::open(file.clone()));
    });

    std::fs::write(&key, &pem).unwrap();
    let keyring = Keyring::open(file).unwrap().current();
    let tokens = std::fs::read(golden().join("jwt/tokens.json")).unwrap();
    let tokens: serde_json::Value = serde_json::from_slice(&tokens).unwrap();
    let token = tokens["good"]["RS256"].as_str().unwrap().as_bytes();
    assert!(keyring.by_token(token).is_ok());
    feed("token of an issuer", &[token.to_vec()], |bytes| {
        assert!(bytes == token || keyring.by_token(bytes).is_err());
    });
}

/// A manifest as it would be if its object had this content: parsers behind checksums are reached.
fn resealed(manifest: &[u8], object: &[u8], is_meant: impl Fn(&str) -> bool) -> Vec<u8> {
    fn reseal(value: &mut serde_json::Value, object: &[u8], is_meant: &dyn Fn(&str) -> bool) {
        let is_it = value["file"].as_str().is_some_and(is_meant);
        match value {
            serde_json::Value::Object(fields) => {
                if is_it {
                    fields["sha256"] = hex::encode(Sha256::digest(object)).into();
                    fields["bytes"] = object.len().into();
                }
                fields
                    .values_mut()
                    .for_each(|field| reseal(field, object, is_meant));
            }
            serde_json::Value::Array(entries) => entries
                .iter_mut()
                .for_each(|entry| reseal(entry, object, is_meant)),
            _ => {}
        }
    }

    let mut manifest: serde_json::Value = serde_json::from_slice(manifest).unwrap();
    reseal(&mut manifest["body"], object, &is_meant);
    let body = manifest["body"].to_string();
    let sha256 = hex::encode(Sha256::digest(&body));
    format!("{{\"sha256\": \"{sha256}\", \"body\": {body}}}").into_bytes()
}

async fn stored() -> (tempfile::TempDir, Store) {
    let folder = tempfile::tempdir().unwrap();
    let store = Store::create(folder.path().to_str().unwrap()).unwrap();
    (folder, store)
}

fn runtime() -> tokio::runtime::Runtime {
    tokio::runtime::Builder::new_current_thread()
        .build()
        .unwrap()
}

#[test]
fn adapters() {
    let runtime = runtime();
    let (manifest, weights) = runtime.block_on(async {
        let (_folder, store) = stored().await;
        let (room, features) = (room("a"), set("f", 1.0));
        let (adapter, record) = adapter(&room, &features);
        store
            .publish_adapter("base", &adapter, &record, features.rows())
            .await
            .unwrap();
        store.adapter_files("base", None).await.unwrap()
    });

    feed("manifest", std::slice::from_ref(&manifest), |bytes| {
        drop(stated_weights_size(bytes));
    });
    let mut refused = 0_u64;
    let fed = feed("weights", std::slice::from_ref(&weights), |bytes| {
        let manifest = resealed(&manifest, bytes, |_| true);
        refused += u64::from(check_adapter_files(&manifest, bytes).is_err());
    });

    // The seal is sound: what was not altered is accepted, and almost nothing else.
    let untouched = resealed(&manifest, &weights, |_| true);
    assert!(check_adapter_files(&untouched, &weights).is_ok());
    assert!(refused > fed / 2, "{refused} of {fed}");
}

/// Keypoints of the frames of `room("a")`, mapped from views of a scene.
fn mapped_keypoints(features: &Features) -> RoomKeypoints {
    let scene = Scene::in_box(40, 1);
    let camera = distorted_camera();
    let poses = camera_path(features.rows().nrows());
    let mut random = Random::new(2);
    let keypoints: Vec<Keypoints> = poses
        .iter()
        .map(|pose| scene.view(pose, &camera, 0.0, &mut random).keypoints)
        .collect();

    let parameters = MappingParameters::default();
    let mapping = Mapping::new(&poses, &keypoints, camera, parameters).unwrap();
    let map = Arc::new(mapping.map(&|| ()));
    assert!(map.frames.iter().any(|frame| !frame.is_empty()));
    let source = KeypointSource {
        feature: features.source().clone(),
        positions: "kpt".to_owned(),
        reliability: "heat".to_owned(),
        descriptors: "fusion".to_owned(),
        model_file: "a.onnx".to_owned(),
    };
    RoomKeypoints { source, map }
}

#[test]
fn rooms() {
    let runtime = runtime();
    let (folder, store) = runtime.block_on(stored());
    let features = [set("f", 1.0)];
    let keypoints = mapped_keypoints(&features[0]);
    let contents = RoomContents {
        room: &room("a"),
        features: &features,
        keypoints: Some(&keypoints),
    };
    runtime.block_on(store.publish_contents(contents)).unwrap();

    let manifest = folder.path().join("rooms/a/revisions/000001.json");
    let sealed = std::fs::read(&manifest).unwrap();
    let objects = folder.path().join("rooms/a/objects");
    for entry in std::fs::read_dir(objects).unwrap() {
        let object = entry.unwrap().path();
        let name = object.file_name().unwrap().to_str().unwrap().to_owned();
        let content = std::fs::read(&object).unwrap();

        let load = |store: &Store| runtime.block_on(store.load_room("a", None));
        feed(&name, std::slice::from_ref(&content), |bytes| {
            std::fs::write(&object, bytes).unwrap();
            std::fs::write(&manifest, resealed(&sealed, bytes, |file| file == name)).unwrap();
            drop(load(&store));
        });

        std::fs::write(&object, &content).unwrap();
        std::fs::write(&manifest, resealed(&sealed, &content, |file| file == name)).unwrap();
        assert!(load(&store).is_ok(), "{name}");
    }
}

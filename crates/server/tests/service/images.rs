//! Images sent instead of features: the answers are those of the features that the images have.

use std::io::Cursor;
use std::path::PathBuf;

use image::{ExtendedColorType, ImageEncoder, codecs::png::PngEncoder};
use ndarray::Array2;
use seese3_client::proto::v1 as pb;
use seese3_core::adapter::{Preset, RelationalConfig};
use seese3_core::features::Features;
use seese3_core::image::RgbImage;
use seese3_core::room::{Frames, Provenance, Room, RoomId};
use seese3_core::splits::Split;
use seese3_core::training::{RoomData, TrainingPlan, train_adapter, train_reader};
use seese3_encoder::{
    Bounds, Device, Encoder, Layer, ModelTask, Preparation, Resize, Runtime, RuntimeKind,
};
use seese3_server::{Config, ImageEncoders};
use seese3_store::Store;
use seese3_studio::{Camera, Scene, camera_path, render};
use sha2::{Digest, Sha256};
use tonic::Code;

use crate::harness::{TestServer, frame, start_on, to_frame};
use seese3_testing::near;

const FRAMES: usize = 120;
const ROOM: &str = "drawn";

fn pictures() -> (Vec<RgbImage>, Frames) {
    let scene = Scene::new(5);
    let poses = camera_path(&scene, FRAMES, 5);
    let pictures = poses
        .iter()
        .map(|pose| render(&scene, Camera::small(), pose))
        .collect();

    (
        pictures,
        Frames {
            poses,
            ..Frames::default()
        },
    )
}

/// A store with a drawn room, its built-in features, and an adapter on them.
async fn drawn_store() -> (tempfile::TempDir, Store, Vec<RgbImage>) {
    let folder = tempfile::tempdir().unwrap();
    let store = Store::create(folder.path().to_str().unwrap()).unwrap();
    let (pictures, frames) = pictures();
    let encoder = Encoder::builtin();

    let clips: Vec<Vec<&RgbImage>> = pictures.iter().map(|picture| vec![picture]).collect();
    let rows: Array2<f32> = encoder.encode(&clips).unwrap();
    let features = Features::new(encoder.sources("builtin").remove(0), rows).unwrap();
    let room = Room::new(RoomId::new(ROOM).unwrap(), frames, Provenance::default()).unwrap();
    store
        .publish_room(&room, std::slice::from_ref(&features))
        .await
        .unwrap();

    let mut plan = TrainingPlan::of(Preset::PaperBase, Split::Time, 10, 0);
    plan.config.epochs = 2;

    let data = RoomData {
        room: &room,
        revision: 1,
        features: &features,
    };
    let (adapter, record) = train_adapter(&[data], &plan, &mut |_| ()).unwrap();
    store
        .publish_adapter("eyes", &adapter, &record, features.rows())
        .await
        .unwrap();

    (folder, store, pictures)
}

fn with_encoders(models: &[&str]) -> Config {
    let encoders = ImageEncoders {
        models: models.iter().map(|&model| model.to_owned()).collect(),
        runtime: Runtime {
            kind: RuntimeKind::Tract,
            threads: 1,
            library: None,
            device: Device::Cpu,
        },
        bounds: Bounds {
            bytes: 1 << 20,
            pixels: 10_000,
        },
        request_pixels: ImageEncoders::REQUEST_PIXELS,
    };

    Config {
        encoders: Some(encoders),
        ..Config::default()
    }
}

fn png(picture: &RgbImage) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    let width = picture.width as u32;
    let height = picture.height as u32;
    PngEncoder::new(&mut bytes)
        .write_image(&picture.bytes, width, height, ExtendedColorType::Rgb8)
        .unwrap();

    bytes.into_inner()
}

fn image(bytes: Vec<u8>) -> Option<pb::View> {
    Some(pb::View {
        view: Some(pb::view::View::Image(bytes)),
    })
}

async fn served(config: Config) -> (TestServer, Vec<RgbImage>) {
    let (folder, store, pictures) = drawn_store().await;
    (start_on(folder, store, config).await, pictures)
}

fn navigate(source: Option<pb::View>) -> pb::NavigateRequest {
    pb::NavigateRequest {
        room: ROOM.to_owned(),
        source,
        motion: Some(pb::RequestedMotion {
            motion: Some(pb::requested_motion::Motion::Twist(crate::harness::twist(
                [0.1, 0.0, 0.05, 0.0, 0.1, 0.0],
            ))),
        }),
        ..pb::NavigateRequest::default()
    }
}

/// Oracle: PNG is lossless, so a frame's image is the frame: the same place, the same motion, the
/// same answer.
#[tokio::test]
async fn an_image_is_answered_as_its_frame_is() {
    let (server, pictures) = served(with_encoders(&["builtin"])).await;
    let request = pb::LocalizeRequest {
        view: image(png(&pictures[33])),
        adapter: "eyes".to_owned(),
        ..Default::default()
    };

    let found = server
        .client
        .localize(request)
        .await
        .unwrap()
        .frames
        .remove(0)
        .frame
        .unwrap();

    assert_eq!(found.frame_id, 33);

    near("distance", found.distance, 0.0, 1e-5);

    let by_image = server
        .client
        .navigate(navigate(image(png(&pictures[50]))))
        .await
        .unwrap();

    let by_frame = server.client.navigate(navigate(frame(50))).await.unwrap();
    assert_eq!(
        by_image.steps[0].frames[0].frame_id,
        by_frame.steps[0].frames[0].frame_id
    );

    let motion = |first, second| pb::EstimateMotionRequest {
        room: ROOM.to_owned(),
        first,
        second,
        ..pb::EstimateMotionRequest::default()
    };
    let by_image = motion(image(png(&pictures[20])), image(png(&pictures[30])));

    let by_image = server
        .client
        .estimate_motion(by_image)
        .await
        .unwrap()
        .motion
        .unwrap();

    let by_frame = server
        .client
        .estimate_motion(motion(frame(20), frame(30)))
        .await
        .unwrap()
        .motion
        .unwrap();

    let a = by_image.twist.unwrap().linear.unwrap();
    let b = by_frame.twist.unwrap().linear.unwrap();
    for (a, b) in [(a.x, b.x), (a.y, b.y), (a.z, b.z)] {
        near("v", a, b, 1e-5);
    }
}

/// An encoder of two layers of a tiny model, each pooled to a grid.
fn two_grids() -> (String, Encoder) {
    let file = seese3_testing::golden().join("encoder/image.onnx");
    let layer = |name: &str| Layer {
        name: name.to_owned(),
        base: "name".to_owned(),
        norm: "none".to_owned(),
        pooling: "grid2x2".parse().unwrap(),
    };
    let task = ModelTask {
        file: file.clone(),
        preparation: Preparation {
            resize: Resize::Whole {
                width: 8,
                height: 6,
            },
            divisor: 255.0,
            ..Preparation::default()
        },
        layers: vec![layer("map"), layer("tokens")],
        window: 1,
        keypoints: None,
        is_prefix_stated: true,
    };
    let runtime = Runtime {
        kind: RuntimeKind::Tract,
        threads: 1,
        library: None,
        device: Device::Cpu,
    };
    let encoder = Encoder::model(task, &runtime).unwrap();
    (file.to_str().unwrap().to_owned(), encoder)
}

/// Oracle: PNG is lossless, so a frame's image is the frame, also where a feature joins two layers
/// of the encoder and a relational reader compares their cells.
#[tokio::test]
async fn images_of_joined_features_are_answered_as_their_frames_are() {
    if !RuntimeKind::Tract.is_built() {
        eprintln!("skipped: built without the feature onnx");
        return;
    }

    let (model, encoder) = two_grids();
    let (pictures, frames) = pictures();
    let prepared: Vec<RgbImage> = pictures
        .iter()
        .map(|picture| encoder.prepare(picture.clone()).unwrap())
        .collect();
    let clips: Vec<Vec<&RgbImage>> = prepared.iter().map(|picture| vec![picture]).collect();
    let rows: Array2<f32> = encoder.encode(&clips).unwrap();

    let mut begin = 0;
    let features = encoder.sources("tiny").into_iter().map(|source| {
        let end = begin + source.dim;
        let columns = rows.slice(ndarray::s![.., begin..end]).to_owned();
        begin = end;
        Features::new(source, columns).unwrap()
    });
    let features: Vec<Features> = features.collect();
    let joined = Features::joined(&[&features[0], &features[1]]).unwrap();

    let folder = tempfile::tempdir().unwrap();
    let store = Store::create(folder.path().to_str().unwrap()).unwrap();
    let room = Room::new(RoomId::new(ROOM).unwrap(), frames, Provenance::default()).unwrap();
    store.publish_room(&room, &features).await.unwrap();
    let data = RoomData {
        room: &room,
        revision: 1,
        features: &joined,
    };
    let plan = TrainingPlan::of(Preset::PaperBase, Split::Time, 10, 0);
    let (adapter, mut record) = train_adapter(&[data], &plan, &mut |_| ()).unwrap();
    let config = RelationalConfig {
        epochs: 1,
        hidden: 16,
        ..RelationalConfig::default()
    };
    let reader = train_reader(&[data], Split::Time, &config, &mut |_| ()).unwrap();
    record.relational = Some(config);
    let adapter = adapter.with_relational(reader).unwrap();
    let published = store.publish_adapter("eyes", &adapter, &record, joined.rows());
    published.await.unwrap();
    let server = start_on(folder, store, with_encoders(&[&model])).await;

    for navigator in ["inverse-poincare-affine", "relational"] {
        let ask = |source| pb::NavigateRequest {
            navigator: navigator.to_owned(),
            top_k: Some(5),
            ..navigate(source)
        };
        let found = [image(png(&pictures[50])), frame(50)].map(ask);
        let [by_image, by_frame] = found.map(|request| server.client.navigate(request));
        let [by_image, by_frame] = [by_image.await.unwrap(), by_frame.await.unwrap()];
        let frames = |answer: &pb::NavigateResponse| -> Vec<u32> {
            let frames = answer.steps[0].frames.iter();
            frames.map(|frame| frame.frame_id).collect()
        };
        assert_eq!(frames(&by_image), frames(&by_frame), "{navigator}");
    }

    for estimator in [
        pb::MotionEstimator::Unspecified,
        pb::MotionEstimator::Relational,
    ] {
        let ask = |first, second| pb::EstimateMotionRequest {
            room: ROOM.to_owned(),
            first,
            second,
            estimator: estimator.into(),
            ..pb::EstimateMotionRequest::default()
        };
        let by_image = ask(image(png(&pictures[20])), image(png(&pictures[30])));
        let by_image = server.client.estimate_motion(by_image).await.unwrap();
        let by_frame = ask(frame(20), frame(30));
        let by_frame = server.client.estimate_motion(by_frame).await.unwrap();
        let [a, b] = [by_image, by_frame].map(|answer| {
            let linear = answer.motion.unwrap().twist.unwrap().linear.unwrap();
            [linear.x, linear.y, linear.z]
        });
        for (a, b) in a.into_iter().zip(b) {
            near("v", a, b, 1e-5);
        }
    }
}

fn refused<T: std::fmt::Debug>(
    answer: Result<T, seese3_client::Error>,
    code: Code,
    words: &[&str],
) {
    let error = answer.unwrap_err();
    assert_eq!(error.code(), Some(code), "{error}");

    for word in words {
        assert!(error.to_string().contains(word), "{error}");
    }
}

/// Oracle: a list of bad images: no image, a cut one, one too large, and a server without that
/// encoder.
#[tokio::test]
async fn images_that_cannot_be_answered_are_refused_by_field() {
    let (server, pictures) = served(with_encoders(&["builtin"])).await;
    let whole = png(&pictures[0]);

    let large = RgbImage {
        width: 101,
        height: 100,
        bytes: vec![9; 101 * 100 * 3],
    };

    for (bytes, word) in [
        (b"not an image".to_vec(), "JPEG"),
        (whole[..whole.len() / 2].to_vec(), "source.image"),
        (Vec::new(), "JPEG"),
        (png(&large), "101×100"),
    ] {
        let answer = server.client.navigate(navigate(image(bytes))).await;
        refused(answer, Code::InvalidArgument, &["source.image", word]);
    }

    let request = pb::LocalizeRequest {
        view: image(Vec::new()),
        adapter: "eyes".to_owned(),
        ..Default::default()
    };
    refused(
        server.client.localize(request).await,
        Code::InvalidArgument,
        &["view.image"],
    );

    let request = pb::EstimateMotionRequest {
        adapter: "eyes".to_owned(),
        first: image(whole.clone()),
        second: image(b"no".to_vec()),
        ..pb::EstimateMotionRequest::default()
    };
    refused(
        server.client.estimate_motion(request).await,
        Code::InvalidArgument,
        &["second.image"],
    );

    for config in [Config::default(), with_encoders(&["pixels"])] {
        let (server, _) = served(config).await;
        let answer = server.client.navigate(navigate(image(whole.clone()))).await;
        refused(
            answer,
            Code::FailedPrecondition,
            &["builtin-orientations-v1", "--encoder"],
        );

        let by_frame = pb::NavigateRequest {
            motion: to_frame(20),
            ..navigate(frame(10))
        };

        assert!(
            server.client.navigate(by_frame).await.is_ok(),
            "frames are answered all the same"
        );
    }
}

/// Oracle: a server that cannot do what it was asked to says so before it serves.
#[tokio::test]
async fn an_encoder_that_is_not_there_ends_the_server() {
    let (_folder, store, _) = drawn_store().await;
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let missing = PathBuf::from("nowhere/model.onnx");
    let config = with_encoders(&[missing.to_str().unwrap()]);
    let ended = seese3_server::run(listener, store, config, std::future::pending()).await;
    let message = ended.unwrap_err().to_string();

    assert!(
        message.contains("--encoder") && message.contains("model.onnx"),
        "{message}"
    );
}

/// Oracle: PNG is lossless, so that a room of uploaded images is the room of their features.
#[tokio::test]
async fn a_room_can_be_uploaded_as_images() {
    use pb::upload_room_request::Message;

    let config = Config {
        writable: true,
        ..with_encoders(&["builtin"])
    };
    let (server, drawn) = served(config).await;
    let (_, frames) = pictures();

    let upload = |alter: &dyn Fn(&mut pb::FrameBatch)| {
        let poses = frames.poses.iter().flat_map(|pose| {
            let matrix = pose.to_homogeneous().transpose();
            let numbers = matrix.iter().flat_map(|number| number.to_le_bytes());
            numbers.collect::<Vec<u8>>()
        });
        let mut batch = pb::FrameBatch {
            poses: poses.collect(),
            images: drawn.iter().map(png).collect(),
            ..pb::FrameBatch::default()
        };
        alter(&mut batch);

        let mut digest = Sha256::new();
        digest.update(&batch.poses);
        batch.images.iter().for_each(|image| digest.update(image));
        let messages = [
            Message::Room(pb::RoomUpload {
                room: "uploaded".to_owned(),
                encode_for: "eyes".to_owned(),
                ..pb::RoomUpload::default()
            }),
            Message::Frames(batch),
            Message::End(pb::UploadEnd {
                frame_count: FRAMES as u32,
                sha256: digest.finalize().to_vec(),
            }),
        ];
        let messages = messages.map(|message| pb::UploadRoomRequest {
            message: Some(message),
        });
        server.client.upload_room(tokio_stream::iter(messages))
    };

    for alter in [
        &(|batch: &mut pb::FrameBatch| drop(batch.images.pop())) as &dyn Fn(&mut pb::FrameBatch),
        &|batch| batch.images[7] = b"no image".to_vec(),
    ] {
        let refused = upload(alter).await.unwrap_err();
        assert_eq!(refused.code(), Some(Code::InvalidArgument), "{refused}");
        assert_eq!(refused.field().as_deref(), Some("frames.images"));
    }

    assert!(upload(&|_| ()).await.unwrap().served);
    let mut request = navigate(frame(50));
    let drawn = server.client.navigate(request.clone()).await.unwrap();
    request.room = "uploaded".to_owned();
    let uploaded = server.client.navigate(request).await.unwrap();
    assert_eq!(
        drawn.steps[0].frames[0].frame_id,
        uploaded.steps[0].frames[0].frame_id
    );
    near(
        "distance",
        uploaded.steps[0].frames[0].distance,
        drawn.steps[0].frames[0].distance,
        1e-5,
    );
}

//! The frames of a room over the wire, and views turned into latents.

use seese3_client::convert;
use seese3_client::proto::v1 as pb;
use seese3_client::proto::v1::catalog_service_client::CatalogServiceClient;
use seese3_core::geometry::{Twist, body_twist, exp};
use seese3_core::image::RgbImage;
use seese3_core::room::{Frames, Provenance, Room, RoomId};
use seese3_encoder::{Bounds, decode, encode_png};
use seese3_server::Config;
use tonic::Code;

use crate::harness::{
    feature, features_of, filled_store, frame, refused, room_of, start, start_on,
};

/// Oracle: the recorded poses, and a search of all pairs by the definition.
#[tokio::test]
async fn a_room_lists_its_frames_and_their_neighbors() {
    const HOP: f64 = 0.05;
    let server = start(Config::default()).await;
    let room = room_of("synthetic", "synthetic");
    let poses = room.poses();

    let frames = server
        .client
        .frames("synthetic", Some(HOP), None)
        .await
        .unwrap();
    assert_eq!(frames.len(), poses.len());
    assert!(frames.iter().any(|frame| frame.neighbors.len() > 2));

    for (row, found) in frames.iter().enumerate() {
        assert_eq!(found.frame_id as usize, row);
        let pose = convert::pose(found.pose.as_ref().unwrap()).unwrap();
        assert!((pose.to_homogeneous() - poses[row].to_homogeneous()).norm() < 1e-12);

        let near =
            |other: &usize| *other != row && body_twist(&poses[row], &poses[*other]).norm() <= HOP;
        let expected = (0..poses.len()).filter(near).count();
        assert_eq!(found.neighbors.len(), expected.min(32), "frame {row}");

        let mut before = 0.0;
        for neighbor in &found.neighbors {
            let motion = convert::twist(neighbor.motion.as_ref().unwrap()).unwrap();
            let motion = Twist {
                linear: motion.linear,
                angular: motion.angular,
            };
            let there = poses[row] * exp(&motion);
            let stored = poses[neighbor.frame_id as usize];
            assert!((there.to_homogeneous() - stored.to_homogeneous()).norm() < 1e-9);
            assert!(motion.norm() >= before && motion.norm() <= HOP);
            before = motion.norm();
        }
    }

    let plain = server.client.frames("synthetic", None, None).await.unwrap();
    assert!(plain.iter().all(|frame| frame.neighbors.is_empty()));

    for (hop, room, code) in [
        (Some(0.0), "synthetic", Code::InvalidArgument),
        (Some(f64::NAN), "synthetic", Code::InvalidArgument),
        (None, "nowhere", Code::NotFound),
    ] {
        let error = server.client.frames(room, hop, None).await.unwrap_err();
        assert_eq!(error.code(), Some(code), "{error}");
    }
}

/// Oracle: the promises of page tokens: pages follow one another, and none is taken from elsewhere.
#[tokio::test]
async fn frames_come_page_by_page() {
    let server = start(Config::default()).await;
    let mut service = CatalogServiceClient::connect(format!("http://{}", server.address))
        .await
        .unwrap();
    let mut page = async |page_size: i32, page_token: &str| {
        let asked = pb::ListFramesRequest {
            room: "synthetic".to_owned(),
            room_revision: None,
            page_size,
            page_token: page_token.to_owned(),
            neighbors_within: None,
            thumbnail_width: None,
        };
        service
            .list_frames(asked)
            .await
            .map(tonic::Response::into_inner)
    };

    let first = page(7, "").await.unwrap();
    let second = page(7, &first.next_page_token).await.unwrap();
    let ids = |page: &pb::ListFramesResponse| -> Vec<u32> {
        page.frames.iter().map(|frame| frame.frame_id).collect()
    };
    assert_eq!(ids(&first), [0, 1, 2, 3, 4, 5, 6]);
    assert_eq!(ids(&second), [7, 8, 9, 10, 11, 12, 13]);

    let revision = first.room.unwrap().revision;
    let stale = format!("{}.7", revision + 1);
    assert_eq!(
        page(7, &stale).await.unwrap_err().code(),
        Code::FailedPrecondition
    );
    for token in ["7", "1.", ".7", "1.-7", "a.b", "1.7.7"] {
        let refused = page(7, token).await.unwrap_err();
        assert_eq!(refused.code(), Code::InvalidArgument, "{token}");
    }
    assert_eq!(
        page(-1, "").await.unwrap_err().code(),
        Code::InvalidArgument
    );

    // Beyond the end there is nothing, and no next page.
    let beyond = page(7, &format!("{revision}.18446744073709551615"))
        .await
        .unwrap();
    assert!(beyond.frames.is_empty() && beyond.next_page_token.is_empty());
}

/// The room `synthetic` again, as `pictured`, with images below a folder: of every three frames one
/// is red, one green, and one has no file.
fn pictured_room(folder: &std::path::Path) -> Room {
    for (name, color) in [("red.png", [250, 0, 0]), ("green.png", [0, 250, 0])] {
        let picture = RgbImage {
            width: 64,
            height: 48,
            bytes: color.repeat(64 * 48),
        };
        std::fs::write(folder.join(name), encode_png(&picture).unwrap()).unwrap();
    }

    let poses = room_of("synthetic", "synthetic").poses().to_vec();
    let name = |row: usize| ["red.png", "green.png", "lost.png"][row % 3].to_owned();
    let frames = Frames {
        images: (0..poses.len()).map(name).collect(),
        poses,
        ..Frames::default()
    };
    let provenance = Provenance {
        images_root: folder.to_str().unwrap().to_owned(),
        ..Provenance::default()
    };
    Room::new(RoomId::new("pictured").unwrap(), frames, provenance).unwrap()
}

/// Oracle: the images that were drawn. Images leave a server only where its operator says so.
#[tokio::test]
async fn frames_come_with_thumbnails_where_images_are_shown() {
    let images = tempfile::tempdir().unwrap();
    for shown in [true, false] {
        let (folder, store) = filled_store().await;
        let features = [features_of("synthetic")];
        let room = pictured_room(images.path());
        store.publish_room(&room, &features).await.unwrap();
        let config = Config {
            thumbnails: shown,
            ..Config::default()
        };
        let server = start_on(folder, store, config).await;
        let asked = async |room: &str, width: u32| {
            let asked = server.client.frames(room, None, Some(width)).await;
            asked.map_err(|error| error.code().unwrap())
        };

        if !shown {
            assert_eq!(
                asked("pictured", 32).await.unwrap_err(),
                Code::FailedPrecondition
            );
            continue;
        }

        let frames = asked("pictured", 32).await.unwrap();
        assert_eq!(frames.len(), room.frame_count());
        for (row, frame) in frames.iter().enumerate() {
            if row % 3 == 2 {
                assert!(frame.thumbnail.is_empty(), "frame {row}");
                continue;
            }
            let seen = decode("thumbnail", &frame.thumbnail, Bounds::LOCAL).unwrap();
            assert_eq!((seen.width, seen.height), (32, 24));
            let [red, green, blue] = seen.pixel(16, 12);
            let lit = if row % 3 == 0 { red } else { green };
            assert!(lit > 240 && red.min(green) < 10 && blue < 10, "frame {row}");
        }

        // An image that is narrower keeps its size.
        let large = asked("pictured", 512).await.unwrap();
        let seen = decode("thumbnail", &large[0].thumbnail, Bounds::LOCAL).unwrap();
        assert_eq!((seen.width, seen.height), (64, 48));

        assert_eq!(
            asked("synthetic", 32).await.unwrap_err(),
            Code::FailedPrecondition
        );
        for width in [0, 15, 513, u32::MAX] {
            let refused = asked("pictured", width).await.unwrap_err();
            assert_eq!(refused, Code::InvalidArgument, "{width}");
        }
    }
}

/// Oracle: the promise: a latent says what the view says. The frames that are found by it are those
/// that are found by the view, to the bit of their distances.
#[tokio::test]
async fn a_latent_stands_for_its_view() {
    let server = start(Config::default()).await;
    let row = features_of("synthetic").rows().row(77).to_vec();
    let room = "synthetic".to_owned();
    let served = server.client.room("synthetic").await.unwrap();
    let adapter = served.adapters[0].clone();

    let encoded = server
        .client
        .encode(pb::EncodeRequest {
            adapter: adapter.clone(),
            room: room.clone(),
            views: vec![feature(row.clone()).unwrap(), frame(77).unwrap()],
            with_features: true,
            ..pb::EncodeRequest::default()
        })
        .await
        .unwrap();
    assert_eq!(encoded.adapter.unwrap().name, adapter);
    assert_eq!(encoded.views.len(), 2);
    assert_eq!(encoded.views[0].feature.as_ref().unwrap().values, row);
    assert!(encoded.views[1].feature.is_none(), "a frame is no feature");

    let localize = async |view: Option<pb::View>| {
        let asked = pb::LocalizeRequest {
            rooms: vec![room.clone()],
            adapter: adapter.clone(),
            view,
            top_k: Some(5),
            ..Default::default()
        };
        server.client.localize(asked).await.unwrap().frames
    };
    let latent = pb::View {
        view: Some(pb::view::View::Latent(
            encoded.views[0].latent.clone().unwrap(),
        )),
    };
    let of_feature = localize(feature(row)).await;
    assert_eq!(of_feature, localize(Some(latent.clone())).await);

    // The latent names its adapter, so that no default can be taken for it.
    let ask = async |view: pb::View, adapter: &str| {
        let asked = pb::LocalizeRequest {
            rooms: vec![room.clone()],
            adapter: adapter.to_owned(),
            view: Some(view),
            top_k: Some(5),
            ..Default::default()
        };
        server.client.localize(asked).await
    };
    let unnamed = ask(latent.clone(), "").await.unwrap();
    assert_eq!(unnamed.frames, of_feature);
    let altered = |alter: fn(&mut Option<pb::Revision>)| {
        let mut latent = encoded.views[0].latent.clone().unwrap();
        alter(&mut latent.adapter);
        pb::View {
            view: Some(pb::view::View::Latent(latent)),
        }
    };
    let anonymous = altered(|adapter| *adapter = None);
    assert!(ask(anonymous.clone(), &adapter).await.is_ok());
    refused(
        "no adapter",
        ask(anonymous, "").await,
        Code::InvalidArgument,
        "adapter",
    );
    let of_another = altered(|adapter| adapter.as_mut().unwrap().name = "other".to_owned());
    let of_next = altered(|adapter| adapter.as_mut().unwrap().revision = 2);
    for view in [of_another, of_next] {
        let answer = ask(view, &adapter).await;
        refused(
            "another adapter",
            answer,
            Code::InvalidArgument,
            "view.latent.adapter",
        );
    }

    let bad = |views: Vec<pb::View>| pb::EncodeRequest {
        adapter: adapter.clone(),
        views,
        ..Default::default()
    };
    for (request, word) in [
        (bad(Vec::new()), "views"),
        (bad(vec![frame(1).unwrap(); 257]), "views"),
        (bad(vec![frame(1).unwrap()]), "room"),
        (bad(vec![feature(vec![1.0; 3]).unwrap()]), "views[0]"),
    ] {
        let error = server.client.encode(request).await.unwrap_err();
        assert_eq!(error.code(), Some(Code::InvalidArgument), "{error}");
        assert!(
            error.to_string().contains(word),
            "{error} does not say {word}"
        );
    }
}

//! The relational reader in rooms that it was not trained on.

use std::sync::Arc;

use seese3_core::adapter::{Adapter, RelationalConfig, Samples, Siamese, Widths};
use seese3_core::cancel::Cancellation;
use seese3_core::eval::{Protocol, evaluate};
use seese3_core::geometry::body_twist;
use seese3_core::navigation::{
    self, FitOn, IndexKind, Limits, Method, Mode, Navigator, NavigatorKind, Query, RequestedMotion,
    Source, SourceAt,
};
use seese3_core::room::FrameId;
use seese3_core::splits::Split;
use seese3_core::statistics::median;
use seese3_core::training::train_reader;
use seese3_testing::panorama::Panorama;

/// A reader trained in eight rooms, and an adapter with random weights, whose shortlist holds every
/// frame of a small room.
fn adapter(config: &RelationalConfig) -> Adapter {
    let rooms: Vec<Panorama> = (0..8)
        .map(|seed| Panorama::new(&format!("room-{seed}"), seed, 80))
        .collect();
    let data: Vec<_> = rooms.iter().map(Panorama::data).collect();
    let reader = train_reader(&data, Split::Whole, config, &mut |_| ()).unwrap();

    let source = rooms[0].joined.source().clone();
    let widths = Widths {
        feature: source.dim,
        hidden: 16,
        latent: 20,
    };
    let network = Siamese::<f32>::initial(widths, 0);
    let samples = Samples::<f32>::new(
        rooms[0].joined.rows(),
        rooms[0].room.poses().to_vec(),
        vec![[0, 5], [3, 40], [60, 20]],
    );
    Adapter::new(source, network, samples.unwrap().scale().clone())
        .and_then(|adapter| adapter.with_relational(reader))
        .unwrap()
}

fn navigator(config: &RelationalConfig) -> Navigator {
    let unseen = Panorama::new("unseen", 19, 80);
    let room = Arc::new(unseen.room.clone());
    let adapter = Arc::new(adapter(config));
    Navigator::new(room, &unseen.joined, adapter, IndexKind::Exact).unwrap()
}

fn small() -> RelationalConfig {
    RelationalConfig {
        epochs: 2,
        hidden: 64,
        ..RelationalConfig::default()
    }
}

/// Oracle: the true motions of a room that the reader never saw. Zero motion, which is the simplest
/// answer, must be several times worse in rotation, and Identity in Hit@ε.
#[test]
fn a_reader_reads_motions_of_a_room_that_it_never_saw() {
    let navigator = navigator(&small());
    let reader = navigator.adapter().relational().unwrap();
    let cells = navigator.cells().unwrap();
    let poses = navigator.room().poses();

    let mut ours = Vec::new();
    let mut still = Vec::new();
    for source in 0..70 {
        let truth = body_twist(&poses[source], &poses[source + 5]).angular;
        let read = reader.motions(cells, source, &cells.select(&[source + 5]))[0];
        ours.push((truth - read.twist.angular).norm());
        still.push(truth.norm());
    }
    let (ours, still) = (median(&ours), median(&still));
    assert!(3.0 * ours < still, "{ours} rad of {still} rad");

    let protocol = Protocol {
        split: Split::Whole,
        navigators: vec![NavigatorKind::Identity, NavigatorKind::Relational],
        ..Protocol::paper(5)
    };
    let report = evaluate(
        &navigator,
        &protocol,
        &Cancellation::default(),
        &mut |_, _| (),
    );
    let rows = report.unwrap().rows;
    let hit = |row: usize| rows[row].retrieval.hits[0].1.rate;
    assert!(hit(1) > hit(0) + 0.3, "{} against {}", hit(1), hit(0));
    assert_eq!(rows[1].name, "relational");
    assert!(rows[1].latent.is_none());
}

/// Oracle: the definitions. An open loop ends where one step ends; in a snap, each step equals a
/// query from the frame that the last one retrieved; a closed loop needs a pose; a latent has no
/// cells. A feature of a frame answers as the frame does.
#[test]
fn steps_continue_as_their_mode_says() {
    let untrained = RelationalConfig {
        epochs: 1,
        batch: 12_800,
        hidden: 8,
        ..RelationalConfig::default()
    };
    let navigator = navigator(&untrained);
    let poses = navigator.room().poses();
    let motion = body_twist(&poses[10], &poses[22]);
    let query = |source: Source, twist, steps, mode| Query {
        source: SourceAt { source, pose: None },
        motion: RequestedMotion::Twists(vec![twist]),
        steps,
        mode,
        method: Method::Relational,
        fit_on: FitOn {
            split: Split::Time,
            stride: 10,
        },
        top_k: 3,
        exclude_source: Some(0),
    };
    let answer =
        |query: &Query| navigator.answer(query, Limits::default(), &Cancellation::default());
    let frames = |query: &Query| -> Vec<Vec<FrameId>> {
        let steps = answer(query).unwrap().steps;
        assert!(steps.iter().all(|step| step.latent.is_none()));
        steps
            .iter()
            .map(|step| {
                step.frames
                    .iter()
                    .map(|frame| frame.neighbor.frame)
                    .collect()
            })
            .collect()
    };
    let from = |frame: u32| Source::Frame(FrameId(frame));

    let whole = frames(&query(from(10), motion, 1, Mode::OpenLoop));
    let parts = frames(&query(from(10), motion, 4, Mode::OpenLoop));
    assert_eq!((parts.len(), &parts[3]), (4, &whole[0]));

    let snapped = frames(&query(from(10), motion, 2, Mode::Snap));
    let first = frames(&query(from(10), motion.divided(2), 1, Mode::Snap));
    let second = frames(&query(
        from(snapped[0][0].0),
        motion.divided(2),
        1,
        Mode::Snap,
    ));
    assert_eq!(snapped, [first[0].clone(), second[0].clone()]);

    // A feature is no frame of the room, so that no frame is excluded.
    let feature = Panorama::new("unseen", 19, 80)
        .joined
        .rows()
        .row(10)
        .to_vec();
    let included = |source| Query {
        exclude_source: None,
        ..query(source, motion, 1, Mode::OpenLoop)
    };
    let by_feature = frames(&included(Source::Feature(feature.clone())));
    assert_eq!(by_feature, frames(&included(from(10))));

    let closed = answer(&query(
        Source::Feature(feature),
        motion,
        2,
        Mode::ClosedLoop,
    ));
    assert!(matches!(closed, Err(navigation::Error::PoseNeeded { .. })));
    let latent = navigator.latents().row(10).to_vec();
    let by_latent = answer(&query(Source::Latent(latent), motion, 1, Mode::OpenLoop));
    assert_eq!(by_latent.unwrap_err(), navigation::Error::ViewNeeded);
}

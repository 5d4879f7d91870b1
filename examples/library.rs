//! The library without a server: trains an adapter on a drawn recording, and walks from one frame
//! towards another.
//!
//! ```sh
//! cargo run --release --example library
//! ```

use std::sync::Arc;

use seese3_core::adapter::{Preset, Reading};
use seese3_core::cancel::Cancellation;
use seese3_core::features::Features;
use seese3_core::navigation::{
    FitOn, IndexKind, Limits, Method, Mode, Navigator, Query, RequestedMotion, RetrievalMetric,
    Source, SourceAt, StepKind,
};
use seese3_core::ndarray::Array2;
use seese3_core::room::{FrameId, Frames, Provenance, Room, RoomId};
use seese3_core::splits::Split;
use seese3_core::training::{RoomData, TrainingPlan, train_adapter};
use seese3_encoder::{BUILTIN_DIM, builtin_source, encode_builtin};
use seese3_studio::{Camera, Scene, camera_path, render};

const FRAMES: usize = 200;
const SEED: u64 = 7;
const STRIDE: u32 = 10;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    // A recording: images with exact poses. One's own recordings come from `seese3_data::datasets`.
    let scene = Scene::new(SEED);
    let poses = camera_path(&scene, FRAMES, SEED);
    let mut rows = Vec::with_capacity(FRAMES);
    for pose in &poses {
        rows.extend(encode_builtin(&render(&scene, Camera::small(), pose)));
    }
    let rows = Array2::from_shape_vec((FRAMES, BUILTIN_DIM), rows)?;

    let frames = Frames {
        poses,
        ..Frames::default()
    };
    let room = Room::new(RoomId::new("studio")?, frames, Provenance::default())?;
    let features = Features::new(builtin_source("builtin"), rows)?;

    // An adapter, tested on the last fifth of the recording.
    let data = RoomData {
        room: &room,
        revision: 1,
        features: &features,
    };
    let plan = TrainingPlan::of(Preset::PaperRange, Split::Time, STRIDE, SEED);
    let (adapter, record) = train_adapter(&[data], &plan, &mut |_| ())?;
    println!(
        "test R² {:.2}; always predicting the training mean scores {:.2}",
        record.test.overall, record.train_mean_r2
    );

    // A walk towards another frame, as open-loop steps in latent space.
    let navigator = Navigator::new(
        Arc::new(room),
        &features,
        Arc::new(adapter),
        IndexKind::Exact,
    )?;
    let query = Query {
        source: SourceAt {
            source: Source::Frame(FrameId(50)),
            pose: None,
        },
        motion: RequestedMotion::TargetFrame(FrameId(70)),
        steps: 4,
        mode: Mode::OpenLoop,
        method: Method::Latent(
            StepKind::InversePoincare(Reading::Homogeneous),
            RetrievalMetric::Full,
        ),
        fit_on: FitOn {
            split: Split::Time,
            stride: STRIDE,
        },
        top_k: 1,
        exclude_source: None,
    };
    let answer = navigator.answer(&query, Limits::default(), &Cancellation::default())?;

    for (number, step) in answer.steps.iter().enumerate() {
        let hit = &step.frames[0];
        let error_m = step
            .error
            .map_or(f64::NAN, |error| error.pose.translation_m);
        println!(
            "step {}: frame {}, {error_m:.2} m from where it should be",
            number + 1,
            hit.neighbor.frame
        );
    }

    Ok(())
}

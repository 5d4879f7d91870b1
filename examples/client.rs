//! A robot's program: asks a server for the frames that a motion leads to, and for the motion
//! between two of them.
//!
//! ```sh
//! cargo run --release -- demo                                  # makes demo-output/store
//! cargo run --release -- serve --store demo-output/store &
//! cargo run --release --example client -- 127.0.0.1:50051 studio
//! ```

use std::time::Duration;

use seese3_client::nalgebra::Vector3;
use seese3_client::proto::v1 as pb;
use seese3_client::{Client, convert};

const DEADLINE: Duration = Duration::from_secs(5);

#[tokio::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let address = arguments.next().unwrap_or("127.0.0.1:50051".to_owned());
    let room = arguments.next().unwrap_or("studio".to_owned());
    let client = Client::connect(&address, DEADLINE).await?;

    // Half a meter forward and a little to the left, in the camera's own frame: x right, y down,
    // z forward.
    let motion = convert::Twist {
        linear: Vector3::new(0.0, 0.0, 0.5),
        angular: Vector3::new(0.0, -0.2, 0.0),
    };
    let answer = client
        .navigate(pb::NavigateRequest {
            room: room.clone(),
            source: Some(frame(100)),
            motion: Some(pb::RequestedMotion {
                motion: Some(pb::requested_motion::Motion::Twist(convert::twist_to_wire(
                    &motion,
                ))),
            }),
            steps: Some(4),
            step_mode: pb::StepMode::ClosedLoop.into(),
            ..Default::default()
        })
        .await?;

    for step in &answer.steps {
        let Some(hit) = step.frames.first() else {
            continue;
        };
        let world_from_camera = convert::pose(&hit.pose.clone().unwrap_or_default())?;
        let position = world_from_camera.translation.vector;
        println!(
            "step {}: frame {} at ({:.2}, {:.2}, {:.2}) m",
            step.step, hit.frame_id, position.x, position.y, position.z
        );
    }

    // What two views alone say of the motion between them, beside what was recorded.
    let answer = client
        .estimate_motion(pb::EstimateMotionRequest {
            room,
            first: Some(frame(100)),
            second: Some(frame(110)),
            ..Default::default()
        })
        .await?;
    let read = convert::twist(&answer.motion.unwrap_or_default().twist.unwrap_or_default())?;
    println!("read: {:.3} m", read.linear.norm());

    if let Some(truth) = &answer.true_motion {
        println!("true: {:.3} m", convert::twist(truth)?.linear.norm());
    }

    Ok(())
}

/// A view that is a stored frame of the room.
fn frame(frame_id: u32) -> pb::View {
    pb::View {
        view: Some(pb::view::View::FrameId(frame_id)),
    }
}

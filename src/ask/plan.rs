//! `seese3 plan`: a route of stored frames from a view to a goal.

use anyhow::bail;
use clap::Args;

use super::{
    FeatureRow, Server, ViewCamera, deviations_text, motion_text, pose_text, revision, value_text,
    wire_json,
};
use crate::camera::CAMERA_FORM;
use crate::output::{JsonOutput, say};
use seese3_client::proto::v1 as pb;
use seese3_client::proto::v1::plan_route_request::Goal;

#[derive(Debug, Args)]
pub struct Plan {
    #[command(flatten)]
    server: Server,
    /// Name of the room to plan in
    #[arg(long)]
    room: String,
    /// Name of the adapter. If omitted: the room's default (`seese3 store default`), else one
    /// fitted to the room, else one trained in it, else the newest that serves it
    #[arg(long, default_value = "", hide_default_value = true)]
    adapter: String,
    /// Start at this frame of the room (its row, counted from 0)
    #[arg(long, value_name = "FRAME", conflicts_with_all = ["feature_file", "image"])]
    from: Option<u32>,
    #[command(flatten)]
    feature: FeatureRow,
    /// Camera of --image, as --camera of `seese3 import`, or "mapping" for the camera that mapped
    /// the room. Without it, keypoints are not matched
    #[arg(long, value_name = CAMERA_FORM, requires = "image")]
    camera: Option<ViewCamera>,
    /// The goal is the pose of this frame of the room
    #[arg(long, value_name = "FRAME", conflicts_with = "to_pose")]
    to: Option<u32>,
    /// The goal is this camera pose, x,y,z,qx,qy,qz,qw, in meters, in the room's world frame
    #[arg(
        long,
        value_name = "POSE",
        value_delimiter = ',',
        allow_hyphen_values = true
    )]
    to_pose: Option<Vec<f64>>,
    /// Longest hop, ‖(v, ω)‖ with meters and radians mixed. If omitted: the root mean square of the
    /// adapter's training motions, or as long as the route needs
    #[arg(long, value_name = "LENGTH")]
    max_hop_length: Option<f64>,
    /// Distance tolerance of the goal, meters; 0.25 if omitted
    #[arg(long, value_name = "METERS")]
    tolerance_m: Option<f64>,
    /// Angle tolerance of the goal, degrees; 15 if omitted
    #[arg(long, value_name = "DEGREES")]
    tolerance_deg: Option<f64>,
    /// Maximum number of hops; 100 if omitted
    #[arg(long, value_name = "HOPS")]
    max_hops: Option<u32>,
    #[command(flatten)]
    json: JsonOutput,
}

impl Plan {
    pub async fn run(self) -> anyhow::Result<()> {
        self.json.begin()?;
        let source = self.feature.or_frame(
            self.from,
            "--from FRAME, --feature-file FILE --row ROW or --image FILE is required",
        )?;
        let goal = match (self.to, &self.to_pose) {
            (Some(frame), _) => Goal::GoalFrameId(frame),
            (None, Some(numbers)) => Goal::GoalPose(pose(numbers)?),
            (None, None) => bail!("--to FRAME or --to-pose x,y,z,qx,qy,qz,qw is required"),
        };

        let request = pb::PlanRouteRequest {
            room: self.room,
            adapter: self.adapter,
            source: Some(source),
            camera: self.camera.map(ViewCamera::to_wire),
            goal: Some(goal),
            max_hop_length: self.max_hop_length,
            tolerance_m: self.tolerance_m,
            tolerance_rad: self.tolerance_deg.map(f64::to_radians),
            max_hops: self.max_hops,
            ..pb::PlanRouteRequest::default()
        };

        let route = self.server.connect().await?.plan_route(request).await?;
        say_route(&route);
        self.json.write(&wire_json("Route", &route)?)
    }
}

/// A pose from the numbers of the command line. The room's world frame is the only frame that a
/// server accepts, so its name stays empty.
fn pose(numbers: &[f64]) -> anyhow::Result<pb::Pose> {
    let &[x, y, z, qx, qy, qz, qw] = numbers else {
        bail!(
            "--to-pose needs seven numbers, x,y,z,qx,qy,qz,qw, got {}",
            numbers.len()
        );
    };

    Ok(pb::Pose {
        position: Some(pb::Vector3 { x, y, z }),
        orientation: Some(pb::Quaternion {
            x: qx,
            y: qy,
            z: qz,
            w: qw,
        }),
        ..pb::Pose::default()
    })
}

fn say_route(route: &pb::Route) {
    say(format_args!(
        "room {}, adapter {}",
        revision(route.room.as_ref()),
        revision(route.adapter.as_ref())
    ));
    if let Some(start) = &route.start {
        let estimate = start.pose.clone().unwrap_or_default();
        say(format_args!(
            "start at {}{}, {:.3} m and {:.1}° from the goal",
            pose_text(estimate.pose.as_ref()),
            deviations_text(&estimate.covariance),
            start.distance_remaining_m,
            start.rotation_remaining_rad.to_degrees()
        ));
    }

    for (number, hop) in (1..).zip(&route.hops) {
        let frame = hop.frame.as_ref().map_or(0, |frame| frame.frame_id);
        let motion = hop.motion.unwrap_or_default();
        say(format_args!(
            "hop {number:3}  to frame {frame:5}  {}  remaining {:.3} m {:.1}°",
            motion_text(&motion),
            hop.distance_remaining_m,
            hop.rotation_remaining_rad.to_degrees()
        ));
    }

    let outcome = value_text(route.outcome().as_str_name(), "ROUTE_OUTCOME_");
    say(format_args!("{outcome}: {}", route.message));
    if let Some(length) = route.needed_hop_length {
        // Without a route, this is the length with which there is one.
        say(format_args!(
            "every route has a hop of {length:.3} or longer"
        ));
    }
    if let Some(probability) = route.arrival_probability {
        say(format_args!(
            "probability to end within the tolerances: {probability:.2}"
        ));
    }
}

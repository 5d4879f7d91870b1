//! `seese3 import bag`: ROS 2 bags and Foxglove recordings.

use std::path::{Path, PathBuf};

use anyhow::bail;
use clap::Args;

use super::destination::Destination;
use crate::pose_options::DirectionOption;
use seese3_core::geometry::{self, Pose};
use seese3_data::datasets::{self, Bag, Reader};

#[derive(Debug, Args)]
pub struct BagPath {
    /// Folder of the bag, or one of its files, .mcap or .db3
    path: PathBuf,
    /// Image topic; may be omitted if there is only one
    #[arg(long, value_name = "TOPIC")]
    image_topic: Option<String>,
    /// Pose topic: PoseStamped, PoseWithCovarianceStamped or Odometry; may be omitted if there is
    /// only one
    #[arg(long, value_name = "TOPIC", conflicts_with = "world_frame")]
    pose_topic: Option<String>,
    /// Read the camera's poses from /tf, relative to this frame, for example map
    #[arg(long, value_name = "FRAME")]
    world_frame: Option<String>,
    /// Pose of the camera (optical axes) in the frame that the pose topic describes, for example
    /// base_link: x,y,z,qx,qy,qz,qw in meters; needed if /tf does not have it
    #[arg(
        long,
        value_delimiter = ',',
        allow_hyphen_values = true,
        num_args = 1,
        conflicts_with = "world_frame"
    )]
    base_from_camera: Option<Vec<f64>>,
    /// Folder for the images, to which the room refers, with a subfolder per topic; BAG-images next
    /// to the bag if omitted. Existing files are never replaced
    #[arg(long, value_name = "DIR")]
    images_to: Option<PathBuf>,
    #[command(flatten)]
    poses: DirectionOption,
    #[command(flatten)]
    to: Destination,
}

impl BagPath {
    pub async fn import(self) -> anyhow::Result<()> {
        let base_from_camera = self.base_from_camera.as_deref().map(mounting).transpose()?;
        let bag = Bag {
            image_topic: self.image_topic.clone(),
            pose_topic: self.pose_topic.clone(),
            world: self.world_frame.clone(),
            base_from_camera,
            images: self
                .images_to
                .clone()
                .unwrap_or_else(|| images_beside(&self.path)),
        };

        let read = |reader: &mut Reader<'_>| datasets::read_bag(&self.path, &bag, reader);
        let (recording, images) = self.to.read(read)?;
        self.to
            .publish("bag", &self.path, recording, self.poses.direction)
            .await?;

        images.keep();
        Ok(())
    }
}

/// Parses the pose of a camera on a robot.
fn mounting(numbers: &[f64]) -> anyhow::Result<Pose> {
    let &[x, y, z, qx, qy, qz, qw] = numbers else {
        bail!(
            "--base-from-camera needs seven numbers, x,y,z,qx,qy,qz,qw, got {}",
            numbers.len()
        );
    };
    geometry::pose_from_quaternion([x, y, z], nalgebra::Quaternion::new(qw, qx, qy, qz))
        .map_err(|problem| anyhow::anyhow!("--base-from-camera: {problem}"))
}

/// The folder BAG-images next to a bag, which is a folder BAG or a file BAG.mcap or BAG.db3.
fn images_beside(bag: &Path) -> PathBuf {
    // A path such as `.` only has a name once it is resolved.
    let path = bag.canonicalize().unwrap_or_else(|_| bag.to_owned());
    let own = if path.is_dir() {
        path.file_name()
    } else {
        path.file_stem()
    };

    let mut name = own.unwrap_or_default().to_owned();
    name.push("-images");
    path.with_file_name(name)
}

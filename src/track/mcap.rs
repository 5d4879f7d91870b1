//! Writes the answers of a stream as an MCAP file.

use anyhow::Context;

use super::{ReceivedAnswers, RecordedView, map, odom, plain};
use seese3_client::convert;
use seese3_core::geometry::Twist;
use seese3_data::export::{McapRecording, RecordedOdometry};

/// Poses, transforms and images of a stream as the bytes of an MCAP file.
pub fn recorded(heard: &ReceivedAnswers, seen: &[RecordedView]) -> anyhow::Result<Vec<u8>> {
    let names = &heard.names;
    let mut recording = McapRecording::new()?;
    for update in &heard.updates {
        // Each frame gives the transforms map → odom → camera, and the pose in map on a separate
        // topic.
        let time = update.timestamp_ns;
        if let Some(pose) = odom(update) {
            recording.transform(time, &names.odom, &names.camera, &pose)?;
        }
        if let Some(pose) = plain(update.map_from_odom.clone()) {
            recording.transform(time, &names.map, &names.odom, &pose)?;
        }
        if let Some(pose) = map(update) {
            recording.pose("/pose", time, &names.map, &pose)?;

            let camera = update.camera.clone().unwrap_or_default();
            let velocity = camera.velocity.and_then(|velocity| velocity.twist);
            let covariance = camera.map_pose.map(|pose| pose.covariance);
            let odometry = RecordedOdometry {
                frame: &names.map,
                child_frame: &names.camera,
                pose,
                covariance: &covariance.unwrap_or_default(),
                velocity: velocity.and_then(|wire| {
                    let convert::Twist { linear, angular } = convert::twist(&wire).ok()?;
                    Some(Twist { linear, angular })
                }),
            };
            recording.odometry("/odometry", time, &odometry)?;
        }

        // The sequence number identifies the input row, and hence the image file.
        let row = usize::try_from(update.sequence_number)
            .unwrap_or(usize::MAX)
            .saturating_sub(1);
        if let Some(RecordedView::Image(file)) = seen.get(row) {
            let image = seese3_files::read(file, seese3_files::IMAGE_FILE_BYTES)
                .with_context(|| format!("{} cannot be read", file.display()))?;
            recording.image(time, &names.camera, &image)?;
        }
    }

    Ok(recording.finish()?)
}

//! Additional sensors of a stream: the direction of gravity and other cameras.

use nalgebra::{Matrix6, Unit, Vector3};

use super::super::Error;
use super::configuration::{LONGEST_NAME, StreamFrames, clear_name, unnamed, within};
use seese3_client::proto::v1 as pb;
use seese3_core::geometry::{Pose, Twist, exp};
use seese3_robot::front_end::OtherCamera;
use seese3_robot::pose_filter::MeasuredGravity;

/// Maximum number of other cameras of a stream.
const MOST_CAMERAS: usize = 8;
/// Default standard deviation of a measured gravity direction, radians.
const GRAVITY_DEVIATION: f64 = 0.03;
/// Valid standard deviations of a measured gravity direction, radians.
const GRAVITY_DEVIATIONS: std::ops::RangeInclusive<f64> = 1e-3..=1.0;
/// Largest time offset of another camera, nanoseconds.
const LONGEST_OFFSET_NS: u64 = 100_000_000;
/// Minimum length of a direction vector.
const SHORTEST: f64 = 1e-9;

/// The configured sensors of a stream besides its own camera.
#[derive(Debug, Clone)]
pub struct Sensors {
    gravity_in_map: Option<Unit<Vector3<f64>>>,
    base_from_camera: Option<Pose>,
    /// Frame name of the base.
    base: String,
    /// Frame name of the stream's own camera.
    camera: String,
    other_cameras: Vec<RigCamera>,
}

/// Another camera on the robot.
#[derive(Debug, Clone)]
struct RigCamera {
    name: String,
    /// Pose in the frame of the stream's own camera.
    camera_from_other: Pose,
    /// From the view of the stream's own camera to its view.
    time_offset_s: f64,
}

impl Sensors {
    /// The sensors of a configuration.
    ///
    /// # Errors
    /// [`Error::Invalid`] on the field, for a gravity direction of zero length or without a room,
    /// too many cameras, a name that is empty, too long or used twice, and an invalid pose.
    pub fn of(config: &pb::TrackConfig, frames: &StreamFrames) -> Result<Self, Error> {
        let gravity_in_map = config
            .gravity_in_map
            .map(|given| direction("gravity_in_map", given))
            .transpose()?;
        if gravity_in_map.is_some() && config.room.is_empty() {
            return Err(Error::invalid(
                "gravity_in_map",
                "needs `room`: the direction is in the room's world frame",
            ));
        }

        if config.other_cameras.len() > MOST_CAMERAS {
            return Err(Error::invalid(
                "other_cameras",
                format!(
                    "must be at most {MOST_CAMERAS}, not {}",
                    config.other_cameras.len()
                ),
            ));
        }

        let names = &frames.names;
        let mut used = vec![&names.map, &names.odom, &names.camera, &names.base];
        let mut other_cameras = Vec::new();
        for (number, given) in config.other_cameras.iter().enumerate() {
            let field = format!("other_cameras[{number}]");
            let name = &given.name;
            let is_too_long = name.len() > LONGEST_NAME || name.chars().any(char::is_control);
            if name.is_empty() || is_too_long || used.contains(&name) {
                let problem = format!(
                    "must be a name of 1 to {LONGEST_NAME} bytes that no other camera or frame has"
                );
                return Err(Error::invalid(format!("{field}.name"), problem));
            }
            used.push(name);

            let mut pose = given
                .pose
                .clone()
                .ok_or_else(|| Error::invalid(format!("{field}.pose"), "is required"))?;
            clear_name(&mut pose.child_frame, name);
            let parent = match frames.base_from_camera {
                Some(_) => &names.base,
                None => &names.camera,
            };
            clear_name(&mut pose.parent_frame, parent);
            let pose = unnamed(pose).map_err(|error| error.within(&format!("{field}.pose")))?;

            other_cameras.push(RigCamera {
                name: name.clone(),
                camera_from_other: match frames.base_from_camera {
                    Some(base_from_camera) => base_from_camera.inverse() * pose,
                    None => pose,
                },
                time_offset_s: time_offset_s(given.time_offset_ns)
                    .map_err(|error| error.within(&field))?,
            });
        }

        Ok(Self {
            gravity_in_map,
            base_from_camera: frames.base_from_camera,
            base: names.base.clone(),
            camera: names.camera.clone(),
            other_cameras,
        })
    }

    /// The direction of gravity in the room's world frame, if it is known.
    pub fn gravity_in_map(&self) -> Option<Unit<Vector3<f64>>> {
        self.gravity_in_map
    }

    /// The camera of this name, where the stream's own camera has this velocity, with its
    /// covariance.
    ///
    /// # Errors
    /// [`Error::Invalid`] if there is none.
    pub fn other_camera(
        &self,
        name: &str,
        (velocity, covariance): (Twist, Matrix6<f64>),
    ) -> Result<OtherCamera, Error> {
        let number = self
            .other_cameras
            .iter()
            .position(|other| other.name == name);
        let number = number.ok_or_else(|| {
            let known: Vec<&str> = self
                .other_cameras
                .iter()
                .map(|other| other.name.as_str())
                .collect();
            let problem = match known.as_slice() {
                [] => "is unknown: the configuration has no other_cameras".to_owned(),
                known => format!("must be one of: {}", known.join(", ")),
            };
            Error::invalid("camera_name", problem)
        })?;

        let other = &self.other_cameras[number];
        let moved = exp(&velocity.scaled(other.time_offset_s));
        Ok(OtherCamera {
            number: number as u32,
            camera_from_other: moved * other.camera_from_other,
            motion_covariance: covariance * other.time_offset_s.powi(2),
        })
    }

    /// The name of the other camera with this index; empty if there is none.
    pub fn camera_name(&self, number: u32) -> String {
        self.other_cameras
            .get(number as usize)
            .map_or_else(String::new, |other| other.name.clone())
    }

    /// Converts a measured gravity direction to the camera's frame.
    ///
    /// # Errors
    /// [`Error::Invalid`] without `gravity_in_map` in the configuration, for a direction of zero
    /// length, a frame other than the camera's or the base's, and a deviation out of range.
    pub fn gravity(&self, given: &pb::MeasuredGravity) -> Result<MeasuredGravity, Error> {
        let in_world = self.gravity_in_map.ok_or_else(|| {
            Error::invalid("direction", "needs gravity_in_map in the configuration")
        })?;
        let measured = given
            .direction
            .ok_or_else(|| Error::invalid("direction", "is required"))?;
        let measured = direction("direction", measured)?;

        let frame = given.coordinate_frame.as_str();
        let in_camera = match self.base_from_camera {
            Some(base_from_camera) if frame.is_empty() || frame == self.base => {
                base_from_camera.rotation.inverse() * measured
            }
            _ if frame.is_empty() || frame == self.camera => measured,
            base_from_camera => {
                let problem = match base_from_camera {
                    Some(_) => format!("must be {} or {}", self.base, self.camera),
                    None => format!("must be {}: the base is not known", self.camera),
                };
                return Err(Error::invalid("coordinate_frame", problem));
            }
        };

        let deviation_rad = given.deviation_rad.unwrap_or(GRAVITY_DEVIATION);
        Ok(MeasuredGravity {
            in_world,
            in_camera,
            deviation_rad: within("deviation_rad", deviation_rad, GRAVITY_DEVIATIONS)?,
        })
    }
}

/// The time offset of another camera, seconds.
///
/// # Errors
/// [`Error::Invalid`] on one of more than [`LONGEST_OFFSET_NS`].
fn time_offset_s(given_ns: i64) -> Result<f64, Error> {
    if given_ns.unsigned_abs() > LONGEST_OFFSET_NS {
        let problem = format!("must be -{LONGEST_OFFSET_NS} to {LONGEST_OFFSET_NS} nanoseconds");
        return Err(Error::invalid("time_offset_ns", problem));
    }
    Ok(given_ns as f64 * 1e-9)
}

fn direction(field: &str, given: pb::Vector3) -> Result<Unit<Vector3<f64>>, Error> {
    let given = Vector3::new(given.x, given.y, given.z);
    let largest = given.amax();
    let is_finite = given.iter().all(|value| value.is_finite());
    if !(is_finite && largest > SHORTEST) {
        return Err(Error::invalid(field, "must be finite and longer than 0"));
    }

    // Scale first, so that squares of large numbers stay finite.
    Ok(Unit::new_normalize(given / largest))
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a failed step is a failed test")]
mod tests {
    use super::*;

    fn sensors(time_offset_ns: i64) -> Result<Sensors, Error> {
        let ahead = pb::Pose {
            position: Some(pb::Vector3 {
                x: 0.0,
                y: 0.0,
                z: 0.2,
            }),
            orientation: Some(pb::Quaternion {
                w: 1.0,
                x: 0.0,
                y: 0.0,
                z: 0.0,
            }),
            ..pb::Pose::default()
        };
        let config = pb::TrackConfig {
            other_cameras: vec![pb::RigCamera {
                name: "front".to_owned(),
                pose: Some(ahead),
                time_offset_ns,
                ..pb::RigCamera::default()
            }],
            ..pb::TrackConfig::default()
        };
        Sensors::of(&config, &StreamFrames::of(&config).unwrap())
    }

    /// By hand: at 2 m/s along x and two and a half turns per second about z, 0.1 s later the own
    /// camera has turned by 90° on an arc of radius 0.4/π m. A camera 0.2 m ahead of it is then at
    /// the same x and y, 0.2 m along z.
    #[test]
    fn a_later_view_is_moved_by_the_velocity() {
        let velocity = Twist {
            linear: Vector3::new(2.0, 0.0, 0.0),
            angular: Vector3::new(0.0, 0.0, 5.0 * std::f64::consts::PI),
        };
        let radius = 0.4 / std::f64::consts::PI;
        let velocity = (velocity, Matrix6::identity() * 4.0);

        let later = sensors(100_000_000).unwrap();
        let moved = later.other_camera("front", velocity).unwrap();
        // 2 m/s and rad/s over 0.1 s.
        let expected = Matrix6::identity() * 0.04;
        assert!((moved.motion_covariance - expected).norm() < 1e-12);
        let expected = Vector3::new(radius, radius, 0.2);
        let position = moved.camera_from_other.translation.vector;
        assert!((position - expected).norm() < 1e-12, "{position}");
        let turned = moved.camera_from_other.rotation * Vector3::x();
        assert!((turned - Vector3::y()).norm() < 1e-12, "{turned}");

        let together = sensors(0).unwrap();
        let unmoved = together.other_camera("front", velocity).unwrap();
        let position = unmoved.camera_from_other.translation.vector;
        assert!((position - Vector3::new(0.0, 0.0, 0.2)).norm() < 1e-12);

        let error = sensors(2_000_000_000).unwrap_err().to_string();
        assert!(error.contains("other_cameras[0].time_offset_ns"), "{error}");
    }
}

//! The inertial sensor of a stream.

use nalgebra::{Unit, Vector3};

use super::super::Error;
use super::configuration::{StreamFrames, clear_name, unnamed, within};
use seese3_client::proto::v1 as pb;
use seese3_core::geometry::Pose;
use seese3_robot::inertial::{InertialBuffer, InertialMount, InertialNoise, InertialSample};
use seese3_robot::pose_filter::MeasuredInertia;

/// Maximum number of samples of a frame.
pub const MOST_SAMPLES: usize = 2_000;
/// Longest exposure, nanoseconds.
const LONGEST_EXPOSURE_NS: u64 = 1_000_000_000;
/// Largest magnitudes of a sample, rad/s and m/s².
const FASTEST: f64 = 100.0;
const STRONGEST: f64 = 1_000.0;
/// Valid noise, bias and random walk of the gyroscope; of the accelerometer ten times these.
const NOISES: std::ops::RangeInclusive<f64> = 1e-6..=1.0;
const WALKS: std::ops::RangeInclusive<f64> = 0.0..=1.0;

/// The inertial sensor of a stream, with its samples since the last frame.
#[derive(Debug, Clone)]
pub struct Inertial {
    mount: InertialMount,
    noise: InertialNoise,
    offset_ns: i64,
    /// Of the images.
    image_offset_ns: i64,
    down_in_map: Option<Unit<Vector3<f64>>>,
    buffer: InertialBuffer,
    /// The newest sample, in the axes of the sensor.
    last: Option<InertialSample>,
    /// The middle of the exposure of the last frame.
    last_frame_ns: Option<i64>,
}

impl Inertial {
    /// The sensor of a configuration, if it has one.
    ///
    /// # Errors
    /// [`Error::Invalid`] on the field.
    pub fn of(
        config: &pb::TrackConfig,
        frames: &StreamFrames,
        down_in_map: Option<Unit<Vector3<f64>>>,
    ) -> Result<Option<Self>, Error> {
        let field = "inertial_sensor";
        let Some(given) = &config.inertial_sensor else {
            return Ok(None);
        };
        let sensor = Self::read(given, frames).map_err(|error| error.within(field))?;
        Ok(Some(Self {
            image_offset_ns: config.time_offset_ns,
            down_in_map,
            ..sensor
        }))
    }

    fn read(given: &pb::InertialSensor, frames: &StreamFrames) -> Result<Self, Error> {
        let parent = match frames.base_from_camera {
            Some(_) => &frames.names.base,
            None => &frames.names.camera,
        };
        let pose = given.pose.clone().map(|mut pose| {
            clear_name(&mut pose.parent_frame, parent);
            pose.child_frame.clear();
            unnamed(pose).map_err(|error| error.within("pose"))
        });
        let parent_from_sensor = pose.transpose()?.unwrap_or_else(Pose::identity);
        let parent_from_camera = frames.base_from_camera.unwrap_or_else(Pose::identity);

        Ok(Self {
            mount: InertialMount {
                sensor_from_camera: parent_from_sensor.inv_mul(&parent_from_camera),
            },
            noise: noise(given)?,
            offset_ns: given.time_offset_ns,
            image_offset_ns: 0,
            down_in_map: None,
            buffer: InertialBuffer::default(),
            last: None,
            last_frame_ns: None,
        })
    }

    /// Adds the samples of a frame. Those that are not later than the newest known one are there
    /// already, and are left out.
    ///
    /// # Errors
    /// [`Error::Invalid`] on a sample that is not finite, too large or not later than the one
    /// before it in the frame, and for too many. No sample is then added.
    pub fn add(&mut self, given: &[pb::InertialSample]) -> Result<(), Error> {
        if given.len() > MOST_SAMPLES {
            let problem = format!("must be at most {MOST_SAMPLES}, not {}", given.len());
            return Err(Error::invalid("inertial_samples", problem));
        }

        let mut samples: Vec<InertialSample> = Vec::with_capacity(given.len());
        for (number, given) in given.iter().enumerate() {
            let field = format!("inertial_samples[{number}]");
            let sample = self.sample(given).map_err(|error| error.within(&field))?;
            let last = samples.last();
            if last.is_some_and(|last| last.time_ns >= sample.time_ns) {
                let problem = "must be later than that of the sample before";
                return Err(Error::invalid(format!("{field}.timestamp_ns"), problem));
            }
            samples.push(sample);
        }

        let known_ns = self.last.map(|last| last.time_ns);
        samples.retain(|sample| known_ns.is_none_or(|known_ns| sample.time_ns > known_ns));
        for sample in samples {
            let at_camera = self.mount.at_camera(&sample, self.last.as_ref());
            self.buffer.push(at_camera);
            self.last = Some(sample);
        }
        Ok(())
    }

    fn sample(&self, given: &pb::InertialSample) -> Result<InertialSample, Error> {
        let vector = |field: &str, given: Option<pb::Vector3>, most: f64| {
            let given = given.ok_or_else(|| Error::invalid(field, "is required"))?;
            let vector = Vector3::new(given.x, given.y, given.z);
            let is_usable = vector.iter().all(|value| value.abs() <= most);
            let problem = || Error::invalid(field, format!("must be finite and at most {most}"));
            is_usable.then_some(vector).ok_or_else(problem)
        };
        Ok(InertialSample {
            time_ns: given.timestamp_ns.saturating_add(self.offset_ns),
            angular_rate: vector("angular_velocity", given.angular_velocity, FASTEST)?,
            specific_force: vector("linear_acceleration", given.linear_acceleration, STRONGEST)?,
        })
    }

    /// The middle of the exposure of a frame.
    ///
    /// # Errors
    /// [`Error::Invalid`] for an exposure that is too long.
    pub fn middle_ns(&self, frame: &pb::TrackFrame) -> Result<i64, Error> {
        middle_ns(frame, self.image_offset_ns)
    }

    /// The motion from the last accepted frame to one at this time.
    pub fn motion_to(&self, middle_ns: i64) -> Option<MeasuredInertia> {
        let motion = self
            .buffer
            .between(self.last_frame_ns?, middle_ns, self.noise)?;
        Some(MeasuredInertia {
            motion,
            down_in_parent: self.down_in_map,
        })
    }

    /// Notes that the frame at this time was accepted.
    pub fn accept(&mut self, middle_ns: i64) {
        self.last_frame_ns = Some(middle_ns);
        self.buffer.forget_before(middle_ns);
    }

    /// Forgets the last frame: the next motion is not measured.
    pub fn reset(&mut self) {
        self.last_frame_ns = None;
    }
}

/// The noise of a sensor.
///
/// # Errors
/// [`Error::Invalid`] on a number out of range.
fn noise(given: &pb::InertialSensor) -> Result<InertialNoise, Error> {
    let InertialNoise {
        density,
        bias,
        bias_walk,
    } = InertialNoise::TYPICAL;
    let of = |sensor: usize,
              field: &str,
              given: Option<f64>,
              usual: [f64; 2],
              range: &std::ops::RangeInclusive<f64>| {
        let factor = [1.0, 10.0][sensor];
        let range = range.start() * factor..=range.end() * factor;
        within(field, given.unwrap_or(usual[sensor]), range)
    };
    Ok(InertialNoise {
        density: [
            of(
                0,
                "gyroscope_noise",
                given.gyroscope_noise,
                density,
                &NOISES,
            )?,
            of(
                1,
                "accelerometer_noise",
                given.accelerometer_noise,
                density,
                &NOISES,
            )?,
        ],
        bias: [
            of(
                0,
                "gyroscope_bias_deviation",
                given.gyroscope_bias_deviation,
                bias,
                &NOISES,
            )?,
            of(
                1,
                "accelerometer_bias_deviation",
                given.accelerometer_bias_deviation,
                bias,
                &NOISES,
            )?,
        ],
        bias_walk: [
            of(
                0,
                "gyroscope_bias_walk",
                given.gyroscope_bias_walk,
                bias_walk,
                &WALKS,
            )?,
            of(
                1,
                "accelerometer_bias_walk",
                given.accelerometer_bias_walk,
                bias_walk,
                &WALKS,
            )?,
        ],
    })
}

/// # Errors
/// [`Error::Invalid`] for an exposure that is too long.
pub fn check_exposure(frame: &pb::TrackFrame) -> Result<(), Error> {
    if frame.exposure_ns > LONGEST_EXPOSURE_NS {
        let problem = format!("must be at most {LONGEST_EXPOSURE_NS}");
        return Err(Error::invalid("exposure_ns", problem));
    }
    Ok(())
}

/// The middle of the exposure of a frame, nanoseconds; `offset_ns` is that of the images.
///
/// # Errors
/// [`Error::Invalid`] for an exposure that is too long.
fn middle_ns(frame: &pb::TrackFrame, offset_ns: i64) -> Result<i64, Error> {
    check_exposure(frame)?;
    let half_ns = (frame.exposure_ns / 2) as i64;
    let begins_ns = frame.timestamp_ns.saturating_add(offset_ns);
    Ok(begins_ns.saturating_add(half_ns))
}

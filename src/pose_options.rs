//! Options for the pose convention of a recording.

use clap::{Args, ValueEnum};
use seese3_core::geometry::Pose;
use seese3_data::pose_check::{Axes, Convention, Direction, QuaternionOrder};

/// Pose convention of the files.
#[derive(Debug, Clone, Args)]
pub struct PoseOptions {
    /// Camera axes of the poses
    #[arg(long, value_enum, default_value_t = AxesName::Opencv)]
    convention: AxesName,
    /// Quaternion order in the files; `wxyz` if a scalar-last format was written scalar-first
    #[arg(long, value_enum, default_value_t = QuaternionName::AsTheFormat)]
    quaternions: QuaternionName,
    /// Clockwise rotation of the images relative to the camera of the poses, degrees
    #[arg(long, value_name = "DEGREES", default_value_t = 0, value_parser = quarter_turns)]
    images_turned: u16,
    /// Factor that converts all translations to meters: 0.001 for millimeters
    #[arg(long, value_name = "FACTOR", value_parser = scale)]
    scale: Option<f64>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum AxesName {
    /// x right, y down, z forward
    Opencv,
    /// x right, y up, z backward; also Blender, NeRF and ARKit
    Opengl,
    /// x forward, y left, z up
    Ros,
}

/// The option `--poses` of most formats.
#[derive(Debug, Clone, Args)]
pub struct DirectionOption {
    /// Transform that the poses represent, after the conversions that the format itself defines
    #[arg(long = "poses", value_enum, default_value_t = DirectionName::WorldFromCamera)]
    pub direction: DirectionName,
}

/// Transform that a pose represents, by its name on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum)]
#[value(rename_all = "snake_case")]
pub enum DirectionName {
    /// Camera to world: the translation is the camera's position
    #[default]
    WorldFromCamera,
    /// World to camera: the inverse
    CameraFromWorld,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum QuaternionName {
    /// As the format defines
    AsTheFormat,
    /// Scalar first
    Wxyz,
}

fn quarter_turns(text: &str) -> Result<u16, String> {
    match text.parse() {
        Ok(degrees @ (0 | 90 | 180 | 270)) => Ok(degrees),
        _ => Err("must be 0, 90, 180 or 270".to_owned()),
    }
}

fn scale(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(factor) if factor.is_finite() && factor > 0.0 => Ok(factor),
        _ => Err("must be a number above 0".to_owned()),
    }
}

impl PoseOptions {
    /// The convention that the options select.
    pub fn convention(&self, direction: DirectionName) -> Convention {
        Convention {
            axes: match self.convention {
                AxesName::Opencv => Axes::OpenCv,
                AxesName::Opengl => Axes::OpenGl,
                AxesName::Ros => Axes::Ros,
            },
            direction: match direction {
                DirectionName::WorldFromCamera => Direction::WorldFromCamera,
                DirectionName::CameraFromWorld => Direction::CameraFromWorld,
            },
            image_quarter_turns: (self.images_turned / 90) as u8,
            quaternions: match self.quaternions {
                QuaternionName::AsTheFormat => QuaternionOrder::Stated,
                QuaternionName::Wxyz => QuaternionOrder::ScalarFirst,
            },
        }
    }

    /// Whether --scale was omitted.
    pub fn has_no_scale(&self) -> bool {
        self.scale.is_none()
    }

    /// The poses with translations in meters, still in their original convention.
    pub fn scaled(&self, poses: &[Pose]) -> Vec<Pose> {
        let scaled = poses.iter().map(|pose| {
            let mut pose = *pose;
            pose.translation.vector *= self.scale.unwrap_or(1.0);
            pose
        });
        scaled.collect()
    }
}

/// The command-line options that select a convention.
pub fn flags_of(convention: Convention) -> String {
    let axes = match convention.axes {
        Axes::OpenCv => "opencv",
        Axes::OpenGl => "opengl",
        Axes::Ros => "ros",
    };
    let direction = match convention.direction {
        Direction::WorldFromCamera => "world_from_camera",
        Direction::CameraFromWorld => "camera_from_world",
    };

    let mut flags = Vec::new();
    let usual = Convention::default();
    if convention.axes != usual.axes {
        flags.push(format!("--convention {axes}"));
    }
    if convention.direction != usual.direction {
        flags.push(format!("--poses {direction}"));
    }
    if convention.quaternions == QuaternionOrder::ScalarFirst {
        flags.push("--quaternions wxyz".to_owned());
    }
    if convention.image_quarter_turns > 0 {
        let degrees = 90 * u16::from(convention.image_quarter_turns);
        flags.push(format!("--images-turned {degrees}"));
    }
    if flags.is_empty() {
        flags.push("without options on poses".to_owned());
    }

    flags.join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Debug, Parser)]
    struct Command {
        #[command(flatten)]
        options: PoseOptions,
        #[command(flatten)]
        direction: DirectionOption,
    }

    /// Oracle: the messages: the suggested options select the described convention.
    #[test]
    fn what_is_advised_is_understood() {
        for convention in Convention::all() {
            let flags = flags_of(convention);
            let words = flags.split(' ').filter(|_| flags.starts_with("--"));
            let command = Command::try_parse_from(["import"].into_iter().chain(words)).unwrap();
            let understood = command.options.convention(command.direction.direction);
            assert_eq!(understood, convention, "{flags}");
        }
    }
}

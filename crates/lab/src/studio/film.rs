//! Recordings of drawn rooms: the poses of a camera, and the image at each.

use nalgebra::Isometry3;

use super::photograph::{Shot, photograph};
use super::render::{Camera, Sampling, radiance};
use super::solid::Solid;
use super::{FRAMES_PER_SECOND, Scene, SuiteRoom, render, visits};
use seese3_core::geometry::{Pinhole, PinholeError, PixelCamera, Pose};
use seese3_core::image::RgbImage;

/// A suite of rooms: how they look, and how the camera moves in them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Suite {
    /// Rooms that a person films twice with a camera in the hand, in other light: photographs with
    /// blur, noise and an exposure of their own, objects that were moved, passers-by.
    Visits,
    /// Plain images of one calm walk each, which hardly covers what its last fifth sees: the hard
    /// class.
    Walks,
}

impl Suite {
    /// All suites.
    pub const ALL: [Self; 2] = [Self::Visits, Self::Walks];

    /// The name of the suite.
    pub fn name(self) -> &'static str {
        match self {
            Self::Visits => "visits",
            Self::Walks => "walks",
        }
    }

    /// The recording of room `number` of the suite of `seed`. Adding rooms changes none of the
    /// others.
    pub fn film(self, seed: u64, number: u32, frame_count: usize) -> Film {
        match self {
            Self::Visits => visits::film(seed, number, frame_count),
            Self::Walks => {
                let room = SuiteRoom::new(seed, number);
                let poses = room.path(frame_count);

                Film {
                    kind: room.walk.name(),
                    field_of_view_rad: Camera::small().field_of_view_rad,
                    poses,
                    visits: Vec::new(),
                    scenes: vec![room.scene],
                }
            }
        }
    }
}

/// A recording of one room, of one visit or of several, one after the other.
#[derive(Debug, Clone)]
pub struct Film {
    /// How the room is filmed: a part of it, all of it, a corridor.
    pub kind: &'static str,
    /// Angle of view of the camera across the width, radians; its pixels are square.
    pub field_of_view_rad: f64,
    /// `world_from_camera`, metres, at 30 frames per second.
    pub poses: Vec<Pose>,
    /// The room as it is in each visit.
    pub(super) scenes: Vec<Scene>,
    /// How each visit is filmed, or empty for plain images.
    pub(super) visits: Vec<Visit>,
}

/// How a visit is filmed.
#[derive(Debug, Clone)]
pub(super) struct Visit {
    /// The first frame of the visit.
    pub begin: usize,
    /// Share of the time between two frames in which the shutter is open.
    pub shutter: f64,
    /// What every shot of the visit has in common.
    pub shot: Shot,
    /// Somebody who walks by.
    pub passer_by: Option<PasserBy>,
}

/// Somebody who walks along a line while some frames of a visit are taken.
#[derive(Debug, Clone)]
pub(super) struct PasserBy {
    /// The body where the line begins.
    pub body: Vec<Solid>,
    /// Metres per frame.
    pub step: nalgebra::Vector3<f64>,
    /// The frames that see the person.
    pub frames: std::ops::Range<usize>,
}

impl Film {
    /// The number of the visit that each frame belongs to, or nothing if there is one visit.
    pub fn sequences(&self) -> Vec<u32> {
        if self.visits.is_empty() {
            return Vec::new();
        }

        (0..self.poses.len())
            .map(|frame| self.visit_of(frame) as u32)
            .collect()
    }

    /// When each frame was taken, nanoseconds, or nothing for a plain walk. An hour passes between
    /// two visits.
    pub fn timestamps_ns(&self) -> Vec<i64> {
        if self.visits.is_empty() {
            return Vec::new();
        }

        (0..self.poses.len())
            .map(|frame| {
                let seconds =
                    frame as f64 / FRAMES_PER_SECOND + 3_600.0 * self.visit_of(frame) as f64;
                (seconds * 1e9).round() as i64
            })
            .collect()
    }

    /// The camera that takes images of this size.
    ///
    /// # Errors
    /// [`PinholeError`] for an image that is far higher than it is wide.
    pub fn camera(&self, width: usize, height: usize) -> Result<Pinhole, PinholeError> {
        let width = width as f64;

        Pinhole::new(PixelCamera {
            width,
            height: height as f64,
            focal: 0.5 * width / (self.field_of_view_rad / 2.0).tan(),
            centre: None,
        })
    }

    /// The image of a frame.
    pub fn image(&self, frame: usize, width: usize, height: usize) -> RgbImage {
        let camera = Camera {
            field_of_view_rad: self.field_of_view_rad,
            ..Camera::sized(width, height)
        };
        let visit = self.visit_of(frame);
        let scene = &self.scenes[visit];
        let pose = &self.poses[frame];
        let Some(visit) = self.visits.get(visit) else {
            return render(scene, camera, pose);
        };

        let others = visit
            .passer_by
            .as_ref()
            .map_or_else(Vec::new, |person| person.at(frame));

        // A photograph is softer and noisier than a plain image, and needs fewer rays.
        let camera = Camera {
            sampling: Sampling::Quincunx,
            ..camera
        };
        let radiance = radiance(scene, &others, camera, pose, f64::INFINITY);
        let shot = Shot {
            motion: self.motion_of(frame, visit),
            seed: visit.shot.seed.wrapping_add(frame as u32),
            ..visit.shot.clone()
        };

        photograph(&radiance, camera, &shot)
    }

    fn visit_of(&self, frame: usize) -> usize {
        self.visits
            .iter()
            .filter(|visit| visit.begin <= frame)
            .count()
            .saturating_sub(1)
    }

    /// The camera's motion while the shutter is open, by its motion from the frame before; none for
    /// the first frame of a visit.
    fn motion_of(&self, frame: usize, visit: &Visit) -> Isometry3<f64> {
        let Some(before) = frame.checked_sub(1).filter(|&before| before >= visit.begin) else {
            return Isometry3::identity();
        };
        let step = self.poses[before].inv_mul(&self.poses[frame]);

        Isometry3::identity().lerp_slerp(&step, visit.shutter)
    }
}

impl PasserBy {
    fn at(&self, frame: usize) -> Vec<Solid> {
        if !self.frames.contains(&frame) {
            return Vec::new();
        }

        let way = self.step * (frame - self.frames.start) as f64;
        self.body
            .iter()
            .map(|solid| Solid {
                centre: solid.centre + way,
                ..*solid
            })
            .collect()
    }
}

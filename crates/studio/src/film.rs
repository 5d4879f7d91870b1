//! Recordings of drawn rooms: the poses of a camera, and the image at each.

use nalgebra::Isometry3;

use super::photograph::{Shot, photograph};
use super::render::{Camera, Sampling, radiance};
use super::solid::Solid;
use super::{FRAMES_PER_SECOND, Light, Scene, render};
use seese3_core::geometry::{Pinhole, PinholeError, PixelCamera, Pose};
use seese3_core::image::RgbImage;

/// The field of view of a camera where it does not vary: the middle of the others.
pub(super) const FIELD_OF_VIEW_RAD: f64 = 67.5 * std::f64::consts::PI / 180.0;

/// What makes drawn photographs as different from one another as real ones are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Variation {
    /// Day, dusk or night, and lamps of different colours, another for each visit.
    Light,
    /// An exposure and a white balance for each visit.
    Exposure,
    /// Motion blur, noise, and corners that are darker than the middle.
    Lens,
    /// A field of view for each room.
    FieldOfView,
    /// Things that were moved between visits, and passers-by.
    Clutter,
    /// Fine detail of all surfaces.
    Detail,
}

impl Variation {
    /// All variations.
    pub const ALL: [Self; 6] = [
        Self::Light,
        Self::Exposure,
        Self::Lens,
        Self::FieldOfView,
        Self::Clutter,
        Self::Detail,
    ];

    /// The name of the variation.
    pub fn name(self) -> &'static str {
        match self {
            Self::Light => "light",
            Self::Exposure => "exposure",
            Self::Lens => "lens",
            Self::FieldOfView => "field-of-view",
            Self::Clutter => "clutter",
            Self::Detail => "detail",
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

    /// The same recording, in which one thing no longer varies. The poses stay as they are. A plain
    /// walk has no variations.
    pub fn without(mut self, variation: Variation) -> Self {
        if self.visits.is_empty() {
            return self;
        }

        match variation {
            Variation::Light => {
                for scene in &mut self.scenes {
                    scene.light = Light::PLAIN;
                }
            }
            Variation::Exposure => {
                for Visit { shot, .. } in &mut self.visits {
                    shot.exposure = 1.0;
                    shot.white = [1.0; 3];
                }
            }
            Variation::Lens => {
                for visit in &mut self.visits {
                    visit.shutter = 0.0;
                    visit.shot.vignette = 0.0;
                    visit.shot.noise = [0.0; 2];
                }
            }
            Variation::FieldOfView => self.field_of_view_rad = FIELD_OF_VIEW_RAD,
            Variation::Clutter => {
                let (first, later) = self.scenes.split_at_mut(1);
                for (scene, first) in later.iter_mut().zip(first.iter().cycle()) {
                    scene.solids.clone_from(&first.solids);
                    scene.shade_lamp();
                }
                for visit in &mut self.visits {
                    visit.passer_by = None;
                }
            }
            Variation::Detail => {
                for scene in &mut self.scenes {
                    scene.detail = 0.0;
                }
            }
        }
        self
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Suite;

    /// Oracle: the definition of each variation: without it the image is another one and the poses
    /// are the same, and leaving it out twice changes nothing more.
    #[test]
    fn a_variation_that_is_left_out_changes_the_images_alone() {
        // A room that has a passer-by in its second visit.
        let whole = (0..40)
            .map(|number| Suite::Visits.film(5, number, 60))
            .find(|film| film.visits[1].passer_by.is_some())
            .unwrap();
        let frame = whole.visits[1].passer_by.as_ref().unwrap().frames.start;
        let images = |film: &Film| [frame, 59].map(|frame| film.image(frame, 64, 48).bytes);

        for variation in Variation::ALL {
            let without = whole.clone().without(variation);
            assert_eq!(without.poses, whole.poses, "{variation:?}");
            let name = variation.name();
            assert_ne!(images(&without), images(&whole), "{name} changes nothing");

            let twice = without.clone().without(variation);
            assert_eq!(images(&twice), images(&without), "{name}");
        }

        let walk = Suite::Walks.film(5, 0, 10);
        let without = walk.clone().without(Variation::Light);
        assert_eq!(walk.image(3, 64, 48), without.image(3, 64, 48));
    }
}

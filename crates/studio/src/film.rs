//! Recordings of synthetic rooms: camera poses, and an image at each pose.

use nalgebra::Isometry3;
use strum::{Display, EnumMessage, EnumString, IntoStaticStr, VariantArray};

use super::photograph::{Shot, photograph};
use super::render::{Camera, Sampling, radiance};
use super::solid::Solid;
use super::{FRAMES_PER_SECOND, Light, Scene, render};
use seese3_core::geometry::{CameraError, CameraIntrinsics, Distortion, PixelCamera, Pose};
use seese3_core::image::RgbImage;

/// Field of view of a camera without variation: the middle of the range of 55° to 80°.
pub(super) const FIELD_OF_VIEW_RAD: f64 = 67.5 * std::f64::consts::PI / 180.0;

/// Variations that make synthetic photographs differ like real ones: of the field of view per room,
/// of light, exposure and objects per visit.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, EnumMessage, EnumString, VariantArray, Display, IntoStaticStr,
)]
#[strum(serialize_all = "kebab-case")]
pub enum Variation {
    /// Day, dusk or night, and the color of lamps.
    Light,
    /// Exposure and white balance.
    Exposure,
    /// Motion blur, noise and vignetting.
    Lens,
    /// The camera's field of view.
    FieldOfView,
    /// Moved objects, and passers-by.
    Clutter,
    /// Fine detail of all surfaces.
    Detail,
}

/// A recording of one room, with one or more visits in sequence.
#[derive(Debug, Clone)]
pub struct Film {
    /// Type of the tour, for instance a part of a room, a whole room or a corridor.
    pub kind: &'static str,
    /// Horizontal field of view of the camera, radians; its pixels are square.
    pub field_of_view_rad: f64,
    /// `world_from_camera`, meters, at 30 frames per second.
    pub poses: Vec<Pose>,
    /// The room during each visit.
    pub(super) scenes: Vec<Scene>,
    /// Camera settings of each visit; empty for plain images.
    pub(super) visits: Vec<Visit>,
}

/// Camera settings of a visit.
#[derive(Debug, Clone)]
pub(super) struct Visit {
    /// The first frame of the visit.
    pub begin: usize,
    /// Exposure time, as a fraction of the frame period.
    pub shutter: f64,
    /// Settings shared by all shots of the visit.
    pub shot: Shot,
    /// A person who walks by.
    pub passer_by: Option<PasserBy>,
}

/// A person who walks along a line during some frames of a visit.
#[derive(Debug, Clone)]
pub(super) struct PasserBy {
    /// The body at the start of the line.
    pub body: Vec<Solid>,
    /// Displacement per frame, meters.
    pub step: nalgebra::Vector3<f64>,
    /// The frames during which the person is in the room.
    pub frames: std::ops::Range<usize>,
}

impl Film {
    /// The visit number of each frame; empty for a plain walk.
    pub fn sequences(&self) -> Vec<u32> {
        if self.visits.is_empty() {
            return Vec::new();
        }

        (0..self.poses.len())
            .map(|frame| self.visit_of(frame) as u32)
            .collect()
    }

    /// The timestamp of each frame, nanoseconds; empty for a plain walk. Visits are
    /// an hour apart.
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

    /// The same recording without one variation. The poses do not change. A plain walk has no
    /// variations and is returned unchanged.
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

    /// The camera for images of this size.
    ///
    /// # Errors
    /// [`CameraError`] for an image that is much taller than wide.
    pub fn camera(&self, width: usize, height: usize) -> Result<CameraIntrinsics, CameraError> {
        let width = width as f64;
        let focal = 0.5 * width / (self.field_of_view_rad / 2.0).tan();

        CameraIntrinsics::new(PixelCamera {
            width,
            height: height as f64,
            focal: [focal, focal].into(),
            center: None,
            distortion: Distortion::None,
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

        // A photograph is softer and noisier than a plain image, so fewer rays are enough.
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

    /// Camera motion while the shutter is open, interpolated from the motion since the previous
    /// frame; identity for the first frame of a visit.
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
                center: solid.center + way,
                ..*solid
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Suite;

    /// Oracle: the definition of a variation. Removing it changes the images but not the poses, and
    /// removing it twice has no further effect.
    #[test]
    fn a_variation_that_is_left_out_changes_the_images_alone() {
        // A room with a passer-by in its second visit.
        let whole = (0..40)
            .map(|number| Suite::Visits.film(5, number, 60))
            .find(|film| film.visits[1].passer_by.is_some())
            .unwrap();
        let frame = whole.visits[1].passer_by.as_ref().unwrap().frames.start;
        let images = |film: &Film| [frame, 59].map(|frame| film.image(frame, 64, 48).bytes);

        for &variation in Variation::VARIANTS {
            let without = whole.clone().without(variation);
            assert_eq!(without.poses, whole.poses, "{variation:?}");
            assert_ne!(
                images(&without),
                images(&whole),
                "{variation} changes nothing"
            );

            let twice = without.clone().without(variation);
            assert_eq!(images(&twice), images(&without), "{variation}");
        }

        let walk = Suite::Walks.film(5, 0, 10);
        let without = walk.clone().without(Variation::Light);
        assert_eq!(walk.image(3, 64, 48), without.image(3, 64, 48));
    }
}

//! The keypoints of a mapped room, with their inverse depths.

use nalgebra::{Point3, Vector2, Vector3};
use rayon::prelude::*;

use super::Error;
use super::absolute_pose::MapNoise;
use super::descriptors::{COMPRESSED, DescriptorBasis, matched_keypoints};
use super::parameters::MappingParameters;
use super::triangulation::{PosedKeypoints, pixel_focal, triangulate};
use seese3_core::epipolar::{EpipolarPairs, angle_between_axes};
use seese3_core::geometry::{CameraIntrinsics, Pose};
use seese3_core::keypoints::Keypoints;
use seese3_core::statistics::quantile;

/// The unit that mapping starts from, in median distances of the cameras from their mean.
const FIRST_UNIT: f64 = 1.5;
/// Rounds of triangulation that find the unit, and the number of frames of each.
const UNIT_ROUNDS: usize = 3;
const UNIT_FRAMES: usize = 15;
/// Minimum number of triangulated keypoints from which a unit is computed.
const MIN_UNIT_KEYPOINTS: usize = 20;

/// Median epipolar error of a map in which too few frames overlap to measure it, pixels.
const DEFAULT_EPIPOLAR_PX: f64 = 1.0;

/// Minimum cosine of the descriptors of a match whose epipolar error is measured, and the number of
/// keypoints of a frame that are matched.
const EPIPOLAR_MIN_COSINE: f32 = 0.8;
const EPIPOLAR_CANDIDATES: usize = 500;

/// The triangulated keypoints of one mapped frame.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct MappedKeypoints {
    /// Positions, fractions of the image's width and height from its top left corner.
    pub points: Vec<Vector2<f32>>,
    /// 1 / z in the camera frame, per meter.
    pub inverse_depths: Vec<f32>,
    /// Relative standard deviations of the inverse depths, at a deviation of 1 pixel.
    pub deviations: Vec<f32>,
    /// Compressed descriptors, [`COMPRESSED`] bytes each.
    pub descriptors: Vec<i8>,
}

impl MappedKeypoints {
    /// Approximate memory use, bytes.
    pub fn memory_bytes(&self) -> usize {
        let Self {
            points,
            inverse_depths,
            deviations,
            descriptors,
        } = self;
        size_of_val(points.as_slice())
            + size_of_val(inverse_depths.as_slice())
            + size_of_val(deviations.as_slice())
            + descriptors.len()
    }

    /// The number of keypoints.
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// Whether the frame has no triangulated keypoint.
    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// Positions in the camera frame, meters.
    pub(super) fn in_camera(&self, camera: &CameraIntrinsics) -> Vec<Vector3<f64>> {
        (0..self.len())
            .map(|place| self.point(place, camera))
            .collect()
    }

    /// Position of the keypoint at `place` in the camera frame, meters.
    pub fn point(&self, place: usize, camera: &CameraIntrinsics) -> Vector3<f64> {
        let point = self.points[place];
        let in_widths = Vector2::new(f64::from(point.x), f64::from(point.y) * camera.height());
        camera.to_image_plane(in_widths).push(1.0) / f64::from(self.inverse_depths[place])
    }
}

/// The keypoints of a mapped room.
#[derive(Debug, Clone)]
pub struct KeypointMap {
    /// The camera of all mapped frames.
    pub camera: CameraIntrinsics,
    /// Median depth of the keypoints, meters.
    pub unit_m: f64,
    /// Median distance of matched keypoints from their epipolar lines, pixels; measures the noise
    /// of the map's poses and of its camera.
    pub epipolar_px: f64,
    /// Noise, from which covariances follow.
    pub noise: MapNoise,
    /// Compression of the descriptors.
    pub basis: DescriptorBasis,
    /// Keypoints of each mapped frame, in the order of the frames.
    pub frames: Vec<MappedKeypoints>,
}

impl KeypointMap {
    /// Appends the frames of another map of the same camera and encoder. Their descriptors are
    /// compressed by the basis of this map; noise and unit stay those of this map.
    ///
    /// # Errors
    /// [`Error::OtherDescriptors`] if the descriptors have another width.
    pub fn append(&mut self, added: &Self) -> Result<(), Error> {
        let [known, other] = [self, added].map(|map| map.basis.width());
        if known != other {
            return Err(Error::OtherDescriptors {
                known,
                added: other,
            });
        }

        let mut appended = added.frames.clone();
        if self.basis != added.basis {
            for frame in &mut appended {
                frame.descriptors = self.basis.compress_again(&frame.descriptors, &added.basis);
            }
        }
        self.frames.extend(appended);
        Ok(())
    }
}

/// Triangulates the keypoints of a room's frames, frame by frame.
pub struct Mapping<'a> {
    pub(super) frames: Vec<PosedKeypoints<'a>>,
    camera: CameraIntrinsics,
    basis: DescriptorBasis,
    unit_m: f64,
    epipolar_px: f64,
    parameters: MappingParameters,
}

impl<'a> Mapping<'a> {
    /// Prepares the mapping of frames with the given poses, `world_from_camera`, and keypoints.
    ///
    /// # Errors
    /// [`Error::NoDescriptors`] if no frame has a keypoint.
    ///
    /// # Panics
    /// If there are not as many poses as frames of keypoints.
    pub fn new(
        poses: &[Pose],
        keypoints: &'a [Keypoints],
        camera: CameraIntrinsics,
        parameters: MappingParameters,
    ) -> Result<Self, Error> {
        assert_eq!(poses.len(), keypoints.len());
        let basis = DescriptorBasis::of(keypoints.iter()).ok_or(Error::NoDescriptors)?;
        let frames: Vec<PosedKeypoints<'_>> = poses
            .iter()
            .zip(keypoints)
            .map(|(pose, keypoints)| {
                PosedKeypoints::new(*pose, keypoints, &camera, parameters.candidates)
            })
            .collect();

        let mut mapping = Self {
            unit_m: first_unit(poses),
            epipolar_px: DEFAULT_EPIPOLAR_PX,
            frames,
            camera,
            basis,
            parameters,
        };
        if mapping.has_no_neighbors() {
            mapping.unit_m = nearest_unit(poses, &parameters).unwrap_or(mapping.unit_m);
        }
        mapping.find_unit();
        let pairs = epipolar_pairs(poses, keypoints, camera.height(), mapping.unit_m);
        mapping.epipolar_px = pairs.median_px(&camera).unwrap_or(DEFAULT_EPIPOLAR_PX);
        Ok(mapping)
    }

    /// Number of frames.
    pub fn frame_count(&self) -> usize {
        self.frames.len()
    }

    /// The keypoints of the frame in `row`, triangulated from the neighbors that `is_used` keeps.
    pub(super) fn map_frame(&self, row: usize, is_used: &dyn Fn(usize) -> bool) -> MappedKeypoints {
        let frame = &self.frames[row];
        let compressed = self.basis.compress(frame.keypoints);
        let mut mapped = MappedKeypoints::default();
        let triangulated = self.triangulated(row, is_used);
        for point in triangulated.iter().take(self.parameters.max_keypoints) {
            mapped.points.push(frame.keypoints.points()[point.place]);
            mapped.inverse_depths.push(point.inverse_depth as f32);
            mapped.deviations.push(point.deviation as f32);
            mapped
                .descriptors
                .extend(&compressed[point.place * COMPRESSED..][..COMPRESSED]);
        }

        mapped
    }

    /// Maps all frames, on the threads of the calling rayon pool. `done` is called after each
    /// frame.
    pub fn map(&self, done: &(dyn Fn() + Sync)) -> KeypointMap {
        let frames = (0..self.frames.len())
            .into_par_iter()
            .map(|row| {
                let frame = self.map_frame(row, &|_| true);
                done();
                frame
            })
            .collect();

        KeypointMap {
            camera: self.camera,
            unit_m: self.unit_m,
            epipolar_px: self.epipolar_px,
            noise: MapNoise::TYPICAL,
            basis: self.basis.clone(),
            frames,
        }
    }

    fn triangulated(
        &self,
        row: usize,
        is_used: &dyn Fn(usize) -> bool,
    ) -> Vec<super::triangulation::Triangulated> {
        let neighbors: Vec<&PosedKeypoints<'_>> = self
            .neighbors(row, is_used)
            .into_iter()
            .map(|row| &self.frames[row])
            .collect();
        triangulate(
            &self.frames[row],
            &neighbors,
            pixel_focal(&self.camera),
            self.unit_m,
            &self.parameters,
        )
    }

    /// Whether no frame has a neighbor.
    fn has_no_neighbors(&self) -> bool {
        (0..self.frames.len()).all(|row| self.neighbors(row, &|_| true).is_empty())
    }

    /// Sets the unit to the median depth of the keypoints of some frames.
    fn find_unit(&mut self) {
        let every = (self.frames.len() / UNIT_FRAMES).max(1);
        for _ in 0..UNIT_ROUNDS {
            let rows = (0..self.frames.len()).step_by(every);
            let depths: Vec<f64> = rows
                .flat_map(|row| self.triangulated(row, &|_| true))
                .map(|point| point.inverse_depth.recip())
                .collect();
            if depths.len() < MIN_UNIT_KEYPOINTS {
                return;
            }
            if let Some(median) = quantile(&depths, 0.5) {
                self.unit_m = median;
            }
        }
    }

    /// Frames near the one in `row` that see the same scene from another place, the best first,
    /// among those that `is_used` keeps.
    fn neighbors(&self, row: usize, is_used: &dyn Fn(usize) -> bool) -> Vec<usize> {
        let MappingParameters {
            neighbors,
            baseline_range: [least, most],
            ideal_baseline,
            max_angle_rad,
            angle_scale_rad,
            ..
        } = self.parameters;
        let pose = &self.frames[row].pose;
        let distance =
            |a: &Pose, b: &Pose| (a.translation.vector - b.translation.vector).norm() / self.unit_m;

        let mut near: Vec<(f64, usize)> = self
            .frames
            .iter()
            .enumerate()
            .filter(|&(other, _)| is_used(other))
            .filter_map(|(other, frame)| {
                let baseline = distance(&frame.pose, pose);
                if baseline <= least || baseline >= most {
                    return None;
                }
                let angle = angle_between_axes(&frame.pose, pose);
                let score = (baseline / ideal_baseline).ln().abs() + angle / angle_scale_rad;
                (angle < max_angle_rad).then_some((score, other))
            })
            .collect();
        near.sort_by(|a, b| a.0.total_cmp(&b.0));

        // Neighbors in one place would see every point from one direction.
        let mut chosen: Vec<usize> = Vec::with_capacity(neighbors);
        for (_, other) in near {
            let apart = |&chosen: &usize| {
                distance(&self.frames[chosen].pose, &self.frames[other].pose) > least
            };
            if chosen.iter().all(apart) {
                chosen.push(other);
            }
            if chosen.len() == neighbors {
                break;
            }
        }

        chosen
    }
}

/// The unit from the spread of the cameras alone, meters.
fn first_unit(poses: &[Pose]) -> f64 {
    let mean = poses
        .iter()
        .fold(Vector3::zeros(), |sum, pose| sum + pose.translation.vector)
        / poses.len().max(1) as f64;
    let distances: Vec<f64> = poses
        .iter()
        .map(|pose| (pose * Point3::origin() - Point3::from(mean)).norm())
        .collect();
    let median = quantile(&distances, 0.5).unwrap_or(1.0);
    if median > 0.0 {
        FIRST_UNIT * median
    } else {
        1.0
    }
}

/// The unit in which the median distance of a camera to the nearest other one is the ideal
/// baseline, meters; `None` if all cameras are in one place.
///
/// A few frames are farther apart than the largest baseline in their first unit: two frames that
/// are b apart have a first unit of 0.75 b. In this unit they are neighbors if their depth allows
/// it.
fn nearest_unit(poses: &[Pose], parameters: &MappingParameters) -> Option<f64> {
    let nearest: Vec<f64> = poses
        .iter()
        .filter_map(|pose| {
            poses
                .iter()
                .map(|other| (other.translation.vector - pose.translation.vector).norm())
                .filter(|&distance| distance > 0.0)
                .min_by(f64::total_cmp)
        })
        .collect();
    quantile(&nearest, 0.5).map(|median| median / parameters.ideal_baseline)
}

/// Matched keypoints of nearby frames. `height` is that of the images, in image widths; `unit_m`
/// about the median depth of the scene, meters.
pub fn epipolar_pairs(
    poses: &[Pose],
    keypoints: &[Keypoints],
    height: f64,
    unit_m: f64,
) -> EpipolarPairs {
    EpipolarPairs::of(poses, unit_m, |first, second| {
        matched_points(&keypoints[first], &keypoints[second], height)
    })
}

/// Image points, image widths, of the mutual matches of two frames.
fn matched_points(first: &Keypoints, second: &Keypoints, height: f64) -> Vec<[Vector2<f64>; 2]> {
    let point = |keypoints: &Keypoints, place: usize| {
        let point = keypoints.points()[place];
        Vector2::new(f64::from(point.x), f64::from(point.y) * height)
    };
    matched_keypoints(first, second, EPIPOLAR_CANDIDATES, EPIPOLAR_MIN_COSINE)
        .into_iter()
        .map(|(i, j)| [point(first, i), point(second, j)])
        .collect()
}

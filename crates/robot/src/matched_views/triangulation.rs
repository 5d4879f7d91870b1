//! Triangulates the keypoints of a mapped frame from its matches in neighboring mapped frames.

use nalgebra::{Matrix3, Vector2, Vector3};

use super::parameters::MappingParameters;
use seese3_core::epipolar::PIXEL_IMAGE_WIDTH;
use seese3_core::geometry::{CameraIntrinsics, Pose};
use seese3_core::keypoints::Keypoints;

/// Number of inverse depths at which the search starts.
const DEPTHS: usize = 40;
/// Range of the searched inverse depths, times the unit.
const INVERSE_DEPTHS: [f64; 2] = [0.08, 8.0];
/// Gauss–Newton steps on an inverse depth.
const STEPS: usize = 5;
/// Largest change of an inverse depth in one step, relative.
const LARGEST_STEP: f64 = 0.3;
/// Scale of the robust loss of a reprojection error, pixels.
const LOSS_SCALE_PX: f64 = 2.0;

/// A mapped frame whose keypoints can be matched.
#[derive(Debug, Clone)]
pub(super) struct PosedKeypoints<'a> {
    /// `world_from_camera`.
    pub pose: Pose,
    pub keypoints: &'a Keypoints,
    /// Keypoints on the plane at depth 1, undistorted.
    pub plane: Vec<Vector2<f64>>,
    descriptors: Vec<&'a [i8]>,
}

impl<'a> PosedKeypoints<'a> {
    /// The first `count` keypoints of a frame.
    pub fn new(
        pose: Pose,
        keypoints: &'a Keypoints,
        camera: &CameraIntrinsics,
        count: usize,
    ) -> Self {
        Self {
            pose,
            keypoints,
            plane: plane_points(keypoints, camera, count),
            descriptors: keypoints.descriptors().take(count).collect(),
        }
    }
}

/// Undistorted positions of the first `count` keypoints on the plane at depth 1.
pub(crate) fn plane_points(
    keypoints: &Keypoints,
    camera: &CameraIntrinsics,
    count: usize,
) -> Vec<Vector2<f64>> {
    let points = keypoints.points().iter().take(count);
    points
        .map(|point| {
            let in_widths = Vector2::new(f64::from(point.x), f64::from(point.y) * camera.height());
            camera.to_image_plane(in_widths)
        })
        .collect()
}

/// Pixels per unit length on the plane at depth 1.
pub(crate) fn pixel_focal(camera: &CameraIntrinsics) -> f64 {
    camera.focal().mean() * PIXEL_IMAGE_WIDTH
}

/// A triangulated keypoint.
#[derive(Debug, Clone, Copy)]
pub(super) struct Triangulated {
    /// Place among the keypoints of the frame.
    pub place: usize,
    /// 1 / z in the camera frame, per meter.
    pub inverse_depth: f64,
    /// Relative standard deviation of the inverse depth, at a deviation of 1 pixel.
    pub deviation: f64,
}

/// Relation of a frame to a neighbor.
struct View<'a> {
    /// Directions of the frame's keypoints, turned into the neighbor's axes.
    directions: Vec<Vector3<f64>>,
    /// Position of the frame's camera in the neighbor's frame.
    shift: Vector3<f64>,
    /// For each keypoint of the frame, its match.
    matches: Vec<Option<&'a Vector2<f64>>>,
}

/// Inverse depths of a frame's keypoints, in descending order of their scores.
pub(super) fn triangulate(
    frame: &PosedKeypoints<'_>,
    neighbors: &[&PosedKeypoints<'_>],
    focal_px: f64,
    unit_m: f64,
    parameters: &MappingParameters,
) -> Vec<Triangulated> {
    let views: Vec<View<'_>> = neighbors
        .iter()
        .map(|neighbor| View::of(frame, neighbor, focal_px, parameters))
        .collect();

    (0..frame.plane.len())
        .filter_map(|place| {
            let seen: Vec<NeighborMatch> = views
                .iter()
                .filter_map(|view| {
                    let point = view.matches[place]?;
                    Some(NeighborMatch {
                        direction: view.directions[place],
                        shift: view.shift,
                        point: *point,
                    })
                })
                .collect();
            let (inverse_depth, deviation) = depth(&seen, focal_px, unit_m, parameters)?;
            Some(Triangulated {
                place,
                inverse_depth,
                deviation,
            })
        })
        .collect()
}

/// A match in one neighbor.
struct NeighborMatch {
    direction: Vector3<f64>,
    shift: Vector3<f64>,
    point: Vector2<f64>,
}

impl NeighborMatch {
    /// Reprojection error in pixels, its derivative by the inverse depth, and the depth in the
    /// neighbor in units of the depth in the frame.
    fn error(&self, inverse_depth: f64, focal_px: f64) -> (Vector2<f64>, Vector2<f64>, f64) {
        let ray = self.direction + self.shift * inverse_depth;
        let z = if ray.z.abs() < 1e-6 { 1e-6 } else { ray.z };
        let projected = ray.xy() / z;
        let slope = (self.shift.xy() - projected * self.shift.z) / z;
        ((self.point - projected) * focal_px, slope * focal_px, ray.z)
    }
}

/// The inverse depth with the smallest robust reprojection error, and its relative deviation;
/// `None` if no neighbor agrees or the deviation is too large.
fn depth(
    seen: &[NeighborMatch],
    focal_px: f64,
    unit_m: f64,
    parameters: &MappingParameters,
) -> Option<(f64, f64)> {
    if seen.is_empty() {
        return None;
    }

    // A coarse search first: the error may have several minima.
    let gate = (2.0 * parameters.epipolar_gate_px).powi(2);
    let [least, most] = INVERSE_DEPTHS;
    let ratio = (most / least).powf(1.0 / (DEPTHS - 1) as f64);
    let cost = |inverse_depth: f64| -> f64 {
        let of = |match_: &NeighborMatch| {
            let (error, _, z) = match_.error(inverse_depth, focal_px);
            if z > 1e-3 {
                error.norm_squared().min(gate)
            } else {
                gate
            }
        };
        seen.iter().map(of).sum()
    };
    let candidates = (0..DEPTHS).map(|step| least * ratio.powi(step as i32) / unit_m);
    let mut inverse_depth = candidates
        .map(|candidate| (cost(candidate), candidate))
        .min_by(|a, b| a.0.total_cmp(&b.0))?
        .1;

    for _ in 0..STEPS {
        let mut curvature = 0.0;
        let mut gradient = 0.0;
        for match_ in seen {
            let (error, slope, _) = match_.error(inverse_depth, focal_px);
            let squared = error.norm_squared();
            if squared < gate {
                let weight = (1.0 + squared / LOSS_SCALE_PX.powi(2)).powi(-2);
                curvature += weight * slope.norm_squared();
                gradient += weight * slope.dot(&error);
            }
        }
        if curvature <= 0.0 {
            break;
        }

        let step = gradient / curvature / inverse_depth;
        inverse_depth *= step.clamp(-LARGEST_STEP, LARGEST_STEP).exp();
    }

    // Only matches that agree with the depth determine its deviation.
    let mut curvature = 0.0;
    for match_ in seen {
        let (error, slope, z) = match_.error(inverse_depth, focal_px);
        if error.norm() < parameters.epipolar_gate_px && z > 0.0 {
            curvature += slope.norm_squared();
        }
    }
    if curvature <= 0.0 {
        return None;
    }

    let deviation = curvature.sqrt().recip() / inverse_depth;
    (deviation < parameters.max_deviation).then_some((inverse_depth, deviation))
}

impl<'a> View<'a> {
    fn of(
        frame: &PosedKeypoints<'_>,
        neighbor: &'a PosedKeypoints<'_>,
        focal_px: f64,
        parameters: &MappingParameters,
    ) -> Self {
        let neighbor_from_frame = neighbor.pose.inv_mul(&frame.pose);
        let rotation = neighbor_from_frame.rotation.to_rotation_matrix();
        let shift = neighbor_from_frame.translation.vector;

        let directions: Vec<Vector3<f64>> = frame
            .plane
            .iter()
            .map(|point| rotation * point.push(1.0))
            .collect();
        let lines = epipolar_lines(&directions, shift);

        // The best match of each keypoint within its epipolar band, in both directions.
        let mut best_in_neighbor: Vec<Option<(usize, i32)>> = vec![None; frame.plane.len()];
        let mut best_in_frame: Vec<Option<(usize, i32)>> = vec![None; neighbor.plane.len()];
        let gate = parameters.epipolar_gate_px / focal_px;
        let mut distances = vec![0.0; neighbor.plane.len()];
        for (place, line) in lines.iter().enumerate() {
            for (distance, point) in distances.iter_mut().zip(&neighbor.plane) {
                *distance = (line.x * point.x + line.y * point.y + line.z).abs();
            }
            let descriptor = frame.descriptors[place];
            for (other, _) in distances.iter().enumerate().filter(|(_, at)| **at < gate) {
                let similarity = dot(descriptor, neighbor.descriptors[other]);
                let better =
                    |best: Option<(usize, i32)>| best.is_none_or(|(_, of)| similarity > of);
                if better(best_in_neighbor[place]) {
                    best_in_neighbor[place] = Some((other, similarity));
                }
                if better(best_in_frame[other]) {
                    best_in_frame[other] = Some((place, similarity));
                }
            }
        }

        let matches = best_in_neighbor
            .iter()
            .enumerate()
            .map(|(place, best)| {
                let (other, similarity) = (*best)?;
                let is_mutual = best_in_frame[other].is_some_and(|(back, _)| back == place);
                let a = frame.descriptors[place];
                let b = neighbor.descriptors[other];
                let lengths = (dot(a, a) as f32 * dot(b, b) as f32).sqrt();
                let is_similar = similarity as f32 > parameters.min_cosine * lengths;
                (is_mutual && is_similar).then(|| &neighbor.plane[other])
            })
            .collect();

        Self {
            directions,
            shift,
            matches,
        }
    }
}

/// Epipolar lines in the neighbor, scaled so that line · (x, y, 1) is a distance on the plane at
/// depth 1.
fn epipolar_lines(directions: &[Vector3<f64>], shift: Vector3<f64>) -> Vec<Vector3<f64>> {
    let cross = Matrix3::new(
        0.0, -shift.z, shift.y, shift.z, 0.0, -shift.x, -shift.y, shift.x, 0.0,
    );
    directions
        .iter()
        .map(|direction| {
            let line = cross * direction;
            line / (line.xy().norm() + 1e-12)
        })
        .collect()
}

fn dot(a: &[i8], b: &[i8]) -> i32 {
    a.iter()
        .zip(b)
        .map(|(&a, &b)| i32::from(i16::from(a) * i16::from(b)))
        .sum()
}

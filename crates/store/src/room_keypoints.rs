//! The keypoints of a room, and their file.
//!
//! The file has one entry per keypoint, frame after frame. A keypoint takes 39 bytes, so 300 of them
//! take 11.7 kB.

use std::sync::Arc;

use ndarray::{Array1, Array2};
use serde::{Deserialize, Serialize};

use super::Error;
use super::manifest::ObjectRef;
use super::tensors::{TensorReader, TensorWriter};
use seese3_core::geometry::CameraIntrinsics;
use seese3_core::keypoints::KeypointSource;
use seese3_core::nalgebra::Vector2;
use seese3_robot::matched_views::{
    COMPRESSED, DescriptorBasis, KeypointMap, MapNoise, MappedKeypoints,
};

/// Number of steps of a position over the width or the height of an image.
const POSITION_STEPS: f32 = u16::MAX as f32;
/// Largest inverse depth that can be stored, in inverse units.
const MOST_INVERSE_DEPTH: f64 = 16.0;
/// Largest relative deviation that can be stored.
const MOST_DEVIATION: f32 = 0.255;

/// The keypoints of a room's frames and where they come from.
#[derive(Debug, Clone)]
pub struct RoomKeypoints {
    /// The encoder and its outputs.
    pub source: KeypointSource,
    /// The keypoints of each frame; an added frame may have none.
    pub map: Arc<KeypointMap>,
}

/// The keypoints of a room in its manifest. The object has the tensors
///
/// - `counts` (n,) i64: number of keypoints of each frame;
/// - `positions` (k, 2) u16: fractions of the image's width and height, times 65535;
/// - `inverse_depths` (k,) u16: 1 / z in the camera frame times the unit, times 65535 / 16;
/// - `deviations` (k,) u8: relative deviations of the inverse depths, times 1000;
/// - `descriptors` (k, 32) i8: compressed descriptors times 200;
/// - `basis.mean` (d,) and `basis.axes` (d, 32) f32: a descriptor is compressed by subtracting the
///   mean, multiplying by the axes and scaling to unit length.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct KeypointsEntry {
    pub source: KeypointSource,
    /// The camera of all frames.
    pub camera: CameraIntrinsics,
    /// Median depth of the keypoints, meters.
    pub unit_m: f64,
    /// Median epipolar error of the map, pixels of an image 320 wide.
    pub epipolar_px: f64,
    /// Noise of the map, from which covariances follow.
    pub noise: MapNoise,
    pub object: ObjectRef,
}

impl KeypointsEntry {
    pub fn new(keypoints: &RoomKeypoints, object: ObjectRef) -> Self {
        let map = &keypoints.map;
        Self {
            source: keypoints.source.clone(),
            camera: map.camera,
            unit_m: map.unit_m,
            epipolar_px: map.epipolar_px,
            noise: map.noise,
            object,
        }
    }
}

/// Serializes the keypoints of a room.
pub fn keypoints_file(map: &KeypointMap) -> Result<Vec<u8>, Error> {
    let frames = || map.frames.iter();
    let count: usize = frames().map(MappedKeypoints::len).sum();
    let mut tensors = TensorWriter::default();

    let counts = frames().map(|frame| frame.len() as i64);
    tensors.i64("counts", &[map.frames.len()], counts);

    let positions = frames().flat_map(|frame| &frame.points);
    let positions = positions.flat_map(|point| {
        [point.x, point.y].map(|fraction| (fraction * POSITION_STEPS).round() as u16)
    });
    tensors.u16("positions", &[count, 2], positions);

    let scale = f64::from(u16::MAX) / MOST_INVERSE_DEPTH * map.unit_m;
    let inverse_depths = frames().flat_map(|frame| &frame.inverse_depths);
    let inverse_depths =
        inverse_depths.map(|&depth| (f64::from(depth) * scale).round().max(1.0) as u16);
    tensors.u16("inverse_depths", &[count], inverse_depths);

    let deviations = frames().flat_map(|frame| &frame.deviations);
    let steps = f32::from(u8::MAX) / MOST_DEVIATION;
    let deviations = deviations.map(|&deviation| (deviation * steps).round().max(1.0) as u8);
    tensors.u8("deviations", &[count], deviations);

    let descriptors = frames().flat_map(|frame| &frame.descriptors).copied();
    tensors.i8("descriptors", &[count, COMPRESSED], descriptors);

    let mean = map.basis.mean();
    tensors.f32("basis.mean", &[mean.len()], mean.iter().copied());
    let axes = map.basis.axes();
    tensors.f32(
        "basis.axes",
        &[axes.nrows(), axes.ncols()],
        axes.iter().copied(),
    );

    tensors.finish("keypoints")
}

/// Reads the keypoints of a room of `frame_count` frames.
pub fn read_keypoints(
    file: &str,
    bytes: &[u8],
    entry: KeypointsEntry,
    frame_count: usize,
) -> Result<RoomKeypoints, Error> {
    let damaged = |problem: String| Error::Damaged {
        file: file.to_owned(),
        problem: problem.into(),
    };

    entry.check().map_err(damaged)?;
    let tensors = TensorReader::new(file, bytes)?;
    let columns = Columns::read(&tensors)?;
    columns.check(frame_count).map_err(damaged)?;

    let mean = Array1::from_iter(tensors.f32("basis.mean")?.iter().copied());
    let basis = DescriptorBasis::from_parts(mean, tensors.f32("basis.axes")?)
        .ok_or_else(|| damaged("has a descriptor basis of a wrong shape".to_owned()))?;

    let map = KeypointMap {
        camera: entry.camera,
        unit_m: entry.unit_m,
        epipolar_px: entry.epipolar_px,
        noise: entry.noise,
        basis,
        frames: columns.frames(entry.unit_m),
    };
    Ok(RoomKeypoints {
        source: entry.source,
        map: Arc::new(map),
    })
}

impl KeypointsEntry {
    /// Checks that the numbers are those of a map.
    fn check(&self) -> Result<(), String> {
        let MapNoise {
            translation_m,
            rotation_rad,
            design_effect,
            gap_scale,
        } = self.noise;
        let numbers = [
            self.unit_m,
            self.epipolar_px,
            translation_m,
            rotation_rad,
            design_effect,
            gap_scale,
        ];

        let is_positive = |value: &f64| value.is_finite() && *value > 0.0;
        if numbers.iter().all(is_positive) {
            Ok(())
        } else {
            Err(format!(
                "unit, epipolar error and noise of the map must be above 0, but are {numbers:?}"
            ))
        }
    }
}

/// The tensors with one entry per frame or per keypoint.
struct Columns {
    counts: Array2<i64>,
    positions: Array2<u16>,
    inverse_depths: Array2<u16>,
    deviations: Array2<u8>,
    descriptors: Array2<i8>,
}

impl Columns {
    fn read(tensors: &TensorReader<'_>) -> Result<Self, Error> {
        Ok(Self {
            counts: tensors.i64("counts")?,
            positions: tensors.u16("positions")?,
            inverse_depths: tensors.u16("inverse_depths")?,
            deviations: tensors.u8("deviations")?,
            descriptors: tensors.i8("descriptors")?,
        })
    }

    /// Checks the shapes against each other: tensors of the right types may still contradict.
    fn check(&self, frame_count: usize) -> Result<(), String> {
        let count = self.positions.nrows();
        let total: Option<i64> = self
            .counts
            .iter()
            .try_fold(0_i64, |sum, &n| sum.checked_add(n).filter(|_| n >= 0));
        let is_consistent = self.counts.len() == frame_count
            && total == Some(count as i64)
            && self.positions.ncols() == 2
            && self.inverse_depths.len() == count
            && self.deviations.len() == count
            && self.descriptors.dim() == (count, COMPRESSED);

        if is_consistent {
            Ok(())
        } else {
            Err(format!(
                "has keypoints of {} frames whose tensors contradict each other; the room has {frame_count} frames",
                self.counts.len()
            ))
        }
    }

    /// The keypoints of each frame. `unit_m` is the median depth, meters.
    fn frames(&self, unit_m: f64) -> Vec<MappedKeypoints> {
        let scale = MOST_INVERSE_DEPTH / f64::from(u16::MAX) / unit_m;
        let inverse_depths: Vec<f32> = self
            .inverse_depths
            .iter()
            .map(|&n| (f64::from(n.max(1)) * scale) as f32)
            .collect();
        let steps = f32::from(u8::MAX) / MOST_DEVIATION;
        let deviations: Vec<f32> = self
            .deviations
            .iter()
            .map(|&n| f32::from(n.max(1)) / steps)
            .collect();
        let points: Vec<Vector2<f32>> = self
            .positions
            .outer_iter()
            .map(|row| Vector2::new(f32::from(row[0]), f32::from(row[1])) / POSITION_STEPS)
            .collect();

        let mut frames = Vec::with_capacity(self.counts.len());
        let mut from = 0;
        for &n in &self.counts {
            let rows = from..from + n as usize;
            from = rows.end;
            let descriptors = self.descriptors.slice(ndarray::s![rows.clone(), ..]);
            frames.push(MappedKeypoints {
                points: points[rows.clone()].to_vec(),
                inverse_depths: inverse_depths[rows.clone()].to_vec(),
                deviations: deviations[rows].to_vec(),
                descriptors: descriptors.iter().copied().collect(),
            });
        }

        frames
    }
}

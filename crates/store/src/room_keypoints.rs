//! The keypoints of a room, and their file.
//!
//! The file has one entry per keypoint, frame after frame. A keypoint takes 39 bytes, so 300 of
//! them take 11.7 kB.

use std::sync::Arc;

use ndarray::{Array1, Array2};
use serde::{Deserialize, Serialize};

use super::Error;
use super::manifest::ObjectRef;
use super::tensors::{TensorReader, TensorWriter};
use seese3_core::geometry::CameraIntrinsics;
use seese3_core::keypoints::{KeypointSource, MAX_KEYPOINTS};
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
/// Largest number of a [`KeypointsHeader`]; its reciprocal is the smallest.
const LARGEST: f64 = 1e12;

/// The keypoints of a room's frames and where they come from.
#[derive(Debug, Clone)]
pub struct RoomKeypoints {
    /// The encoder and its outputs.
    pub source: KeypointSource,
    /// The keypoints of each frame; an added frame may have none.
    pub map: Arc<KeypointMap>,
}

/// What the file of a room's keypoints does not contain: their source and the numbers of their map.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct KeypointsHeader {
    /// The encoder and its outputs.
    pub source: KeypointSource,
    /// The camera of all frames.
    pub camera: CameraIntrinsics,
    /// Median depth of the keypoints, meters.
    pub unit_m: f64,
    /// Median epipolar error of the map, pixels of an image 320 wide.
    pub epipolar_px: f64,
    /// Noise of the map, from which covariances follow.
    pub noise: MapNoise,
}

/// A number of a [`KeypointsHeader`] that no map has.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{field} must be above 0 and at most {LARGEST:e}, but is {value}")]
pub struct HeaderError {
    /// The field, named as in [`KeypointsHeader`] or in [`MapNoise`].
    pub field: &'static str,
    /// Its value.
    pub value: f64,
}

impl KeypointsHeader {
    /// Checks that depths and covariances computed with these numbers are finite.
    ///
    /// # Errors
    /// [`HeaderError`] for the first number that is not above 0, or too large.
    pub fn check(&self) -> Result<(), HeaderError> {
        let MapNoise {
            design_effect,
            gap_scale,
            pose_noise,
            relative_error,
        } = self.noise;

        let numbers = [
            ("unit_m", self.unit_m),
            ("epipolar_px", self.epipolar_px),
            ("design_effect", design_effect),
            ("gap_scale", gap_scale),
            ("pose_noise", pose_noise),
            ("relative_error", relative_error),
        ];
        let is_wrong = |(_, value): &(_, f64)| !(LARGEST.recip()..=LARGEST).contains(value);
        match numbers.into_iter().find(is_wrong) {
            Some((field, value)) => Err(HeaderError { field, value }),
            None => Ok(()),
        }
    }
}

impl RoomKeypoints {
    /// Everything but the keypoints themselves.
    pub fn header(&self) -> KeypointsHeader {
        let map = &self.map;
        KeypointsHeader {
            source: self.source.clone(),
            camera: map.camera,
            unit_m: map.unit_m,
            epipolar_px: map.epipolar_px,
            noise: map.noise,
        }
    }

    /// The keypoints as the file of the store, safetensors:
    ///
    /// - `counts` (n,) i64: number of keypoints of each frame, at most [`MAX_KEYPOINTS`];
    /// - `positions` (k, 2) u16: fractions of the image's width and height, times 65535;
    /// - `inverse_depths` (k,) u16: 1 / z in the camera frame times the unit, times 65535 / 16;
    /// - `deviations` (k,) u8: relative deviations of the inverse depths, times 1000;
    /// - `descriptors` (k, 32) i8: compressed descriptors times 200;
    /// - `basis.mean` (d,) and `basis.axes` (d, 32) f32: a descriptor is compressed by subtracting
    ///   the mean, multiplying by the axes and scaling to unit length.
    ///
    /// # Errors
    /// [`Error::Damaged`] if the tensors cannot be serialized.
    pub fn to_bytes(&self) -> Result<Vec<u8>, Error> {
        keypoints_file(&self.map)
    }

    /// Keypoints of `frame_count` frames from the bytes of [`RoomKeypoints::to_bytes`]. The bytes
    /// may come from anywhere.
    ///
    /// # Errors
    /// [`Error::Damaged`] if a number of the header or the bytes cannot be those of a map.
    pub fn from_bytes(
        header: KeypointsHeader,
        bytes: &[u8],
        frame_count: usize,
    ) -> Result<Self, Error> {
        read_keypoints("keypoints", bytes, header, frame_count)
    }
}

/// The keypoints of a room in its manifest. The object is that of [`RoomKeypoints::to_bytes`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct KeypointsEntry {
    #[serde(flatten)]
    pub header: KeypointsHeader,
    pub object: ObjectRef,
}

/// Serializes the keypoints of a room.
fn keypoints_file(map: &KeypointMap) -> Result<Vec<u8>, Error> {
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
    header: KeypointsHeader,
    frame_count: usize,
) -> Result<RoomKeypoints, Error> {
    let damaged = |problem: String| Error::Damaged {
        file: file.to_owned(),
        problem: problem.into(),
    };

    header.check().map_err(|error| damaged(error.to_string()))?;
    let tensors = TensorReader::new(file, bytes)?;
    let columns = Columns::read(&tensors)?;
    columns.check(frame_count).map_err(damaged)?;

    let mean = Array1::from_iter(tensors.f32("basis.mean")?.iter().copied());
    let basis = DescriptorBasis::from_parts(mean, tensors.f32("basis.axes")?).ok_or_else(|| {
        damaged(
            "has a descriptor basis of a wrong shape, of over 1024 numbers, or not finite"
                .to_owned(),
        )
    })?;

    let map = KeypointMap {
        camera: header.camera,
        unit_m: header.unit_m,
        epipolar_px: header.epipolar_px,
        noise: header.noise,
        basis,
        frames: columns.frames(header.unit_m),
    };
    Ok(RoomKeypoints {
        source: header.source,
        map: Arc::new(map),
    })
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

        if !is_consistent {
            return Err(format!(
                "has keypoints of {} frames whose tensors contradict each other; the room has {frame_count} frames",
                self.counts.len()
            ));
        }
        match self.counts.iter().max() {
            Some(&most) if most > MAX_KEYPOINTS as i64 => Err(format!(
                "has {most} keypoints in one frame; at most {MAX_KEYPOINTS} are possible"
            )),
            _ => Ok(()),
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

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a failed step is a failed test")]
mod tests {
    use super::*;

    /// Tensors of two frames with one and two keypoints.
    #[derive(Clone)]
    struct Parts {
        counts: Vec<i64>,
        positions: Vec<[u16; 2]>,
        inverse_depths: Vec<u16>,
        deviations: Vec<u8>,
        descriptors: Vec<i8>,
        mean: Vec<f32>,
        axes: Vec<f32>,
    }

    fn parts() -> Parts {
        Parts {
            counts: vec![1, 2],
            positions: vec![[1, 2], [3, 4], [5, 6]],
            inverse_depths: vec![10, 20, 30],
            deviations: vec![7, 8, 9],
            descriptors: vec![1; 3 * COMPRESSED],
            mean: vec![0.5; 4],
            axes: vec![0.1; 4 * COMPRESSED],
        }
    }

    impl Parts {
        fn file(self) -> Vec<u8> {
            let mut tensors = TensorWriter::default();
            let count = self.positions.len();
            tensors.i64("counts", &[self.counts.len()], self.counts.into_iter());
            tensors.u16(
                "positions",
                &[count, 2],
                self.positions.into_iter().flatten(),
            );
            let [depths, deviations] = [self.inverse_depths.len(), self.deviations.len()];
            tensors.u16("inverse_depths", &[depths], self.inverse_depths.into_iter());
            tensors.u8("deviations", &[deviations], self.deviations.into_iter());
            let rows = self.descriptors.len() / COMPRESSED;
            tensors.i8(
                "descriptors",
                &[rows, COMPRESSED],
                self.descriptors.into_iter(),
            );
            tensors.f32("basis.mean", &[self.mean.len()], self.mean.into_iter());
            let rows = self.axes.len() / COMPRESSED;
            tensors.f32("basis.axes", &[rows, COMPRESSED], self.axes.into_iter());
            tensors.finish("keypoints").unwrap()
        }
    }

    fn header() -> KeypointsHeader {
        serde_json::from_value(serde_json::json!({
            "source": {
                "feature": seese3_core::features::FeatureSource::imported("f", 0),
                "positions": "a", "reliability": "b", "descriptors": "c", "model_file": "m.onnx",
            },
            "camera": {
                "focal": [1.0, 1.0], "height": 0.75, "center": [0.5, 0.375],
                "distortion": { "model": "none" },
            },
            "unit_m": 2.0, "epipolar_px": 0.5,
            "noise": {
                "design_effect": 2.0, "gap_scale": 0.1, "pose_noise": 0.1, "relative_error": 0.1,
            },
        }))
        .unwrap()
    }

    #[track_caller]
    fn refused(result: Result<RoomKeypoints, Error>, word: &str) {
        let error = result.unwrap_err();
        assert!(matches!(error, Error::Damaged { .. }), "{error}");
        let message = error.to_string();
        let cause = std::error::Error::source(&error).map(ToString::to_string);
        let text = format!("{message}: {}", cause.unwrap_or_default());
        assert!(
            text.contains("k.safetensors") && text.contains(word),
            "{text}"
        );
    }

    /// Oracle: the format, worked by hand. 65535 positions span the image, an inverse depth has
    /// 65535 / 16 steps in an inverse unit of 2 m, a deviation steps of 0.001.
    #[test]
    fn tensors_are_read_by_the_format() {
        let read = read_keypoints("k.safetensors", &parts().file(), header(), 2).unwrap();
        let [first, second] = read.map.frames.as_slice() else {
            panic!("two frames")
        };
        assert_eq!([first.len(), second.len()], [1, 2]);
        assert_eq!(first.points[0], Vector2::new(1.0, 2.0) / 65_535.0);
        assert_eq!(second.points[1], Vector2::new(5.0, 6.0) / 65_535.0);
        let expected = 30.0 * 16.0 / 65_535.0 / 2.0;
        assert!((f64::from(second.inverse_depths[1]) - expected).abs() < 1e-9);
        assert!((second.deviations[1] - 0.009).abs() < 1e-7);
    }

    /// Oracle: the definition of the tensors; each case contradicts it in one place.
    #[test]
    fn tensors_that_contradict_each_other_are_refused() {
        let changed = |change: &dyn Fn(&mut Parts)| {
            let mut parts = parts();
            change(&mut parts);
            read_keypoints("k.safetensors", &parts.file(), header(), 2)
        };
        let word = "contradict";
        refused(changed(&|parts| parts.counts = vec![1, 3]), word);
        refused(changed(&|parts| parts.counts = vec![4, -1]), word);
        refused(
            changed(&|parts| parts.counts = vec![i64::MAX, i64::MAX]),
            word,
        );
        refused(changed(&|parts| parts.counts = vec![3]), word);
        refused(changed(&|parts| parts.counts = vec![1, 2, 0]), word);
        refused(changed(&|parts| parts.positions.truncate(2)), word);
        refused(changed(&|parts| parts.inverse_depths.push(1)), word);
        refused(changed(&|parts| parts.deviations.truncate(1)), word);
        refused(
            changed(&|parts| parts.descriptors.truncate(COMPRESSED)),
            word,
        );

        let of_one_frame = |count: usize| {
            changed(&|parts| {
                parts.counts = vec![count as i64, 0];
                parts.positions = vec![[1, 2]; count];
                parts.inverse_depths = vec![10; count];
                parts.deviations = vec![7; count];
                parts.descriptors = vec![1; count * COMPRESSED];
            })
        };
        assert!(of_one_frame(600).is_ok());
        refused(of_one_frame(601), "601 keypoints in one frame");

        let word = "basis";
        refused(changed(&|parts| parts.mean.push(1.0)), word);
        refused(changed(&|parts| parts.mean[0] = f32::NAN), word);
        refused(changed(&|parts| parts.axes[0] = f32::INFINITY), word);
        refused(
            changed(&|parts| (parts.mean, parts.axes) = (vec![], vec![])),
            word,
        );
    }

    /// Oracle: the definition. A unit or a noise of 0 or less gives depths and covariances that are
    /// not finite.
    #[test]
    fn numbers_of_the_manifest_that_are_not_positive_are_refused() {
        let file = parts().file();
        for bad in [0.0, -1.0, 1e-13, 1e13, f64::NAN, f64::INFINITY] {
            for change in [
                (|header, bad| header.unit_m = bad) as fn(&mut KeypointsHeader, f64),
                |header, bad| header.epipolar_px = bad,
                |header, bad| header.noise.pose_noise = bad,
                |header, bad| header.noise.relative_error = bad,
                |header, bad| header.noise.design_effect = bad,
                |header, bad| header.noise.gap_scale = bad,
            ] {
                let mut header = header();
                change(&mut header, bad);
                refused(read_keypoints("k.safetensors", &file, header, 2), "above 0");
            }
        }
    }

    /// Oracle: the format of the file; a tensor that is absent is named.
    #[test]
    fn a_file_without_a_tensor_is_refused_by_its_name() {
        let mut tensors = TensorWriter::default();
        tensors.i64("counts", &[2], [0, 0].into_iter());
        let file = tensors.finish("keypoints").unwrap();
        refused(
            read_keypoints("k.safetensors", &file, header(), 2),
            "'positions'",
        );
        refused(
            read_keypoints("k.safetensors", b"nonsense", header(), 2),
            "",
        );
    }
}

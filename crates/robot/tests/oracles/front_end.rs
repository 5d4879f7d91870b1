//! The front end of image streams, with the filter: what a stream without a map tells.

use nalgebra::Point3;
use seese3_core::geometry::{CameraIntrinsics, Pose, PoseError};
use seese3_core::keypoints::Keypoints;
use seese3_robot::front_end::{FrontEnd, ImageReading, RoomCandidate, StreamCamera, StreamImage};
use seese3_robot::localization::KeypointRoom;
use seese3_robot::matched_views::{Mapping, MappingParameters};
use seese3_robot::pose_filter::{
    FilterParameters, FilterRoom, FilterState, PoseFilter, ViewObservation,
};
use seese3_robot::tracking::MotionPrior;
use seese3_robot::visual_odometry::{KnownDepth, OdometryParameters};
use seese3_testing::keypoint_scene::{Random, Scene, SceneView, camera_path, distorted_camera};

/// Frame period, nanoseconds.
const PERIOD_NS: i64 = 33_333_333;

/// A stream of a camera in a scene of 600 points, without a map.
struct Stream {
    truth: Vec<Pose>,
    views: Vec<SceneView>,
    scene: Scene,
    camera: CameraIntrinsics,
    front_end: FrontEnd,
    filter: PoseFilter,
    state: FilterState,
    /// `odom_from_camera` of the frames so far.
    odom: Vec<Pose>,
}

impl Stream {
    fn new() -> Self {
        let scene = Scene::in_box(600, 1);
        let camera = distorted_camera();
        let truth = camera_path(150);
        let mut random = Random::new(3);
        let view = |pose| scene.view(pose, &camera, 0.3, &mut random);
        let room = FilterRoom {
            motion_prior: MotionPrior::assumed(),
            extent_m: 3.0,
        };
        let filter = PoseFilter::new(vec![room], FilterParameters::default()).unwrap();
        Self {
            views: truth.iter().map(view).collect(),
            truth,
            scene,
            camera,
            front_end: FrontEnd::new(
                StreamCamera::Stated(camera),
                Some(OdometryParameters::default()),
            ),
            state: filter.start(None),
            filter,
            odom: Vec::new(),
        }
    }

    /// Reads the next frame. A depth camera states the depths of all its keypoints.
    fn read(&mut self, has_depths: bool) -> ImageReading {
        let row = self.odom.len();
        let view = &self.views[row];
        let pose = &self.truth[row];
        let depth = |(keypoint, &point): (usize, &usize)| KnownDepth {
            keypoint,
            depth_m: pose
                .inverse_transform_point(&Point3::from(self.scene.points[point]))
                .z,
            deviation: 0.01,
        };
        let depths: Vec<KnownDepth> = match has_depths {
            true => view.shown.iter().enumerate().map(depth).collect(),
            false => Vec::new(),
        };
        let image = StreamImage {
            time_ns: row as i64 * PERIOD_NS,
            keypoints: &view.keypoints,
            height: self.camera.height(),
            fingerprint: Some(row as u64),
            predicted: None,
            predicted_motion: None,
            depths: &depths,
        };
        let read = self.front_end.read(&image, &[]);
        let observed =
            read.clone()
                .observation(row as i64 * PERIOD_NS, row as u64 + 1, Some(row as u64));
        self.observe(&observed);
        read
    }

    /// The next frame has no image.
    fn skip(&mut self) {
        let row = self.odom.len();
        self.front_end.skip(row as i64 * PERIOD_NS);
        self.observe(&ViewObservation::empty(
            row as i64 * PERIOD_NS,
            row as u64 + 1,
        ));
    }

    fn observe(&mut self, observed: &ViewObservation) {
        let before = self.state.odom.pose;
        let update = self.filter.observe(&mut self.state, observed).unwrap();
        self.front_end
            .assume(&before.inv_mul(&self.state.odom.pose));
        self.odom.push(update.odom.pose);
    }

    /// Position error of the motion between two frames, meters, and its true length.
    fn error_m(&self, from: usize, to: usize) -> [f64; 2] {
        let truth = self.truth[from].inv_mul(&self.truth[to]);
        let found = self.odom[from].inv_mul(&self.odom[to]);
        let length = truth.translation.vector.norm();
        [PoseError::between(&found, &truth).translation_m, length]
    }
}

/// Oracle: the true lengths. Without depths they are those of the usual depth of rooms, which is
/// not that of this scene.
#[test]
fn depths_of_a_sensor_set_the_scale() {
    let [with, without] = [true, false].map(|has_depths| {
        let mut stream = Stream::new();
        for _ in 0..60 {
            stream.read(has_depths);
        }
        let [error_m, length_m] = stream.error_m(5, 59);
        error_m / length_m
    });
    assert!(with < 0.02, "{with}");
    assert!(without > 0.1, "{without}");
}

/// Oracle: the true path. After three frames without an image the local map is found again, and
/// corrects what was assumed meanwhile. After twelve it begins anew, with an image that tells no
/// motion.
#[test]
fn a_local_map_outlives_a_short_gap() {
    let mut stream = Stream::new();
    for _ in 0..40 {
        stream.read(true);
    }
    for _ in 0..3 {
        stream.skip();
    }
    let [assumed_m, _] = stream.error_m(39, 42);
    assert!(stream.read(false).motion.is_some());
    stream.read(false);
    let [error_m, _] = stream.error_m(39, 44);
    println!("{assumed_m} {error_m}");
    assert!(error_m < 0.005, "{error_m}");

    for _ in 0..12 {
        stream.skip();
    }
    assert!(stream.read(false).motion.is_none());
    assert!(stream.read(false).motion.is_some());
}

/// Oracle: the true motions. A depth camera states ten times the depths: where the view is located,
/// the map has them, and the lengths are right; without the map they are wrong.
#[test]
fn the_depths_of_a_located_view_are_those_of_the_map() {
    let stream = Stream::new();
    let keypoints: Vec<Keypoints> = stream
        .views
        .iter()
        .map(|view| view.keypoints.clone())
        .collect();
    let mapping = Mapping::new(
        &stream.truth,
        &keypoints,
        stream.camera,
        MappingParameters::default(),
    )
    .unwrap();
    let room = KeypointRoom::new(stream.truth.clone(), mapping.map(&|| ()).into());
    let candidate = RoomCandidate {
        index: 0,
        room: &room,
        frames: None,
    };

    let [mapped, unmapped] = [&[candidate][..], &[]].map(|rooms| {
        let odometry = Some(OdometryParameters::default());
        let mut front_end = FrontEnd::new(StreamCamera::Stated(stream.camera), odometry);
        let mut lengths_m = [0.0, 0.0];
        for (row, seen) in keypoints.iter().enumerate().take(30) {
            let wrong = |keypoint| KnownDepth {
                keypoint,
                depth_m: 40.0,
                deviation: 0.01,
            };
            let depths: Vec<KnownDepth> = (0..seen.len()).map(wrong).collect();
            let image = StreamImage {
                time_ns: row as i64 * PERIOD_NS,
                keypoints: seen,
                height: stream.camera.height(),
                fingerprint: Some(row as u64),
                predicted: None,
                predicted_motion: None,
                depths: &depths,
            };
            let read = front_end.read(&image, rooms);
            assert_eq!(read.matched.is_some(), !rooms.is_empty());
            if let Some(found) = read.motion {
                let truth = stream.truth[row - 1].inv_mul(&stream.truth[row]);
                lengths_m[0] += found.motion.translation.vector.norm();
                lengths_m[1] += truth.translation.vector.norm();
            }
        }
        lengths_m[0] / lengths_m[1]
    });
    assert!((mapped - 1.0).abs() < 0.05, "{mapped}");
    assert!(unmapped > 3.0, "{unmapped}");
}

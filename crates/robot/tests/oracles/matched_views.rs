//! Matched views of scenes with known points and poses.

use std::sync::Arc;

use nalgebra::{Matrix6, Point3, Vector2, Vector3, Vector6};
use seese3_core::geometry::{CameraIntrinsics, Distortion, PixelCamera, Pose, PoseError, log};
use seese3_core::keypoints::Keypoints;
use seese3_core::statistics::{Coverage, coverage};
use seese3_robot::localization::{FocalSearch, KeypointRoom, LocatedView, NotLocated};
use seese3_robot::matched_views::{
    Error, KeypointMap, MapNoise, Mapping, MappingParameters, PoseInformation, Trial,
    ViewKeypoints, fitted_noise, squared_length as squared_length_of,
};
use seese3_testing::keypoint_scene::{Random, Scene, SceneView, camera_path, distorted_camera};
use seese3_testing::near;

/// Number of mapped frames of most tests.
const FRAMES: usize = 40;
/// Number of points of most scenes; a view sees more than half of them.
const POINTS: usize = 600;

/// A scene with the keypoints of mapped cameras.
#[derive(Clone)]
struct World {
    scene: Scene,
    camera: CameraIntrinsics,
    poses: Vec<Pose>,
    views: Vec<SceneView>,
}

impl World {
    fn new(scene: Scene, poses: Vec<Pose>, noise_px: f64) -> Self {
        let camera = distorted_camera();
        let mut random = Random::new(3);
        let views = poses
            .iter()
            .map(|pose| scene.view(pose, &camera, noise_px, &mut random))
            .collect();
        Self {
            scene,
            camera,
            poses,
            views,
        }
    }

    fn exact() -> Self {
        Self::new(Scene::in_box(POINTS, 1), camera_path(FRAMES), 0.0)
    }

    fn keypoints(&self) -> Vec<Keypoints> {
        self.views
            .iter()
            .map(|view| view.keypoints.clone())
            .collect()
    }

    /// The map under the stated poses and camera, with its measured noise.
    fn measured_map(&self, stated: &[Pose], camera: CameraIntrinsics) -> KeypointMap {
        let keypoints = self.keypoints();
        let parameters = MappingParameters::default();
        let mapping = Mapping::new(stated, &keypoints, camera, parameters).unwrap();
        let mut map = mapping.map(&|| ());
        map.measure_noise(&mapping);
        map
    }

    /// The map under the stated poses and camera.
    fn map(&self, stated: &[Pose], camera: CameraIntrinsics) -> KeypointMap {
        let keypoints = self.keypoints();
        let parameters = MappingParameters::default();
        let mapping = Mapping::new(stated, &keypoints, camera, parameters).unwrap();
        mapping.map(&|| ())
    }

    fn room(&self) -> KeypointRoom {
        self.room_of(&self.poses, self.map(&self.poses, self.camera))
    }

    fn room_of(&self, stated: &[Pose], map: KeypointMap) -> KeypointRoom {
        KeypointRoom::new(stated.to_vec(), Arc::new(map))
    }
}

/// Views between and beside the mapped frames of [`camera_path`].
fn new_poses(count: usize) -> Vec<Pose> {
    let mut random = Random::new(17);
    camera_path(count)
        .iter()
        .map(|pose| pose * Pose::new(random.normals() * 0.05, random.normals() * 0.05))
        .collect()
}

/// Locates the keypoints of a view.
fn located(
    room: &KeypointRoom,
    keypoints: &Keypoints,
    camera: &CameraIntrinsics,
) -> Result<LocatedView, NotLocated> {
    room.locate(ViewKeypoints { keypoints, camera })
}

/// Squared Mahalanobis length of the error of a located view.
fn squared_length(found: &LocatedView, truth: &Pose) -> f64 {
    let error = log(&found.pose.pose.inv_mul(truth)).to_vector();
    let covariance = found.pose.covariance.cholesky().unwrap();
    error.dot(&covariance.solve(&error))
}

/// The keypoints of a view with the descriptors of every second keypoint moved on to the next such
/// keypoint.
fn with_half_exchanged(view: &SceneView, scene: &Scene) -> Keypoints {
    let places: Vec<usize> = (0..view.shown.len()).collect();
    let exchanged: Vec<usize> = places
        .iter()
        .map(|&place| {
            let next = if place % 2 == 0 { place + 2 } else { place };
            view.shown[if next < places.len() { next } else { 0 }]
        })
        .collect();
    let descriptors = scene.descriptors.select(ndarray::Axis(0), &exchanged);
    Keypoints::new(
        view.keypoints.points(),
        view.keypoints.scores(),
        descriptors.view(),
    )
}

/// The depths of all mapped keypoints in the scene. Fails if an inverse depth is another one.
fn checked_depths(world: &World, map: &KeypointMap) -> Vec<f64> {
    let mut depths = Vec::new();
    for ((mapped, view), pose) in map.frames.iter().zip(&world.views).zip(&world.poses) {
        for (point, &inverse_depth) in mapped.points.iter().zip(&mapped.inverse_depths) {
            let place = view
                .keypoints
                .points()
                .iter()
                .position(|seen| seen == point);
            let shown = world.scene.points[view.shown[place.unwrap()]];
            let depth = pose.inverse_transform_point(&Point3::from(shown)).z;
            near(
                "inverse depth × depth",
                f64::from(inverse_depth) * depth,
                1.0,
                1e-3,
            );
            depths.push(depth);
        }
    }
    depths
}

/// Oracle: the depths of the scene's points in the cameras that see them.
#[test]
fn mapped_inverse_depths_are_those_of_the_scene() {
    let world = World::exact();
    let map = world.map(&world.poses, world.camera);
    for mapped in &map.frames {
        assert!(mapped.len() >= 200, "{} keypoints are mapped", mapped.len());
    }

    let depths = checked_depths(&world, &map);
    let median = seese3_core::statistics::median(&depths);
    near("unit", map.unit_m, median, 0.1 * median);
    assert!(map.epipolar_px < 1e-3, "{} px", map.epipolar_px);
}

/// Oracle: the poses from which the views are computed.
#[test]
fn a_view_with_exact_keypoints_is_located_within_a_millimeter() {
    let world = World::exact();
    let room = world.room();
    let mut random = Random::new(5);
    for pose in new_poses(15) {
        let view = world.scene.view(&pose, &world.camera, 0.0, &mut random);
        let found = located(&room, &view.keypoints, &world.camera).unwrap();
        let error = PoseError::between(&pose, &found.pose.pose);
        assert!(
            error.translation_m < 1e-3 && error.rotation_rad < 1e-3,
            "{error:?}"
        );

        let again = room
            .locate_near(
                ViewKeypoints {
                    keypoints: &view.keypoints,
                    camera: &world.camera,
                },
                &pose,
            )
            .unwrap();
        let error = PoseError::between(&pose, &again.pose.pose);
        assert!(
            error.translation_m < 1e-3 && error.rotation_rad < 1e-3,
            "{error:?}"
        );
    }
}

/// Oracle: the definition of a covariance. Squared Mahalanobis lengths of errors in six dimensions
/// have the mean 6; a mean of 40 has the standard deviation 0.55. The fit with heavy tails may
/// state up to 1.7 times the variance of normal errors.
#[test]
fn errors_under_pixel_noise_agree_with_the_covariance() {
    let world = World::new(Scene::in_box(POINTS, 1), camera_path(80), 0.5);
    let room = world.room_of(&world.poses, world.measured_map(&world.poses, world.camera));

    let mut random = Random::new(6);
    for is_exchanged in [false, true] {
        let mut lengths = Vec::new();
        let mut worst = 0.0_f64;
        for pose in new_poses(40) {
            let view = world.scene.view(&pose, &world.camera, 0.5, &mut random);
            let keypoints = if is_exchanged {
                with_half_exchanged(&view, &world.scene)
            } else {
                view.keypoints.clone()
            };
            let found = located(&room, &keypoints, &world.camera).unwrap();
            worst = worst.max(PoseError::between(&pose, &found.pose.pose).translation_m);
            lengths.push(squared_length(&found, &pose));
        }

        let mean = seese3_core::statistics::mean(&lengths);
        let longest = lengths.iter().copied().fold(0.0, f64::max).sqrt();
        assert!((2.0..9.0).contains(&mean), "mean squared length {mean}");
        assert!(longest < 6.0, "{longest} standard deviations");
        assert!(worst < 0.03, "{worst} m");
    }
}

/// Oracle: the true poses of views of the added frames. The first map has none of them, so that its
/// basis is of other descriptors.
#[test]
fn views_of_appended_frames_are_located() {
    let world = World::exact();
    let half = FRAMES / 2;
    let part = |rows: std::ops::Range<usize>| World {
        scene: world.scene.clone(),
        camera: world.camera,
        poses: world.poses[rows.clone()].to_vec(),
        views: world.views[rows].to_vec(),
    };
    let [known, added] = [part(0..half), part(half..FRAMES)];
    let mut map = known.map(&known.poses, world.camera);
    map.append(&added.map(&added.poses, world.camera)).unwrap();
    let room = world.room_of(&world.poses, map);

    let moved = Pose::new(
        Vector3::new(0.03, -0.02, 0.01),
        Vector3::new(0.02, 0.01, -0.03),
    );
    for row in (half + 5..FRAMES - 5).step_by(3) {
        let pose = world.poses[row] * moved;
        let view = world
            .scene
            .view(&pose, &world.camera, 0.0, &mut Random::new(8));
        let view = ViewKeypoints {
            keypoints: &view.keypoints,
            camera: &world.camera,
        };
        let found = room.locate_near(view, &pose).unwrap();
        assert!(found.matched.best_frame() >= half);
        let error = PoseError::between(&pose, &found.pose.pose);
        assert!(error.translation_m < 1e-3, "{error:?}");
    }
}

/// A view of the world's scene and its result in a room.
fn result_of(world: &World, room: &KeypointRoom, pose: &Pose) -> Result<LocatedView, NotLocated> {
    let view = world
        .scene
        .view(pose, &world.camera, 0.0, &mut Random::new(8));
    located(room, &view.keypoints, &world.camera)
}

/// Fails unless the view is refused as not in the map.
#[track_caller]
fn assert_not_in_map(result: Result<LocatedView, NotLocated>) {
    assert!(
        matches!(result, Err(NotLocated::NotInMap { .. })),
        "{result:?}"
    );
}

/// Oracle: the definitions of the refusals.
#[test]
fn without_keypoints_there_is_neither_a_map_nor_a_pose() {
    let none = Keypoints::default();
    let camera = distorted_camera();
    for count in [0, 5] {
        let poses = camera_path(count);
        let keypoints = vec![none.clone(); count];
        let mapping = Mapping::new(&poses, &keypoints, camera, MappingParameters::default());
        assert_eq!(mapping.err(), Some(Error::NoDescriptors));
    }

    let world = World::exact();
    let refused = located(&world.room(), &none, &camera);
    assert_eq!(refused.unwrap_err(), NotLocated::NoKeypoints);
}

/// Oracle: depth needs views from two places. One camera, cameras in one place and cameras that
/// only turn have none; points at infinity look the same from everywhere.
#[test]
fn a_map_without_a_baseline_has_no_depths() {
    let one_place: Vec<Pose> = vec![Pose::identity(); 12];
    let turning: Vec<Pose> = (0..12)
        .map(|at| Pose::new(Vector3::zeros(), Vector3::y() * (0.02 * f64::from(at))))
        .collect();
    let infinite: Vec<Vector3<f64>> = Scene::in_box(POINTS, 1)
        .points
        .iter()
        .map(|point| point * 1e7)
        .collect();

    let near = || Scene::in_box(POINTS, 1);
    for (name, scene, poses) in [
        ("one frame", near(), camera_path(1)),
        ("one place", near(), one_place),
        ("turning", near(), turning),
        ("infinity", Scene::of(infinite, 2), camera_path(FRAMES)),
    ] {
        let world = World::new(scene, poses, 0.0);
        let map = world.map(&world.poses, world.camera);
        let count: usize = map.frames.iter().map(|frame| frame.len()).sum();
        assert_eq!(count, 0, "{name}");

        let room = world.room_of(&world.poses, map);
        let moved = Pose::new(Vector3::new(0.05, 0.02, 0.0), Vector3::y() * 0.05);
        assert_not_in_map(result_of(&world, &room, &moved));
    }
}

/// Oracle: the true poses of the views. The positions of a camera that only turns differ by the
/// noise of its poses; depths from such baselines must not place a view somewhere else.
#[test]
fn a_turning_camera_with_noisy_positions_gives_no_wrong_pose() {
    for (count, jitter_m) in [1e-9, 1e-6, 1e-3, 5e-3]
        .into_iter()
        .flat_map(|jitter_m| [2, 5, 30].map(|count| (count, jitter_m)))
    {
        let mut random = Random::new(9);
        let turn = |at: i32| Vector3::y() * (0.01 * f64::from(at) - 0.15);
        let turning = (0..count).map(|at| Pose::new(Vector3::zeros(), turn(at)));
        let world = World::new(Scene::in_box(POINTS, 1), turning.collect(), 0.3);
        let mut stated = world.poses.clone();
        for pose in &mut stated {
            pose.translation.vector += random.normals() * jitter_m;
        }

        let room = world.room_of(&stated, world.map(&stated, world.camera));
        for shift_m in [0.0, 0.01, 0.03, 0.1, 0.3] {
            let moved = Pose::new(Vector3::x() * shift_m, Vector3::y() * 0.02);
            if let Ok(found) = result_of(&world, &room, &moved) {
                let error = PoseError::between(&moved, &found.pose.pose).translation_m;
                let deviation = found.pose.position_deviation_m();
                assert!(
                    error < 4.0 * deviation,
                    "{count}, {jitter_m}, {shift_m}: {error} m, deviation {deviation} m"
                );
            }
        }
    }
}

/// `count` cameras in a row along x, `spacing_m` apart.
fn row_of_poses(count: usize, spacing_m: f64) -> Vec<Pose> {
    let pose = |at| Pose::new(Vector3::x() * (spacing_m * at as f64), Vector3::zeros());
    (0..count).map(pose).collect()
}

/// Oracle: the depths of the scene's points, and the true pose of the view. Few frames are farther
/// apart than half of the unit that their spread suggests, but not than half of the median depth, 4
/// m.
#[test]
fn a_map_of_few_frames_has_the_depths_of_the_scene() {
    for count in 2..=5 {
        for spacing_m in [0.2, 0.4, 0.8] {
            let poses = row_of_poses(count, spacing_m);
            let world = World::new(Scene::in_box(POINTS, 1), poses, 0.0);
            let map = world.map(&world.poses, world.camera);
            let depths = checked_depths(&world, &map);
            assert!(depths.len() >= 100 * count, "{count}, {spacing_m}");

            let room = world.room_of(&world.poses, map);
            let moved = Pose::new(Vector3::x() * (0.4 * spacing_m), Vector3::y() * 0.02);
            let found = result_of(&world, &room, &moved).unwrap();
            let error = PoseError::between(&moved, &found.pose.pose);
            assert!(
                error.translation_m < 1e-3 && error.rotation_rad < 1e-3,
                "{count}, {spacing_m}: {error:?}"
            );
        }
    }
}

/// Oracle: the true poses of the views. The noise of a map of two frames is not measured, so that
/// its covariance is that of a typical map.
#[test]
fn a_noisy_map_of_two_frames_gives_no_confident_wrong_pose() {
    for spacing_m in [0.2, 0.4, 0.8] {
        let world = World::new(Scene::in_box(POINTS, 1), row_of_poses(2, spacing_m), 0.5);
        let room = world.room();
        let mut random = Random::new(6);
        let mut answered = 0;
        for _ in 0..20 {
            let pose = Pose::new(random.normals() * 0.1, random.normals() * 0.05);
            let view = world.scene.view(&pose, &world.camera, 0.5, &mut random);
            if let Ok(found) = located(&room, &view.keypoints, &world.camera) {
                let length = squared_length(&found, &pose).sqrt();
                assert!(length < 6.0, "{spacing_m}: {length} standard deviations");
                answered += 1;
            }
        }
        assert!(answered > 0, "{spacing_m}");
    }
}

/// Oracle: the definition of the largest baseline, half of the median depth. The points are 2 to 6
/// m deep, the cameras 3.2 m apart.
#[test]
fn a_map_of_two_frames_too_far_apart_refuses_views() {
    let world = World::new(Scene::in_box(POINTS, 1), row_of_poses(2, 3.2), 0.0);
    let map = world.map(&world.poses, world.camera);
    assert!(map.frames.iter().all(|frame| frame.is_empty()));
    let room = world.room_of(&world.poses, map);
    let moved = Pose::new(Vector3::x() * 0.1, Vector3::y() * 0.02);
    assert_not_in_map(result_of(&world, &room, &moved));
}

/// Oracle: the true poses of the views. Three points of a plane determine a pose as any other.
#[test]
fn a_view_of_a_plane_is_located() {
    let mut scene = Scene::in_box(POINTS, 1);
    for point in &mut scene.points {
        point.z = 4.0 + 0.2 * point.x;
    }
    let world = World::new(scene, camera_path(FRAMES), 0.0);
    let room = world.room();
    for pose in new_poses(8) {
        let found = result_of(&world, &room, &pose).unwrap();
        let error = PoseError::between(&pose, &found.pose.pose);
        assert!(error.translation_m < 2e-3, "{error:?}");
    }
}

/// Oracle: the true poses of the views.
#[test]
fn a_view_is_located_although_one_mapped_pose_in_ten_is_wrong() {
    let world = World::exact();
    let mut random = Random::new(10);
    let mut stated = world.poses.clone();
    for pose in stated.iter_mut().step_by(10) {
        let shift = random.normals().normalize() * 0.5;
        pose.translation.vector += shift;
    }

    let room = world.room_of(&stated, world.map(&stated, world.camera));
    let mut answered = 0;
    for pose in new_poses(30) {
        match result_of(&world, &room, &pose) {
            Ok(found) => {
                answered += 1;
                let error = PoseError::between(&pose, &found.pose.pose);
                assert!(error.translation_m < 5e-3, "{error:?}");
            }
            Err(refused) => assert!(!matches!(refused, NotLocated::NoKeypoints)),
        }
    }
    assert!(answered >= 20, "{answered} of 30 views are located");
}

/// Oracle: the view shows another scene. Points with the descriptors of the map in other places do
/// not agree with it either.
#[test]
fn a_view_of_another_scene_is_refused() {
    let world = World::exact();
    let room = world.room();
    let other = Scene::in_box(POINTS, 50);
    let shuffled = Scene {
        points: other.points.clone(),
        ..world.scene.clone()
    };
    for scene in [other, shuffled] {
        for pose in new_poses(8) {
            let view = scene.view(&pose, &world.camera, 0.0, &mut Random::new(8));
            assert_not_in_map(located(&room, &view.keypoints, &world.camera));
        }
    }
}

/// Fails if a located view is more than 6 standard deviations from its true pose. `cameras` are
/// those that are stated for the map and for the view.
#[track_caller]
fn assert_no_confident_wrong_pose(world: &World, cameras: [CameraIntrinsics; 2]) {
    let [of_map, of_view] = cameras;
    let room = world.room_of(&world.poses, world.measured_map(&world.poses, of_map));
    for pose in new_poses(6) {
        let view = world
            .scene
            .view(&pose, &world.camera, 0.5, &mut Random::new(8));
        if let Ok(found) = located(&room, &view.keypoints, &of_view) {
            let error = PoseError::between(&pose, &found.pose.pose).translation_m;
            let length = squared_length(&found, &pose).sqrt();
            assert!(
                length < 6.0,
                "{error:.3} m, {length:.1} standard deviations, {} inliers",
                found.inliers
            );
        }
    }
}

/// Oracle: the true poses of the views. If map and view state the same wrong focal length, errors
/// partly cancel, and the trials of the map measure the rest.
#[test]
fn a_wrong_focal_length_of_map_and_view_is_part_of_the_covariance() {
    let world = World::new(Scene::in_box(POINTS, 1), camera_path(FRAMES), 0.5);
    for factor in [0.75, 1.25] {
        let wrong = world.camera.zoomed(factor).unwrap();
        assert_no_confident_wrong_pose(&world, [wrong, wrong]);
    }
}

/// Oracle: the true poses of the views.
#[test]
fn a_wrong_focal_length_of_the_view_alone_gives_no_confident_wrong_pose() {
    let world = World::new(Scene::in_box(POINTS, 1), camera_path(FRAMES), 0.5);
    for factor in [0.75, 1.25] {
        let wrong = world.camera.zoomed(factor).unwrap();
        assert_no_confident_wrong_pose(&world, [world.camera, wrong]);
    }
}

/// Oracle: the true focal length of the views.
#[test]
fn a_wrong_focal_length_of_a_view_is_refused_by_name() {
    let world = World::exact();
    let room = world.room_of(&world.poses, world.measured_map(&world.poses, world.camera));
    let truth = world.camera.focal().x;
    for factor in [0.7, 0.85, 0.93, 1.07, 1.2, 1.4] {
        let wrong = world.camera.zoomed(factor).unwrap();
        for pose in new_poses(6) {
            let view = world
                .scene
                .view(&pose, &world.camera, 0.0, &mut Random::new(8));
            let refused = match located(&room, &view.keypoints, &wrong) {
                Ok(found) => panic!("{factor}: {:?}", found.matched.focal),
                Err(refused) => refused,
            };
            let NotLocated::CameraContradicted { stated, fitted, .. } = refused else {
                panic!("{factor}: {refused}");
            };
            near("stated", stated, truth * factor, 1e-9);
            near("fitted", fitted / truth, 1.0, 0.03);
        }
    }
}

/// Oracle: the true focal length of the views: images are zoomed, and the camera of the map is
/// stated.
#[test]
fn zoomed_images_of_the_mapping_camera_are_refused_by_name() {
    let world = World::exact();
    let room = world.room_of(&world.poses, world.measured_map(&world.poses, world.camera));
    for factor in [0.85, 0.92, 1.09, 1.2] {
        let zoomed = world.camera.zoomed(factor).unwrap();
        for pose in new_poses(6) {
            let view = world.scene.view(&pose, &zoomed, 0.5, &mut Random::new(8));
            let refused = located(&room, &view.keypoints, &world.camera).unwrap_err();
            assert!(refused.is_of_camera(), "{factor}: {refused}");
        }
    }
}

/// Oracle: the true focal length. Noise of the keypoints must not make the fitted one longer or
/// shorter on average.
#[test]
fn the_fitted_focal_length_is_unbiased() {
    let world = World::exact();
    let room = world.room();
    let mut random = Random::new(12);
    let logarithms: Vec<f64> = new_poses(60)
        .iter()
        .filter_map(|pose| {
            let view = world.scene.view(pose, &world.camera, 1.0, &mut random);
            let found = located(&room, &view.keypoints, &world.camera).ok()?;
            Some(found.matched.focal?.factor.ln())
        })
        .collect();

    assert!(logarithms.len() > 50);
    let mean = seese3_core::statistics::mean(&logarithms);
    let variance = logarithms.iter().map(|x| (x - mean).powi(2)).sum::<f64>();
    let error = variance.sqrt() / logarithms.len() as f64;
    assert!(mean.abs() < 3.0 * error, "{mean} +- {error}");
}

/// Oracle: the true focal length of the views, which have no distortion. Three views determine it;
/// located views refine it, and their uncertainty grows along the optical axis alone.
#[test]
fn the_focal_length_of_an_unknown_camera_is_estimated() {
    let world = World::exact();
    let room = world.room();
    for focal in [0.6, 0.77, 1.0, 1.4] {
        let truth = CameraIntrinsics::new(PixelCamera {
            width: 1.0,
            height: 0.75,
            focal: Vector2::new(focal, focal),
            center: None,
            distortion: Distortion::None,
        });
        let truth = truth.unwrap();
        let mut search = FocalSearch::default();
        let mut answered = 0;
        for pose in new_poses(8) {
            let view = world.scene.view(&pose, &truth, 0.0, &mut Random::new(8));
            let camera = search.camera(&view.keypoints, 0.75, std::iter::once(&room));
            let Some(camera) = camera else {
                continue;
            };
            near("focal", camera.focal().x / focal, 1.0, 0.03);
            answered += 1;

            let keypoints = &view.keypoints;
            let located = room.locate(ViewKeypoints {
                keypoints,
                camera: &camera,
            });
            let located = located.unwrap();
            let before = located.pose.covariance;
            let added = search.with_focal_of(&camera, located).pose.covariance - before;
            assert!(added[(2, 2)] > 0.0);
            near("elsewhere", added.norm(), added[(2, 2)], 1e-12);
        }
        assert_eq!(answered, 6, "the third view and the later ones");

        // A blank view says nothing; three contradictions in succession start the search again.
        let rooms = || std::iter::once(&room);
        assert!(
            search
                .camera(&Keypoints::default(), 0.75, rooms())
                .is_some()
        );
        search.contradict();
        search.contradict();
        assert!(
            search
                .camera(&Keypoints::default(), 0.75, rooms())
                .is_some()
        );
        search.contradict();
        assert!(
            search
                .camera(&Keypoints::default(), 0.75, rooms())
                .is_none()
        );
    }

    let mut search = FocalSearch::default();
    let none = search.camera(&Keypoints::default(), 0.75, std::iter::once(&room));
    assert!(none.is_none());
}

/// A trial with the given information; its error is drawn from Student's t distribution with 5
/// degrees of freedom and the covariance that `noise` gives.
fn drawn_trial(information: PoseInformation, noise: &MapNoise, random: &mut Random) -> Trial {
    let root = information.covariance(noise).unwrap().cholesky().unwrap();
    let normal = Vector6::from_fn(|_, _| random.normal());
    let chi_squared: f64 = (0..5).map(|_| random.normal().powi(2)).sum();

    // A t variate normal · √(5 / χ²) has the variance 5 / 3.
    let error = root.l() * normal * (3.0 / chi_squared).sqrt();
    Trial { error, information }
}

/// Trials with errors drawn from `noise`, at gaps of 0.01 to 1.
fn drawn_trials(noise: &MapNoise, count: usize) -> Vec<Trial> {
    let mut random = Random::new(31);
    (0..count)
        .map(|_| {
            // Deviations of 0.2 to 5 mm, and of 1/2 of that in radians, with correlated axes.
            let size = 2e-4 * 25.0_f64.powf(random.uniform());
            let mut root = Matrix6::from_fn(|_, _| 0.3 * random.normal());
            root += Matrix6::identity();
            let scale = Vector6::new(1.0, 1.0, 1.0, 0.5, 0.5, 0.5) * size;
            let root = Matrix6::from_diagonal(&scale) * root;
            let independent = (root * root.transpose()).try_inverse().unwrap();
            let information = PoseInformation {
                independent: (independent + independent.transpose()) * 0.5,
                gap: 0.01 * 100.0_f64.powf(random.uniform()),
                unit_m: 2.0,
            };
            drawn_trial(information, noise, &mut random)
        })
        .collect()
}

/// Coverage of the errors of trials under a noise.
fn coverage_under(trials: &[Trial], noise: &MapNoise) -> Coverage {
    let lengths: Vec<f64> = trials
        .iter()
        .map(|trial| squared_length_of(trial, noise).unwrap())
        .collect();
    coverage(&lengths)
}

const DRAWN: MapNoise = MapNoise {
    design_effect: 8.0,
    gap_scale: 0.05,
    pose_noise: 0.002,
    relative_error: 0.01,
};

/// Oracle: the noise from which the errors are drawn. Its 95 % ellipsoids hold 90.5 % of them, as 6
/// F(6, 5) · 3/5 has its 90.5 % quantile where χ² has that of 95 %; the 93 % quantile is 1.19 times
/// as large (SciPy 1.17, `scipy.stats.f`). The fitted noise is scaled by that.
#[test]
fn the_noise_of_drawn_trials_is_found() {
    let trials = drawn_trials(&DRAWN, 2_000);
    let noise = fitted_noise(&trials).unwrap();
    let drawn = DRAWN.scaled(1.186);
    for (name, found, expected) in [
        ("design effect", noise.design_effect, drawn.design_effect),
        ("gap scale", noise.gap_scale, drawn.gap_scale),
        ("pose noise", noise.pose_noise, drawn.pose_noise),
        ("relative error", noise.relative_error, drawn.relative_error),
    ] {
        near(name, found / expected, 1.0, 0.3);
    }

    let coverage = coverage_under(&trials, &noise);
    near("within 95 %", coverage.within_95, 0.93, 1e-3);

    assert_eq!(fitted_noise(&trials[..29]), None);
}

/// Oracle: the noise from which the errors are drawn. Without one of its parts, the ellipsoids do
/// not hold their shares of the errors.
#[test]
fn each_part_of_the_noise_is_needed() {
    let trials = drawn_trials(&DRAWN, 1_000);
    let independent = MapNoise {
        design_effect: 1.0,
        ..DRAWN
    };
    let everywhere_alike = MapNoise {
        gap_scale: 1e3,
        ..DRAWN
    };
    let without_noise = MapNoise {
        pose_noise: 1e-6,
        ..DRAWN
    };
    let without_relative = MapNoise {
        relative_error: 1e-6,
        ..DRAWN
    };

    for noise in [
        independent,
        everywhere_alike,
        without_noise,
        without_relative,
    ] {
        let coverage = coverage_under(&trials, &noise);
        let is_held = coverage.within_68 > 0.6 && coverage.within_95 > 0.85;
        assert!(!is_held, "{noise:?}: {coverage:?}");
    }
}

/// Poses with the errors that `error` gives, in order.
fn stated_with(poses: &[Pose], mut error: impl FnMut() -> Pose) -> Vec<Pose> {
    poses.iter().map(|pose| pose * error()).collect()
}

/// Oracle: the definition of a covariance, for views whose true pose is stated with the errors of
/// the map. The errors of the poses are independent, or drift like a random walk.
#[test]
fn errors_of_stated_poses_are_part_of_the_covariance() {
    let world = World::new(Scene::in_box(POINTS, 1), camera_path(120), 0.5);
    let keypoints = world.keypoints();

    let mut random = Random::new(12);
    let mut small = move |m: f64| Pose::new(random.normals() * m, random.normals() * (0.5 * m));
    let mut walk = Pose::identity();
    let independent = stated_with(&world.poses, || small(0.004));
    let drifting = stated_with(&world.poses, || {
        walk *= small(0.002);
        walk
    });

    for (name, stated) in [("independent", independent), ("drifting", drifting)] {
        // The map lacks a stretch, and every second frame elsewhere.
        let (asked, mapped): (Vec<usize>, Vec<usize>) =
            (0..120).partition(|&row| row % 2 == 1 || (60..70).contains(&row));
        let poses: Vec<Pose> = mapped.iter().map(|&row| stated[row]).collect();
        let known: Vec<Keypoints> = mapped.iter().map(|&row| keypoints[row].clone()).collect();
        let mapping = Mapping::new(&poses, &known, world.camera, MappingParameters::default());
        let mapping = mapping.unwrap();
        let mut map = mapping.map(&|| ());
        map.measure_noise(&mapping);

        let room = world.room_of(&poses, map);
        let lengths: Vec<f64> = asked
            .iter()
            .filter_map(|&row| {
                let found = located(&room, &keypoints[row], &world.camera).ok()?;
                Some(squared_length(&found, &stated[row]))
            })
            .collect();
        let coverage = coverage(&lengths);
        assert!(lengths.len() >= 60, "{name}: {} answers", lengths.len());
        assert!(
            (0.5..0.95).contains(&coverage.within_68) && coverage.within_95 >= 0.8,
            "{name}: {coverage:?}"
        );
    }
}

/// Oracle: the similarity between the two world frames. The second map shows the same scene from
/// other cameras, in another world frame and scale. A map of another scene is refused.
#[test]
fn two_maps_of_one_scene_are_aligned() {
    let scene = Scene::in_box(POINTS, 1);
    let first = World::new(scene.clone(), camera_path(FRAMES), 0.3);
    let second = World::new(scene, new_poses(FRAMES), 0.3);
    let map_from_other = Pose::new(Vector3::new(3.0, -1.0, 0.5), Vector3::new(0.2, 0.9, -0.4));
    let scale = 1.25;
    let stated: Vec<Pose> = second
        .poses
        .iter()
        .map(|pose| {
            let mut moved = map_from_other.inv_mul(pose);
            moved.translation.vector /= scale;
            moved
        })
        .collect();
    let other = second.map(&stated, second.camera);
    let room = first.room();

    let found = room.align(&other, &stated, true).unwrap();
    let similarity = found.map_from_other;
    near("scale", similarity.scale, scale, 0.01 * scale);
    let off = similarity.reference_from_estimate.inv_mul(&Pose {
        // With a scale, the translation is that of the scaled coordinates.
        translation: (map_from_other.translation.vector).into(),
        rotation: map_from_other.rotation,
    });
    assert!(off.rotation.angle() < 0.01, "{off}");
    for (stated, truth) in stated.iter().zip(&second.poses) {
        let moved = similarity.pose(stated).inv_mul(truth);
        assert!(moved.translation.vector.norm() < 0.02, "{moved}");
    }
    let [tried, located, agreeing] = found.counts;
    assert!(agreeing <= located && located <= tried && agreeing * 2 > tried);

    let elsewhere = World::new(Scene::in_box(POINTS, 9), camera_path(FRAMES), 0.3);
    let map = elsewhere.map(&elsewhere.poses, elsewhere.camera);
    let refused = room.align(&map, &elsewhere.poses, false).unwrap_err();
    assert!(refused.agreeing < 5 && refused.to_string().contains("at least 5"));
}

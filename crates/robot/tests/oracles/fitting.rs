//! An adapter fitted to one room: better than its neighbors' poses near the map, and harmless far
//! from it.

use std::sync::Arc;

use seese3_core::adapter::Adapter;
use seese3_core::features::Features;
use seese3_core::geometry::PoseError;
use seese3_core::room::{FrameId, Room};
use seese3_core::statistics::{coverage, median};
use seese3_core::training::RoomData;
use seese3_robot::fitting::{Error, FitRun, Fitted, Localizer, MotionReader, fit};

use seese3_testing::world::{calibrated, place, served};

/// Every tenth frame of a room.
fn every_tenth(room: &Room) -> Vec<FrameId> {
    (0..room.frame_count() as u32)
        .step_by(10)
        .map(FrameId)
        .collect()
}

fn data<'a>(room: &'a Room, features: &'a Features) -> RoomData<'a> {
    RoomData {
        room,
        revision: 1,
        features,
    }
}

fn fitted(room: &Room, features: &Features, base: Option<&Arc<Adapter>>) -> Fitted {
    fit(
        &data(room, features),
        &every_tenth(room),
        base,
        0,
        FitRun::UNWATCHED,
    )
    .unwrap()
}

/// Oracle: the true poses of the frames that are not mapped, which the fit never saw, and the pose
/// of the frame whose feature is nearest: a reading has to come nearer than that, and as near as
/// its covariance says.
#[test]
fn views_between_mapped_frames_are_located() {
    let (room, features) = served("hall");
    let Fitted { adapter, rules, .. } = fitted(&room, &features, None);
    let mapped = every_tenth(&room);
    let localizer = Localizer::new(&data(&room, &features), &mapped, None, Some(adapter)).unwrap();

    let mut located_m = Vec::new();
    let mut nearest_m = Vec::new();
    let mut squared_lengths = Vec::new();
    for row in (0..room.frame_count()).filter(|row| row % 10 != 0) {
        let truth = &room.poses()[row];
        let feature = features.rows().row(row).to_vec();
        let view = localizer.locate(&feature, &rules).unwrap();

        let nearest = localizer.pose(view.nearest.frame);
        located_m.push(PoseError::between(&view.pose.pose, truth).translation_m);
        nearest_m.push(PoseError::between(nearest, truth).translation_m);

        let error = seese3_core::geometry::log(&view.pose.pose.inv_mul(truth)).to_vector();
        let cholesky = view.pose.covariance.cholesky().unwrap();
        squared_lengths.push(error.dot(&cholesky.solve(&error)));
    }

    let located = median(&located_m);
    let nearest = median(&nearest_m);
    assert!(located < 0.5 * nearest, "{located} m against {nearest} m");

    let found = coverage(&squared_lengths);
    assert!(found.within_68 > 0.5 && found.within_95 > 0.8, "{found:?}");
}

/// Oracle: what the rules promise of a view that resembles nothing in the map: its covariance grows
/// with the distance, however little the readings disagree.
#[test]
fn far_from_the_map_a_place_is_unsure() {
    let (room, features) = served("hall");
    let Fitted { adapter, rules, .. } = fitted(&room, &features, None);
    let mapped = every_tenth(&room);
    let localizer = Localizer::new(&data(&room, &features), &mapped, None, Some(adapter)).unwrap();

    let own = localizer
        .locate(&features.rows().row(5).to_vec(), &rules)
        .unwrap();
    assert_eq!(own.translation.reader, MotionReader::Fitted);

    let elsewhere: Vec<f32> = features.rows().row(5).iter().map(|x| x + 50.0).collect();
    let view = localizer.locate(&elsewhere, &rules).unwrap();
    assert!(view.nearest.distance > 10.0 * own.nearest.distance);
    assert!(view.pose.covariance.trace() > 100.0 * own.pose.covariance.trace());
}

/// Oracle: the definition of going on: an adapter of other rooms gives the scale of the fitted one,
/// whose readings in the room are better than its own.
#[test]
fn a_fit_goes_on_from_an_adapter() {
    let (room, features) = place("shed", 21);
    let base = Arc::new(calibrated().0);
    let Fitted {
        adapter, record, ..
    } = fitted(&room, &features, Some(&base));
    assert_eq!(adapter.scale(), base.scale());
    assert_eq!(record.rooms, [(room.id().clone(), 1)]);

    let error = |adapter: &Adapter| {
        let latents = adapter.embed(features.rows()).unwrap();
        let errors: Vec<f64> = (0..room.frame_count() - 5)
            .map(|row| {
                let truth =
                    seese3_core::geometry::body_twist(&room.poses()[row], &room.poses()[row + 5]);
                let read = adapter.motion_without_mean(latents.row(row), latents.row(row + 5));
                (truth.to_vector() - read.to_vector()).norm()
            })
            .collect();
        median(&errors)
    };
    assert!(error(&adapter) < 0.8 * error(&base));
}

/// Oracle: the promise of a seed.
#[test]
fn the_same_seed_fits_the_same_adapter() {
    let (room, features) = served("attic");
    let one = fitted(&room, &features, None);
    let other = fitted(&room, &features, None);

    assert_eq!(one.rules, other.rules);
    assert_eq!(
        one.adapter.embed(features.rows()).unwrap(),
        other.adapter.embed(features.rows()).unwrap()
    );
}

/// Oracle: a list of what cannot be fitted or located, and the words of its errors.
#[test]
fn what_cannot_be_fitted_is_refused() {
    let (room, features) = served("hall");
    let data = data(&room, &features);
    let try_fit = |mapped: &[FrameId]| fit(&data, mapped, None, 0, FitRun::UNWATCHED).map(|_| ());

    let few: Vec<FrameId> = (0..19).map(FrameId).collect();
    assert_eq!(
        try_fit(&few),
        Err(Error::FewFrames {
            least: 20,
            given: 19
        })
    );

    let beyond: Vec<FrameId> = (290..310).map(FrameId).collect();
    let falling: Vec<FrameId> = (0..30).rev().map(FrameId).collect();
    assert_eq!(try_fit(&beyond), Err(Error::MappedFrames));
    assert_eq!(try_fit(&falling), Err(Error::MappedFrames));

    let mapped = every_tenth(&room);
    let localizer = Localizer::new(&data, &mapped, None, None).unwrap();
    assert!(localizer.read(&[0.0; 3]).is_err());
    assert!(localizer.read(&[f32::NAN; 48]).is_err());

    let still: Vec<_> = vec![room.poses()[0]; room.frame_count()];
    let frames = seese3_core::room::Frames {
        poses: still,
        ..Default::default()
    };
    let unmoved = Room::new(room.id().clone(), frames, Default::default()).unwrap();
    let unmoved = RoomData {
        room: &unmoved,
        ..data
    };
    assert!(fit(&unmoved, &mapped, None, 0, FitRun::UNWATCHED).is_err());
}

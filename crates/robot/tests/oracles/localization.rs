//! The choice between matched keypoints and similar frames.

use nalgebra::Matrix6;
use seese3_core::geometry::Pose;
use seese3_robot::localization::{AdapterEstimate, Method, NotLocated, PoseEstimate};

const FEW: NotLocated = NotLocated::NotInMap {
    inliers: 30,
    keypoints: 600,
    needed: 90,
};
const CONTRADICTED: NotLocated = NotLocated::CameraContradicted {
    stated: 1.0,
    fitted: 0.8,
    matches: 100,
    fitted_matches: 300,
};

fn similar(novelty: Option<f64>) -> AdapterEstimate {
    AdapterEstimate {
        pose: Pose::identity(),
        covariance: Some(Matrix6::identity()),
        method: Method::SimilarFrames,
        novelty,
    }
}

/// Oracle: the rules of [`PoseEstimate::choose`]. Similar frames give a pose up to a novelty of 1;
/// if it is unknown, only without keypoints; and never for a contradicted camera.
#[test]
fn similar_frames_answer_only_for_views_that_resemble_the_room() {
    let answers = |unmatched: Option<NotLocated>, novelty: Option<f64>| {
        let chosen = PoseEstimate::choose(unmatched.map(Err), || Some(similar(novelty)));
        chosen.is_ok_and(|chosen| chosen.method == Method::SimilarFrames)
    };

    for (unmatched, novelty, expected) in [
        (None, Some(0.9), true),
        (None, Some(1.1), false),
        (None, None, true),
        (Some(FEW), Some(0.9), true),
        (Some(FEW), Some(1.1), false),
        (Some(FEW), None, false),
        (Some(CONTRADICTED), Some(0.1), false),
    ] {
        assert_eq!(
            answers(unmatched, novelty),
            expected,
            "{unmatched:?} {novelty:?}"
        );
    }
}

/// Oracle: by hand. 90 of 30 is 3; the novelty of similar frames counts if it is above 1.
#[test]
fn a_refused_view_states_its_novelty() {
    let novelty = |unmatched: NotLocated, similar: Option<AdapterEstimate>| {
        let refused = PoseEstimate::choose(Some(Err(unmatched)), || similar);
        refused.err().and_then(|refused| refused.novelty)
    };

    assert_eq!(novelty(FEW, None), Some(3.0));
    assert_eq!(novelty(FEW, Some(similar(Some(1.5)))), Some(1.5));
    assert_eq!(novelty(FEW, Some(similar(None))), Some(3.0));
    assert_eq!(
        novelty(NotLocated::NoKeypoints, Some(similar(Some(2.0)))),
        Some(2.0)
    );
    assert_eq!(novelty(NotLocated::NoKeypoints, None), None);
    assert_eq!(novelty(CONTRADICTED, Some(similar(Some(0.1)))), None);
}

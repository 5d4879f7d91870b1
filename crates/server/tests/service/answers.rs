//! What the server answers is what the oracles and the definitions say.

use pb::prediction::Prediction;
use seese3_client::proto::v1 as pb;
use seese3_server::Config;
use tonic_types::RpcStatusExt as _;

use crate::harness::{
    by_twist, by_twists, feature, feature_row, frame, latent, oracle, question, six, start,
    to_frame, to_pose, twist,
};
use seese3_testing::{golden, json, near, number};

fn expected() -> serde_json::Value {
    json(&golden().join("navigation/synthetic_expected.json"))
}

fn compare(what: &str, scores: &pb::NavigatorScores, expected: &serde_json::Value) {
    let r2 = number(&expected["r2_variance_weighted"]);
    near(
        what,
        scores.latent_mse.unwrap(),
        number(&expected["mse"]),
        1e-9,
    );
    near(what, scores.latent_r2.unwrap(), r2, 1e-8);

    compare_hits(what, scores, &expected["source_included"]);
}

fn compare_hits(what: &str, scores: &pb::NavigatorScores, included: &serde_json::Value) {
    assert_eq!(
        u64::from(scores.pair_count),
        included["n"].as_u64().unwrap()
    );

    for (found, key, bound) in [
        (scores.top1.unwrap().value, "top1", 1e-12),
        (scores.translation_m_median, "median_t_m", 1e-9),
        (scores.rotation_rad_median, "median_R_rad", 1e-9),
    ] {
        near(what, found, number(&included[key]), bound);
    }

    for hit in &scores.hit_rates {
        let key = hit.threshold.to_string();
        let found = hit.proportion.unwrap();
        let [low, high] = [0, 1].map(|end| number(&included["hit_wilson95"][&key][end]));
        near(what, found.value, number(&included["hit"][&key]), 1e-12);
        // Correlated pairs hold less information than independent trials.
        assert!(
            found.low <= low + 1e-9 && high <= found.high + 1e-9,
            "{what} {key}: {found:?}"
        );
    }
}

/// Oracle: NumPy, scikit-learn and SciPy, through the wire; progress names every navigator in
/// order.
#[tokio::test]
async fn evaluate_streams_progress_and_the_oracles_table() {
    let server = start(Config::default()).await;

    let request = pb::EvaluateRequest {
        room: "synthetic".to_owned(),
        ..pb::EvaluateRequest::default()
    };

    let mut begun = Vec::new();
    let report = server
        .client
        .evaluate(request, |step| begun.push(step.navigator));
    let report = report.await.unwrap();
    let rows = &report.navigators;
    let names: Vec<&str> = rows.iter().map(|row| row.name.as_str()).collect();
    assert_eq!(begun, names);

    assert_eq!((report.pair_count, report.candidate_count), (80, 120));
    assert!(report.in_room && !report.leaks);

    let expected = expected();
    for (ours, theirs) in [
        ("identity", "identity"),
        ("inverse-poincare-affine", "inverse_affine"),
        ("inverse-poincare-homogeneous", "inverse_homogeneous"),
        ("inverse-poincare-literal", "inverse_literal"),
        ("ridge-refit", "refit_raw_no_intercept_80_20"),
    ] {
        let row = rows.iter().find(|row| row.name == ours).unwrap();
        compare(ours, row, &expected["navigators"][theirs]);
    }
}

/// Oracle: two ways to one number: the frames that Navigate retrieves in the last of three steps,
/// handed in with the frame that this step started from, get the scores that Evaluate gives the
/// same walks. Without that frame, some of them are refused, since a walk may come back to its
/// source.
#[tokio::test]
async fn walks_that_snap_can_be_handed_in() {
    let server = start(Config::default()).await;
    let (steps, stride, radius) = (3, 40, 30);
    let evaluate = pb::EvaluateRequest {
        room: "synthetic".to_owned(),
        adapter: "oracle".to_owned(),
        split: pb::Split::Whole.into(),
        navigators: vec!["inverse-poincare-affine".to_owned()],
        stride: Some(stride),
        exclude_source: true,
        exclude_radius: radius,
        steps: Some(steps),
        step_mode: pb::StepMode::Snap.into(),
        ..pb::EvaluateRequest::default()
    };
    let report = server.client.evaluate(evaluate, drop).await.unwrap();

    let mut predictions = Vec::new();
    for source in 0..600 - stride {
        let walk = |r: &mut pb::NavigateRequest| {
            r.source = frame(source);
            r.motion = to_frame(source + stride);
            r.navigator = "inverse-poincare-affine".to_owned();
            r.steps = Some(steps);
            r.step_mode = pb::StepMode::Snap.into();
            (r.exclude_source, r.exclude_radius) = (true, radius);
        };
        let walked = server.navigated(walk).await.steps;
        let retrieved = |step: usize| walked[step].frames[0].frame_id;

        predictions.push(pb::Prediction {
            source_frame_id: source,
            target_frame_id: source + stride,
            prediction: Some(Prediction::RetrievedFrameId(retrieved(2))),
            last_step_frame_id: Some(retrieved(1)),
        });
    }

    let request = |predictions| pb::ScorePredictionsRequest {
        room: "synthetic".to_owned(),
        adapter: "oracle".to_owned(),
        split: pb::Split::Whole.into(),
        exclude_source: true,
        exclude_radius: radius,
        predictions,
        ..pb::ScorePredictionsRequest::default()
    };
    let scored = server
        .client
        .score_predictions(request(predictions.clone()));
    let scored = scored.await.unwrap().scores.unwrap();

    let mut expected = report.navigators[0].clone();
    assert_eq!((scored.pair_count, expected.pair_count), (560, 560));
    // Handed in, the baseline would have to retrieve another frame than the source.
    for hit in &mut expected.hit_rates {
        assert!(hit.over_identity.take().is_some());
    }
    assert_eq!(scored.hit_rates, expected.hit_rates);
    assert_eq!(scored.top1, expected.top1);

    for prediction in &mut predictions {
        prediction.last_step_frame_id = None;
    }
    let refused = server.client.score_predictions(request(predictions)).await;
    assert!(refused.unwrap_err().to_string().contains("is excluded"));
}

/// Oracle: as above; the client brings the oracle's own latents, and then its retrieved frames.
#[tokio::test]
async fn a_clients_predictions_get_the_oracles_scores() {
    let server = start(Config::default()).await;
    let latents = oracle("g_hat.refit_zscored_intercept_80_20");
    let frames = oracle("retrieved.refit_zscored_intercept_80_20.source_included");
    let pairs = (480..560).map(|source| (source, source + 40));

    let prediction = |(source_frame_id, target_frame_id), prediction| pb::Prediction {
        source_frame_id,
        target_frame_id,
        prediction: Some(prediction),
        ..pb::Prediction::default()
    };

    let oracle = pb::Revision {
        name: "oracle".to_owned(),
        revision: 1,
    };
    let by_latent = latents.outer_iter().zip(pairs.clone());
    let by_latent = by_latent.map(|(latent, pair)| {
        let values = latent.to_vec();
        prediction(
            pair,
            Prediction::Latent(pb::Latent {
                values,
                adapter: Some(oracle.clone()),
            }),
        )
    });

    let by_frame = frames.iter().zip(pairs);
    let by_frame =
        by_frame.map(|(&frame, pair)| prediction(pair, Prediction::RetrievedFrameId(frame as u32)));

    let expected = &expected()["navigators"]["refit_zscored_intercept_80_20"];

    let request = |predictions| pb::ScorePredictionsRequest {
        room: "synthetic".to_owned(),
        split: pb::Split::Time.into(),
        predictions,
        ..pb::ScorePredictionsRequest::default()
    };
    let score = async |predictions| {
        let scored = server.client.score_predictions(request(predictions));
        let scored = scored.await.unwrap();
        assert_eq!(scored.candidate_count, 120);
        scored.scores.unwrap()
    };
    compare("latents", &score(by_latent.collect()).await, expected);

    let scores = score(by_frame.collect()).await;
    assert_eq!((scores.latent_mse, scores.latent_r2), (None, None));
    compare_hits("frames", &scores, &expected["source_included"]);
}

/// Oracle: PyTorch's test R² of the trained adapter, from motions estimated one by one over the
/// wire.
#[tokio::test]
async fn estimated_motions_have_pytorchs_r2() {
    let server = start(Config::default()).await;
    let truth = oracle("test_twists");
    let mut predicted = ndarray::Array2::zeros(truth.dim());
    for (row, source) in (480..560u32).enumerate() {
        let (first, second) = match row % 2 {
            0 => (frame(source), frame(source + 40)),
            _ => (
                feature(feature_row(source as usize)),
                feature(feature_row(source as usize + 40)),
            ),
        };

        let request = pb::EstimateMotionRequest {
            room: "synthetic".to_owned(),
            first,
            second,
            ..Default::default()
        };
        let estimate = server.client.estimate_motion(request).await.unwrap();
        let motion = six(&estimate.motion.unwrap().twist.unwrap());
        predicted.row_mut(row).assign(&ndarray::arr1(&motion));
    }

    let stated = &json(&golden().join("m4_adapter/synthetic_expected.json"))["trained_k1"]["test_r2"]
        ["per_component"];
    for component in 0..6 {
        let y = truth.column(component);
        let p = predicted.column(component);
        let mean = y.mean().unwrap();
        let (residual, total): (f64, f64) = y.iter().zip(p).fold((0.0, 0.0), |(r, t), (y, p)| {
            (r + (y - p).powi(2), t + (y - mean).powi(2))
        });

        let r2 = 1.0 - residual / total;
        near("R²", r2, number(&stated[component]), 1e-9);
    }
}

/// Oracle: SciPy's twist of the pair, and the definitions: the truth is log(P₁⁻¹P₂), a frame is its
/// own place.
#[tokio::test]
async fn frames_of_a_room_are_answered_with_the_truth() {
    let server = start(Config::default()).await;
    let truth = oracle("test_twists");

    let estimate = async |second| {
        let request = pb::EstimateMotionRequest {
            room: "synthetic".to_owned(),
            first: frame(485),
            second,
            ..pb::EstimateMotionRequest::default()
        };
        server.client.estimate_motion(request).await.unwrap()
    };
    let answer = estimate(frame(525)).await;

    assert_eq!(answer.estimator(), pb::MotionEstimator::Adapter);
    let motion = answer.motion.unwrap();
    assert!(motion.covariance.is_empty());

    let found = six(&motion.twist.unwrap());
    let stated = six(&answer.true_motion.unwrap());
    let mut squares = 0.0;
    for component in 0..6 {
        near("truth", stated[component], truth[(5, component)], 1e-9);
        squares += (found[component] - truth[(5, component)]).powi(2);
    }

    let error = answer.error.unwrap();
    near("error", error.twist_norm, squares.sqrt(), 1e-9);

    // A feature has no pose.
    let blind = estimate(feature(feature_row(525))).await;
    assert!(blind.error.is_none() && blind.true_motion.is_none());

    let localized = server.localized(|r| {
        r.rooms = vec!["synthetic".to_owned()];
        (r.view, r.top_k) = (frame(123), Some(2));
    });
    let places = localized.await.frames;

    assert_eq!(places[0].error.as_ref().unwrap().twist_norm, 0.0);
    assert!(places[1].error.as_ref().unwrap().translation_m > 0.0);
}

/// Oracle: the definition of a closed loop over motions one after another: the second motion's goal
/// is the composed one, so going there in a list or at once ends at the same frame when each motion
/// is one step.
#[tokio::test]
async fn a_closed_loop_steers_every_motion_to_its_planned_goal() {
    let server = start(Config::default()).await;
    let first = [0.1, 0.0, 0.2, 0.0, 0.1, 0.0];
    let second = [0.2, 0.1, 0.0, 0.1, 0.0, 0.1];

    let go = async |from: u32, displacement| {
        let closed_loop = |r: &mut pb::NavigateRequest| {
            (r.source, r.motion) = (frame(from), displacement);
            r.step_mode = pb::StepMode::ClosedLoop.into();
        };
        server.navigated(closed_loop).await.steps
    };
    let both = go(500, by_twists(vec![twist(first), twist(second)])).await;

    // From the frame that the first motion retrieved, straight to the pose that the list plans.
    let goal = both[1].requested_pose.clone().unwrap();
    let reached = both[0].frames[0].frame_id;
    let direct = go(reached, to_pose(goal)).await;

    let [ours, theirs] = [&both[1].frames[0], &direct[0].frames[0]];
    assert_eq!(ours.frame_id, theirs.frame_id);
    near("distance", ours.distance, theirs.distance, 1e-9);
}

/// Oracle: the definitions. Zero motion stays put at distance 0; the open loop's end is the same in
/// any number of steps; a target frame is the same question as its pose and as its twist.
#[tokio::test]
async fn equal_questions_have_equal_answers() {
    let server = start(Config::default()).await;

    let still = |r: &mut pb::NavigateRequest| {
        (r.motion, r.steps) = (by_twist([0.0; 6]), Some(3));
    };
    for step in &server.navigated(still).await.steps {
        let nearest = &step.frames[0];
        assert_eq!((nearest.frame_id, nearest.distance), (500, 0.0));
        assert_eq!(step.error.as_ref().unwrap().twist_norm, 0.0);
    }

    let one = server.navigated(|_| ()).await;
    let end = |answer: &pb::NavigateResponse| answer.steps.last().unwrap().clone();

    let eight = server.navigated(|r| r.steps = Some(8)).await;
    assert_eq!(eight.steps.len(), 8);

    let a = end(&one).latent.unwrap().values;
    let b = end(&eight).latent.unwrap().values;
    assert!(a.iter().zip(&b).all(|(a, b)| (a - b).abs() < 1e-12));

    let target = server.localized(|r| {
        r.rooms = vec!["synthetic".to_owned()];
        r.view = frame(540);
    });
    let target = target.await;

    let pose = target.frames[0].frame.clone().unwrap().pose.unwrap();
    assert_eq!(pose.parent_frame, "rooms/synthetic");

    let motion = one.motion.unwrap();
    for displacement in [
        to_pose(pose),
        by_twists(vec![motion]),
        by_twist(six(&motion)),
    ] {
        let same = server.navigated(|r| r.motion = displacement).await;
        let [same, one] = [&same, &one].map(end);
        let [found, expected] = [&same.frames[0], &one.frames[0]];
        assert_eq!(found.frame_id, expected.frame_id);
        near("distance", found.distance, expected.distance, 1e-9);

        let [found, expected] = [same, one].map(|step| step.error.unwrap().twist_norm);
        near("error", found, expected, 1e-9);
    }
}

/// Oracle: the definitions. A frame, its feature and its latent are the same source; without a pose
/// there is no truth, so there is no error; hits say whether the error is below each threshold.
#[tokio::test]
async fn a_feature_answers_as_its_frame_does_but_knows_no_truth() {
    let server = start(Config::default()).await;
    let numbers = [0.1, 0.0, 0.3, 0.0, -0.2, 0.0];
    let from = async |source| {
        let go = |r: &mut pb::NavigateRequest| {
            (r.source, r.motion) = (source, by_twist(numbers));
            r.top_k = Some(3);
        };
        server.navigated(go).await
    };
    let frame_answer = from(frame(500)).await;

    let still = server.navigated(|r| r.motion = by_twist([0.0; 6]));
    let latent_of = still.await.steps[0].latent.clone().unwrap().values;

    for source in [feature(feature_row(500)), latent(latent_of)] {
        let answer = from(source).await;
        let frames = |answer: &pb::NavigateResponse| {
            let frames = answer.steps[0].frames.iter();
            frames.map(|hit| hit.frame_id).collect::<Vec<_>>()
        };

        assert_eq!(frames(&answer), frames(&frame_answer));
        assert!(answer.steps[0].error.is_none() && answer.steps[0].requested_pose.is_none());
        assert!(answer.motion.is_none());
    }
}

/// Oracle: the contract of exclusion and of k, and that a list of motions is their composition.
#[tokio::test]
async fn exclusion_counts_and_lists_of_motions() {
    let server = start(Config::default()).await;

    let excluded = |r: &mut pb::NavigateRequest| {
        (r.motion, r.top_k) = (by_twist([0.0; 6]), Some(20));
        (r.exclude_source, r.exclude_radius) = (true, 3);
    };
    let hits = server.navigated(excluded).await.steps[0].frames.clone();

    assert_eq!(hits.len(), 20);
    assert!(hits.iter().all(|hit| hit.frame_id.abs_diff(500) > 3));
    assert!(hits.is_sorted_by(|a, b| (a.distance, a.frame_id) < (b.distance, b.frame_id)));

    let there = twist([0.2, 0.0, 0.1, 0.0, 0.3, 0.0]);
    let back = twist([-0.2, 0.0, -0.1, 0.0, -0.3, 0.0]);
    let list = |r: &mut pb::NavigateRequest| {
        (r.motion, r.steps) = (by_twists(vec![there, back]), Some(2));
    };
    let answer = server.navigated(list).await;
    assert_eq!(answer.steps.len(), 4);

    // There and back is where it began.
    let last = &answer.steps[3];
    assert_eq!(last.frames[0].frame_id, 500);
    assert!(last.error.as_ref().unwrap().twist_norm < 1e-9);
}

/// Oracle: one question at a time.
#[tokio::test]
async fn a_batch_answers_as_its_questions_do_and_one_failure_is_alone() {
    let server = start(Config::default()).await;

    let bad = pb::NavigateRequest {
        room: "nowhere".to_owned(),
        ..question()
    };

    let snap = pb::NavigateRequest {
        step_mode: pb::StepMode::Snap.into(),
        steps: Some(4),
        ..question()
    };
    let results = server
        .client
        .batch_navigate(vec![question(), bad.clone(), snap.clone()]);
    let results = results.await.unwrap();

    let alone = [
        server.client.navigate(question()).await.unwrap(),
        server.client.navigate(snap).await.unwrap(),
    ];

    let response = |result: &pb::BatchNavigateResult| match result.result.clone().unwrap() {
        pb::batch_navigate_result::Result::Response(response) => response,
        pb::batch_navigate_result::Result::Error(error) => panic!("{}", error.message),
    };

    assert_eq!([response(&results[0]), response(&results[2])], alone);

    let Some(pb::batch_navigate_result::Result::Error(error)) = &results[1].result else {
        panic!("the second question names no room");
    };

    // The status is the one that the question alone gets, details included.
    let alone = server.client.navigate(bad).await.unwrap_err();
    assert_eq!(error.code, i32::from(tonic::Code::NotFound));
    let details = error.get_error_details();
    let missing = details.resource_info().unwrap();
    assert_eq!(missing.resource_type, "room");
    assert_eq!(missing.resource_name, "nowhere");
    assert_eq!(
        details.error_info().map(|info| info.reason.clone()),
        alone.reason()
    );
}

/// Oracle: a frame's own feature is at distance 0 from it and nothing is nearer, in one room or in
/// all.
#[tokio::test]
async fn a_mapped_feature_is_found_in_its_room() {
    let server = start(Config::default()).await;

    let localized = server.localized(|r| {
        (r.view, r.top_k) = (feature(feature_row(123)), Some(5));
    });
    let answer = localized.await;
    assert_eq!((answer.room_count, answer.frames.len()), (2, 5));

    let best = &answer.frames[0];
    let frame = best.frame.as_ref().unwrap();
    assert_eq!(best.room.as_ref().unwrap().name, "synthetic");
    assert_eq!(frame.frame_id, 123);
    assert!(frame.distance < 1e-12);
}

/// Oracle: what was published.
#[tokio::test]
async fn the_catalog_lists_what_the_store_has() {
    let server = start(Config::default()).await;
    let rooms = server.client.rooms().await.unwrap();
    let names = rooms.iter().map(|room| room.name.clone());
    let names: Vec<_> = names.collect();
    assert_eq!(names, ["synthetic", "synthetic_b"]);

    assert_eq!(rooms[0].frame_count, 600);
    assert_eq!(rooms[0].adapters, ["oracle"]);
    assert_eq!(rooms[0].feature_sources[0].dim, 48);

    let adapter = server.client.adapter("oracle").await.unwrap();
    assert_eq!((adapter.latent_dim, adapter.stride), (20, 40));
    assert_eq!(adapter.split(), pb::Split::Time);

    // A score without meaning is absent.
    assert_eq!(adapter.test.unwrap().direction, None);

    let expected = json(&golden().join("m4_adapter/synthetic_expected.json"));
    let mean = six(&adapter.target_mean.unwrap());
    let deviation = six(&adapter.target_deviation.unwrap());
    near("mu", mean[0], number(&expected["mu"][0]), 1e-12);
    near("sd", deviation[5], number(&expected["sd"][5]), 1e-12);
}

/// Oracle: the exact index.
#[tokio::test]
async fn the_hnsw_index_answers_as_the_exact_one_here_and_says_what_it_is() {
    use seese3_core::index::HnswParameters;
    use seese3_core::navigation::IndexKind;

    let index = IndexKind::Hnsw(HnswParameters::default());
    let exact = start(Config::default()).await;

    let hnsw = start(Config {
        index,
        ..Config::default()
    })
    .await;

    for source in (0..560).step_by(40) {
        let go = |r: &mut pb::NavigateRequest| {
            (r.source, r.motion) = (frame(source), to_frame(source + 40));
            r.top_k = Some(10);
        };
        let a = exact.navigated(go).await;
        let b = hnsw.navigated(go).await;
        assert_eq!(a.steps, b.steps);
        assert!(a.exact && !b.exact);
        assert_eq!([a.index.as_str(), b.index.as_str()], ["exact", "hnsw"]);
    }
}

/// Oracle: the definitions of the splits, by hand: 600 frames, of which the last 120 test.
#[tokio::test]
async fn the_pairs_of_a_split_are_listed() {
    let server = start(Config::default()).await;
    let list = async |split: pb::Split, stride| {
        let request = pb::ListPairsRequest {
            room: "synthetic".to_owned(),
            split: split.into(),
            stride,
            ..pb::ListPairsRequest::default()
        };
        server.client.list_pairs(request).await
    };

    // The adapter was trained with the time split and a stride of 40.
    let pairs = list(pb::Split::Unspecified, None).await.unwrap();
    assert_eq!((pairs.split(), pairs.stride), (pb::Split::Time, 40));
    let pairs_at = |sources: std::ops::Range<u32>, stride: u32| -> Vec<pb::FramePair> {
        let pairs = sources.map(|source| pb::FramePair {
            source_frame_id: source,
            target_frame_id: source + stride,
        });
        pairs.collect()
    };
    assert_eq!(pairs.test_pairs, pairs_at(480..560, 40));
    assert_eq!(pairs.training_pairs, pairs_at(0..440, 40));
    assert_eq!(pairs.candidate_frame_ids, (480..600).collect::<Vec<_>>());

    // Blocks 2, 7, … of 50 frames: 100 to 149, 350 to 399.
    let blocks = list(pb::Split::Blocks, Some(49)).await.unwrap();
    let expected = [pairs_at(100..101, 49), pairs_at(350..351, 49)].concat();
    assert_eq!(blocks.test_pairs, expected);
    assert!(
        blocks.candidate_frame_ids.contains(&100) && !blocks.candidate_frame_ids.contains(&150)
    );

    let error = list(pb::Split::Time, Some(120)).await.unwrap_err();
    assert_eq!(error.field().as_deref(), Some("stride"), "{error}");
}

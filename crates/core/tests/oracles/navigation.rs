//! Navigation with the reference adapter against NumPy, SciPy, scikit-learn: retrieved frames
//! identical, figures within 1e-9.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use seese3_core::adapter::{Adapter, Corrector, CorrectorKind, Error};
use seese3_core::cancel::Cancellation;
use seese3_core::eval::{Protocol, RetrievalScores, Row, evaluate};
use seese3_core::geometry::{Twist, body_twist, exp};
use seese3_core::index::{ExactIndex, Index};
use seese3_core::localization::{joint_index, localize, localize_jointly};
use seese3_core::navigation::NavigatorKind;
use seese3_core::navigation::{
    Leg, Mode, Navigator, Plan, Reading, RetrievalMetric, Search, Source, Space, StepKind, Stepper,
    walk,
};
use seese3_core::room::{FrameId, Timeline};
use seese3_core::splits::{Pair, Split};

use seese3_testing::oracle_room::{adapter_of, navigator};
use seese3_testing::{Tensors, json, near, near_each, number, worst};

const STRIDE: u32 = 40;

fn adapter(folder: &Path, room: &str) -> Arc<Adapter> {
    Arc::new(adapter_of(folder, room, 1))
}

/// The adapter with the oracle's four correctors.
fn corrected_adapter(folder: &Path, room: &str) -> Arc<Adapter> {
    let corrector = |kind: CorrectorKind| {
        let name = kind.name().replace('-', "");
        let tensors =
            Tensors::open(&folder.join(format!("navigation/{room}_corrector_{name}.safetensors")));

        Corrector::from_tensors(kind, 20, |name| {
            Ok::<_, Error>(tensors.rows(name).mapv(|x| x as f32))
        })
        .unwrap()
    };

    let correctors = CorrectorKind::ALL.map(corrector).to_vec();
    Arc::new(
        adapter_of(folder, room, 1)
            .with_correctors(correctors)
            .unwrap(),
    )
}

#[track_caller]
fn compare(what: &str, row: &Row, expected: &serde_json::Value, side: &str) {
    let latent = row.latent.unwrap();
    let numbers = [
        ("mse", latent.mse, 1e-9),
        ("r2_variance_weighted", latent.r2, 1e-8),
        ("r2_uniform", latent.r2_uniform, 1e-8),
    ];
    near_each(what, expected, &numbers);

    compare_retrieval(&format!("{what} {side}"), &row.retrieval, &expected[side]);
}

#[track_caller]
fn compare_retrieval(what: &str, scores: &RetrievalScores, expected: &serde_json::Value) {
    let count = expected["n"].as_u64().unwrap();
    assert_eq!(scores.top1.n as u64, count, "{what}");

    let numbers = [
        ("top1", scores.top1.rate, 1e-12),
        ("twist_error_mean", scores.twist_error_mean, 1e-9),
        ("twist_error_median", scores.twist_error_median, 1e-9),
        ("median_t_m", scores.translation_m_median, 1e-9),
        ("median_R_rad", scores.rotation_rad_median, 1e-9),
    ];
    near_each(what, expected, &numbers);

    for (epsilon, rate) in &scores.hits {
        let key = &epsilon.to_string()[..];
        let [low, high] = [0, 1].map(|end| number(&expected["hit_wilson95"][key][end]));
        near_each(what, &expected["hit"], &[(key, rate.rate, 1e-12)]);
        // Correlated pairs hold less information than independent trials.
        let contains = rate.low <= low + 1e-9 && high <= rate.high + 1e-9;
        assert!(
            contains,
            "{what} {key}: {rate:?}, of independent trials {low} to {high}"
        );
    }

    for recall in &scores.pose_recalls {
        let key = format!("{}m_{}deg", recall.translation_m, recall.rotation_deg);
        near_each(
            what,
            &expected["recall_t_R"],
            &[(&key, recall.rate.rate, 1e-12)],
        );
    }
}

/// The difference to Identity, by its definition, and the mean of the interval's ends.
#[track_caller]
fn compare_with_identity(row: &Row, rows: &[Row]) {
    if row.name == "identity" {
        assert!(row.hits_over_identity.is_empty());
        return;
    }

    let identity = rows.iter().find(|row| row.name == "identity").unwrap();
    assert_eq!(row.hits_over_identity.len(), row.retrieval.hits.len());
    for (place, (epsilon, over)) in row.hits_over_identity.iter().enumerate() {
        let [ours, theirs] = [row, identity].map(|row| row.retrieval.hits[place]);
        assert_eq!(*epsilon, ours.0);
        near(&row.name, over.mean, ours.1.rate - theirs.1.rate, 1e-12);
        assert!(-1.0 <= over.low && over.low <= over.mean && over.mean <= over.high);
    }
}

/// The oracle's Identity retrieves the first of the frames that look exactly alike, ours the source
/// itself: the latents' figures and the hits are the same, and the oracle's retrieval is what the
/// index gives.
fn compare_identity(row: &Row, navigator: &Navigator, expected: &serde_json::Value) {
    let count = navigator.room().frame_count();
    let timeline = Timeline::unbroken(count);
    let pairs = Split::Time.test_pairs(&timeline, STRIDE).unwrap();
    let index = ExactIndex::new(navigator.latents(), &Split::Time.candidates(&timeline));

    let first = |pair: &Pair| {
        let source = navigator.latents().row(pair.source.row()).to_vec();
        index.nearest(&source, 1, None)[0].frame
    };
    let retrieved: Vec<_> = pairs.iter().map(first).collect();

    let hits = &row.retrieval.hits;
    let thresholds: Vec<f64> = hits.iter().map(|(epsilon, _)| *epsilon).collect();
    let scores = RetrievalScores::of(&pairs, &retrieved, navigator.room().poses(), &thresholds);

    compare_retrieval("identity", &scores, &expected["source_included"]);

    assert_eq!((hits, row.retrieval.top1), (&scores.hits, scores.top1));

    let latent = row.latent.unwrap();
    let numbers = [
        ("mse", latent.mse, 1e-9),
        ("r2_variance_weighted", latent.r2, 1e-8),
    ];
    near_each("identity", expected, &numbers);
}

/// The rows of the paper's protocol with these navigators.
fn rows_of(
    navigator: &Navigator,
    exclude_source: Option<u32>,
    navigators: Vec<NavigatorKind>,
) -> Vec<Row> {
    let protocol = Protocol {
        exclude_source,
        navigators,
        ..Protocol::paper(STRIDE)
    };
    let report = evaluate(
        navigator,
        &protocol,
        &Cancellation::default(),
        &mut |_, _| (),
    );
    report.unwrap().rows
}

fn evaluated(navigator: &Navigator, exclude_source: Option<u32>) -> Vec<Row> {
    let can = |kind: &NavigatorKind| {
        let corrected = navigator.adapter().correctors().next().is_some();
        match kind {
            NavigatorKind::Step(_, RetrievalMetric::Calibrated) => false,
            NavigatorKind::Step(StepKind::Corrector(_), _) => corrected,
            NavigatorKind::Relational => false,
            _ => true,
        }
    };

    let navigators = NavigatorKind::all().into_iter().filter(can).collect();
    rows_of(navigator, exclude_source, navigators)
}

/// Oracle: NumPy's pinv and brute force, scikit-learn's scores and Ridge, SciPy's Wilson intervals.
fn the_navigation_table_matches_the_oracle(room: &str, folder: PathBuf) {
    let expected = json(&folder.join(format!("navigation/{room}_expected.json")));
    let navigator = navigator(&folder, room, corrected_adapter(&folder, room));
    for (side, exclude) in [("source_included", None), ("source_excluded", Some(0))] {
        let rows = evaluated(&navigator, exclude);
        for (ours, theirs) in [
            ("identity", "identity"),
            ("inverse-poincare-affine", "inverse_affine"),
            ("inverse-poincare-homogeneous", "inverse_homogeneous"),
            ("inverse-poincare-literal", "inverse_literal"),
            ("ridge-refit", "refit_raw_no_intercept_80_20"),
            ("ridge-refit-in-sample", "refit_raw_no_intercept_in_sample"),
            ("ridge-refit-intercept", "refit_raw_intercept_80_20"),
            (
                "ridge-refit-intercept-in-sample",
                "refit_raw_intercept_in_sample",
            ),
            ("ridge-refit-z-scored", "refit_zscored_no_intercept_80_20"),
            (
                "ridge-refit-z-scored-in-sample",
                "refit_zscored_no_intercept_in_sample",
            ),
            (
                "ridge-refit-z-scored-intercept",
                "refit_zscored_intercept_80_20",
            ),
            (
                "ridge-refit-z-scored-intercept-in-sample",
                "refit_zscored_intercept_in_sample",
            ),
            ("corrector-linear", "linear"),
            ("corrector-mlp-2", "mlp2"),
            ("corrector-mlp-3", "mlp3"),
            ("corrector-attention", "attention"),
        ] {
            let row = rows.iter().find(|row| row.name == ours).unwrap();
            compare_with_identity(row, &rows);
            if (ours, side) == ("identity", "source_included") {
                compare_identity(row, &navigator, &expected["navigators"][theirs]);
                continue;
            }

            let expected = &expected["navigators"][theirs];
            compare(&format!("{room} {ours}"), row, expected, side);
        }
    }
}

seese3_testing::on_oracle_rooms!(the_navigation_table_matches_the_oracle);

/// Oracle: NumPy, distances after the projector W⁺W on both sides.
fn retrieval_in_the_row_space_matches_the_oracle(room: &str, folder: PathBuf) {
    let expected = &json(&folder.join(format!("navigation/{room}_expected.json")))["row_space_l2"];
    let navigator = navigator(&folder, room, adapter(&folder, room));
    for (side, exclude_source) in [("source_included", None), ("source_excluded", Some(0))] {
        for (reading, theirs) in [
            (Reading::Affine, "inverse_affine"),
            (Reading::Homogeneous, "inverse_homogeneous"),
        ] {
            let step = StepKind::InversePoincare(reading);
            let kind = NavigatorKind::Step(step, RetrievalMetric::RowSpace);
            let rows = rows_of(&navigator, exclude_source, vec![kind]);
            compare_retrieval(&kind.name(), &rows[0].retrieval, &expected[theirs][side]);
        }
    }
}

seese3_testing::on_oracle_rooms!(retrieval_in_the_row_space_matches_the_oracle);

/// Oracle: the definition, candidate by candidate: the least rᵀ Σ⁻¹ r, r what is left of the wanted
/// motion when the motion that the adapter sees to the candidate, without μ, is taken off.
#[test]
fn calibrated_retrieval_is_the_least_surprising_candidate() {
    let folder = seese3_testing::golden();
    let wave = nalgebra::Matrix6::from_fn(|i, j| ((3 * i + 5 * j) as f64).sin());
    let covariance = wave * wave.transpose() + nalgebra::Matrix6::identity() * 0.3;
    let inverse = covariance.try_inverse().unwrap();

    let adapter = adapter_of(&folder, "synthetic", 1)
        .with_error_covariance(covariance)
        .unwrap();
    let navigator = navigator(&folder, "synthetic", Arc::new(adapter));
    let adapter = navigator.adapter();

    let latents = navigator.latents();
    let poses = navigator.room().poses();
    let timeline = navigator.room().timeline();
    let candidates = Split::Time.candidates(timeline);
    let search = Search::exact(RetrievalMetric::Calibrated, adapter, latents, &candidates).unwrap();

    let stepper = Stepper::InversePoincare(Reading::Homogeneous);
    for pair in Split::Time.test_pairs(timeline, STRIDE).unwrap() {
        let wanted = body_twist(&poses[pair.source.row()], &poses[pair.target.row()]);
        let here = latents.row(pair.source.row());

        let surprise = |frame: &FrameId| {
            let seen =
                adapter.motion(here, latents.row(frame.row())).to_vector() - adapter.scale().mean;
            let left = wanted.to_vector() - seen;
            (left.transpose() * inverse * left)[(0, 0)]
        };
        let least = |a: &&FrameId, b: &&FrameId| surprise(a).total_cmp(&surprise(b));
        let best = candidates.iter().min_by(least).unwrap();

        let imagined = &here + &stepper.step(adapter, here, wanted, 1.0).unwrap();
        let found = search.nearest(imagined.view(), 1, None)[0].frame;
        assert_eq!(found, *best, "source {}", pair.source);
    }

    let uncalibrated = adapter_of(&folder, "synthetic", 1);
    let metric = RetrievalMetric::Calibrated;
    assert!(Search::exact(metric, &uncalibrated, latents, &candidates).is_err());
    assert!(uncalibrated.with_error_covariance(-covariance).is_err());
}

/// Oracle: by hand. A linear corrector that moves the latent by A ΔP moves it by A ΔP in any number
/// of parts, although its input is the z-scored motion.
#[test]
fn a_corrector_walks_a_motion_in_parts() {
    let folder = seese3_testing::golden();
    let plain = adapter_of(&folder, "synthetic", 1);
    let scale = plain.scale().clone();
    let map = |row: usize, column: usize| ((row * 6 + column) as f64 * 0.7).sin();

    let read = |name: &str| {
        let bias = |row: usize| (0..6).map(|c| map(row, c) * scale.mean[c]).sum::<f64>();
        Ok::<_, Error>(match name {
            "net.bias" => ndarray::Array2::from_shape_fn((1, 20), |(_, row)| bias(row) as f32),
            _ => ndarray::Array2::from_shape_fn((20, 26), |(row, column)| match column {
                0..20 => f32::from(u8::from(row == column)),
                _ => (map(row, column - 20) * scale.deviation[column - 20]) as f32,
            }),
        })
    };

    let corrector = Corrector::from_tensors(CorrectorKind::Linear, 20, read).unwrap();
    let adapter = plain.with_correctors(vec![corrector]).unwrap();

    let twist = Twist {
        linear: [0.5, -0.2, 0.9].into(),
        angular: [0.1, 0.3, -0.2].into(),
    };

    for steps in [1u32, 2, 8] {
        let mut latent = ndarray::Array1::zeros(20);
        for _ in 0..steps {
            let step = adapter
                .corrected_step(CorrectorKind::Linear, latent.view(), twist.divided(steps))
                .unwrap();
            latent += &step;
        }

        for (row, &found) in latent.iter().enumerate() {
            let expected: f64 = (0..6).map(|c| map(row, c) * twist.to_vector()[c]).sum();
            near(&format!("{steps} steps"), found, expected, 1e-5);
        }
    }
}

/// Oracle: by hand. At the goal nothing is left to walk: what the affine reading takes off for μ,
/// in all parts together, is μ once, closed loop or not.
#[test]
fn a_closed_loop_takes_the_mean_off_once() {
    let folder = seese3_testing::golden();
    let navigator = navigator(&folder, "synthetic", adapter(&folder, "synthetic"));
    let stepper = Stepper::InversePoincare(Reading::Affine);
    let frame = FrameId(100);
    let start = navigator.start(&Source::Frame(frame), None).unwrap();

    let adapter = navigator.adapter();
    let still = Twist::default();
    let whole = adapter.inverse().step(still, Reading::Affine, 1.0);

    // Only the start can be retrieved, so every part begins there, with nothing left to walk.
    let search = Search::exact(
        RetrievalMetric::Full,
        adapter,
        navigator.latents(),
        &[frame],
    );
    let search = search.unwrap();
    let space = Space {
        search: &search,
        ..navigator.space(&stepper)
    };

    let plan = Plan {
        mode: Mode::ClosedLoop,
        steps: 4,
        top_k: 1,
        exclude_source: None,
    };

    let leg = Leg {
        motion: still,
        goal: start.pose,
    };
    for step in walk(space, &start, leg, plan, &Cancellation::default()).unwrap() {
        let moved = &step.latent - &start.latent;
        let mut parts = moved.iter().zip(&whole);
        assert!(parts.all(|(a, b)| (a - b / 4.0).abs() < 1e-12));
    }
}

/// Oracle: NumPy, a pseudo-inverse for every source with the gate that PyTorch gives it, distances
/// over both charts.
fn a_mixture_navigates_as_the_oracle(room: &str, folder: PathBuf) {
    let expected = &json(&folder.join(format!("navigation/{room}_expected.json")))["mixture_k2_inverse_affine"];
    let tensors = Tensors::open(&folder.join(format!("navigation/{room}_expected.safetensors")));
    let navigator = navigator(&folder, room, Arc::new(adapter_of(&folder, room, 2)));
    let timeline = navigator.room().timeline();
    let pairs = Split::Time.test_pairs(timeline, STRIDE).unwrap();

    let latents = navigator.latents();
    let gates = tensors.rows("mixture_k2.alpha_source");
    for (pair, gate) in pairs.iter().zip(gates.outer_iter()) {
        let latent = latents.row(pair.source.row());
        let mut found = latent.iter().skip(40).zip(gate);
        let is_near = found.all(|(a, b)| (a - b).abs() < 1e-9);
        assert!(is_near, "{room}, source {}", pair.source);
    }

    let step = StepKind::InversePoincare(Reading::Affine);
    let kind = NavigatorKind::Step(step, RetrievalMetric::Full);
    for (side, exclude_source) in [("source_included", None), ("source_excluded", Some(0))] {
        let rows = rows_of(&navigator, exclude_source, vec![kind]);
        compare("mixture", &rows[0], expected, side);
    }
}

seese3_testing::on_oracle_rooms!(a_mixture_navigates_as_the_oracle);

/// Oracle: the search of one room after the other, also for an adapter whose latents have gate weights, which distances
/// leave out.
#[test]
fn rooms_are_searched_together_as_one_by_one() {
    let folder = seese3_testing::golden();
    for charts in [1, 2] {
        let adapter = Arc::new(adapter_of(&folder, "synthetic", charts));
        let rooms = [(); 3].map(|()| navigator(&folder, "synthetic", adapter.clone()));
        let index = joint_index(&rooms).unwrap();
        for frame in [3, 100, 250].map(FrameId) {
            let mut latent = rooms[0].latents().row(frame.row()).to_owned();
            latent[2] += 0.1;
            let latent = latent.view();
            let one_by_one = localize(&rooms, latent, 20, &Cancellation::default()).unwrap();
            let together = localize_jointly(&index, |room| &rooms[room], latent, 20);
            assert_eq!(together, one_by_one, "{charts} charts");
        }
    }

    let [one, other] = [1, 2].map(|charts| {
        navigator(
            &folder,
            "synthetic",
            Arc::new(adapter_of(&folder, "synthetic", charts)),
        )
    });
    assert!(joint_index([&one, &other]).is_none());
}

/// Oracle: the definition, P(‖ΔP‖ < ε), which the oracle computed from the poses alone.
fn identity_hits_exactly_when_the_motion_is_short(room: &str, folder: PathBuf) {
    let expected = json(&folder.join(format!("navigation/{room}_expected.json")));
    let rows = evaluated(&navigator(&folder, room, adapter(&folder, room)), None);
    let identity = NavigatorKind::Identity.name();
    let identity = rows.iter().find(|row| row.name == identity).unwrap();

    for (epsilon, rate) in &identity.retrieval.hits {
        let below = number(&expected["pair_displacement"]["fraction_below"][epsilon.to_string()]);
        near("identity", rate.rate, below, 1e-12);
    }
}

seese3_testing::on_oracle_rooms!(identity_hits_exactly_when_the_motion_is_short);

/// Oracle: scipy.linalg.pinv and numpy.linalg.pinv of W.
fn the_pseudo_inverse_matches_numpy(room: &str, folder: PathBuf) {
    let tensors = Tensors::open(&folder.join(format!("navigation/{room}_expected.safetensors")));
    let adapter = adapter(&folder, room);
    let found = adapter.inverse().matrix().to_owned();
    let off = worst(&found, &tensors.rows("W_dagger"));
    assert!(off < 1e-12, "{room}: off by {off}");

    let singular = &json(&folder.join(format!("navigation/{room}_expected.json")))["W_dagger"]["singular_values"];
    for (position, value) in adapter.inverse().singular_values().into_iter().enumerate() {
        near("singular value", value, number(&singular[position]), 1e-12);
    }
}

seese3_testing::on_oracle_rooms!(the_pseudo_inverse_matches_numpy);

/// Oracle: brute force in NumPy, every retrieved frame of every step of every mode; the open loop's
/// end does not depend on the number of steps.
fn every_step_of_every_mode_retrieves_the_oracles_frame(room: &str, folder: PathBuf) {
    use Mode::{ClosedLoop, OpenLoop, Snap};
    use Reading::{Affine, Homogeneous, Literal};

    let tensors = Tensors::open(&folder.join(format!("navigation/{room}_expected.safetensors")));
    let navigator = navigator(&folder, room, adapter(&folder, room));
    let timeline = Timeline::unbroken(navigator.room().frame_count());
    let candidates = Split::Time.candidates(&timeline);
    let (adapter, latents) = (navigator.adapter(), navigator.latents());
    let search = Search::exact(RetrievalMetric::Full, adapter, latents, &candidates).unwrap();

    let pairs = Split::Time.test_pairs(&timeline, STRIDE).unwrap();
    for (name, mode, reading, exclude_source) in [
        ("open_loop_homogeneous", OpenLoop, Homogeneous, None),
        ("open_loop_affine_spread", OpenLoop, Affine, None),
        ("open_loop_literal", OpenLoop, Literal, None),
        ("snap_homogeneous", Snap, Homogeneous, None),
        ("snap_affine_spread", Snap, Affine, None),
        (
            "snap_exclude_current_homogeneous",
            Snap,
            Homogeneous,
            Some(0),
        ),
        ("snap_exclude_current_affine_spread", Snap, Affine, Some(0)),
        ("closed_loop_homogeneous", ClosedLoop, Homogeneous, None),
    ] {
        let stepper = Stepper::InversePoincare(reading);
        let space = Space {
            search: &search,
            ..navigator.space(&stepper)
        };

        for steps in [1u32, 2, 4, 8] {
            let plan = Plan {
                mode,
                steps,
                top_k: 1,
                exclude_source,
            };

            let expected = tensors.rows(&format!("retrieved.{name}.S{steps}.per_step"));
            assert_eq!(expected.dim(), (pairs.len(), steps as usize));

            for (pair, expected) in pairs.iter().zip(expected.outer_iter()) {
                let found = walk_pair(space, &navigator, *pair, plan);
                let frames = found
                    .iter()
                    .map(|step| f64::from(step.neighbors[0].frame.0));
                let frames: Vec<f64> = frames.collect();
                let source = pair.source;
                assert_eq!(
                    frames,
                    expected.to_vec(),
                    "{room} {name} in {steps}, source {source}"
                );
            }
        }
    }

    let predicted = tensors.rows("g_hat.inverse_homogeneous");
    let stepper = Stepper::InversePoincare(Reading::Homogeneous);
    let space = Space {
        search: &search,
        ..navigator.space(&stepper)
    };

    for steps in [1u32, 7] {
        let plan = Plan {
            mode: Mode::OpenLoop,
            steps,
            top_k: 1,
            exclude_source: None,
        };

        for (pair, expected) in pairs.iter().zip(predicted.outer_iter()) {
            let end = &walk_pair(space, &navigator, *pair, plan)[steps as usize - 1].latent;
            assert!(
                end.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-9),
                "{room}, {steps} steps"
            );
        }
    }
}

seese3_testing::on_oracle_rooms!(every_step_of_every_mode_retrieves_the_oracles_frame);

fn walk_pair(
    space: Space<'_>,
    navigator: &Navigator,
    pair: Pair,
    plan: Plan,
) -> Vec<seese3_core::navigation::Step> {
    let poses = navigator.room().poses();
    let start = navigator.start(&Source::Frame(pair.source), None).unwrap();
    let motion = body_twist(&poses[pair.source.row()], &poses[pair.target.row()]);
    let goal = start.pose.map(|pose| pose * exp(&motion));
    let leg = Leg { motion, goal };
    walk(space, &start, leg, plan, &Cancellation::default()).unwrap()
}

/// Oracle: as above, with φ and W frozen in a room they never saw.
#[test]
fn an_adapter_in_another_room_matches_the_oracle() {
    let folder = seese3_testing::golden();
    let expected = &json(&folder.join("navigation/synthetic_expected.json"))["cross_room_synthetic_b"]
        ["last_20_percent"];
    let navigator = navigator(&folder, "synthetic_b", adapter(&folder, "synthetic"));
    let rows = evaluated(&navigator, None);

    for (ours, theirs) in [
        ("identity", "identity"),
        ("inverse-poincare-affine", "zero_shot_affine"),
        ("inverse-poincare-homogeneous", "zero_shot_homogeneous"),
        ("ridge-refit", "refit_raw_no_intercept"),
    ] {
        let row = rows.iter().find(|row| row.name == ours).unwrap();
        compare(ours, row, &expected[theirs], "source_included");
    }
}

/// Oracle: the definitions. Zero motion stays put in the homogeneous reading, and moves by W⁺(−μ/σ)
/// in the affine.
#[test]
fn zero_motion_stays_put_only_in_the_homogeneous_reading() {
    let folder = seese3_testing::golden();
    let adapter = adapter(&folder, "synthetic");
    let step = |reading| adapter.inverse().step(Twist::default(), reading, 1.0);
    assert!(step(Reading::Homogeneous).iter().all(|&x| x == 0.0));

    let shift = step(Reading::Affine);
    let expected = &json(&folder.join("navigation/synthetic_expected.json"))["W_dagger"]["zero_motion_shift_affine"];
    for (column, &value) in shift.iter().enumerate() {
        near("shift", value, number(&expected[column]), 1e-12);
    }
}

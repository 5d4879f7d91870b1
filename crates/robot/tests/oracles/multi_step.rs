//! What does not depend on the number of steps, and what an adapter's errors are.

use nalgebra::{Matrix6, Vector6};
use ndarray::Array1;
use seese3_core::adapter::{Preset, Reading};
use seese3_core::cancel::Cancellation;
use seese3_core::geometry::body_twist;
use seese3_core::navigation::{FitOn, Leg, Mode, Plan, Refit, StepKind, walk};
use seese3_core::splits::Split;
use seese3_core::training::{RoomData, TrainingPlan, train_adapter};
use seese3_robot::calibration::calibrate_retrieval;
use seese3_robot::tracking::{View, motion};

use seese3_testing::golden;
use seese3_testing::oracle_room::{adapter_of, navigator};

/// Oracle: the definition. In an open loop the gate is the source's throughout and a
/// motion's parts are equal, so that the end does not depend on their number: for a mixture, and
/// for every refit, whose μ and intercept are spread.
#[test]
fn an_open_loop_ends_at_the_same_latent_in_any_number_of_steps() {
    let folder = golden();
    for charts in [1, 2] {
        let navigator = navigator(
            &folder,
            "synthetic",
            adapter_of(&folder, "synthetic", charts).into(),
        );
        let pairs = Split::Time
            .test_pairs(navigator.room().timeline(), 40)
            .unwrap();

        let refits = StepKind::all()
            .into_iter()
            .filter(|kind| matches!(kind, StepKind::Refit(Refit { .. })));

        let readings = [Reading::Affine, Reading::Homogeneous].map(StepKind::InversePoincare);
        for kind in readings.into_iter().chain(refits) {
            let stepper = navigator
                .stepper(
                    kind,
                    FitOn {
                        split: Split::Time,
                        stride: 40,
                    },
                )
                .unwrap();

            for pair in pairs.iter().step_by(7) {
                let end = |steps: u32| {
                    let poses = navigator.room().poses();
                    let start = navigator
                        .start(&seese3_core::navigation::Source::Frame(pair.source), None)
                        .unwrap();

                    let twist = body_twist(&poses[pair.source.row()], &poses[pair.target.row()]);
                    let leg = Leg {
                        motion: twist,
                        goal: None,
                    };

                    let plan = Plan {
                        mode: Mode::OpenLoop,
                        steps,
                        top_k: 1,
                        exclude_source: None,
                    };

                    let space = navigator.space(&stepper);
                    walk(space, &start, leg, plan, &Cancellation::default())
                        .unwrap()
                        .pop()
                        .unwrap()
                        .latent
                };

                let whole: Array1<f64> = end(1);
                let moved = (&whole - &navigator.latents().row(pair.source.row()))
                    .mapv(f64::abs)
                    .sum();

                assert!(
                    moved > 1e-3,
                    "{} in {charts} charts stays where it is",
                    kind.name()
                );

                let worst = (&end(5) - &whole)
                    .mapv(f64::abs)
                    .fold(0.0, |a: f64, &b| a.max(b));

                assert!(
                    worst < 1e-9,
                    "{} in {charts} charts: off by {worst}",
                    kind.name()
                );
            }
        }
    }
}

/// Oracle: the definition by hand, from the public reading of motion: Σ is the mean of r rᵀ over
/// all pairs at the stride, with r the true twist less the predicted one, whose mean is taken off.
#[test]
fn errors_are_the_second_moment_of_the_residuals() {
    let folder = golden();
    let seen = navigator(
        &folder,
        "synthetic",
        adapter_of(&folder, "synthetic", 1).into(),
    );

    let other = navigator(
        &folder,
        "synthetic_b",
        adapter_of(&folder, "synthetic", 1).into(),
    );

    let features = |room: &str| {
        let rows = seese3_testing::features(&folder, room);
        seese3_core::features::Features::new(
            seese3_core::features::FeatureSource::imported("oracle", 0),
            rows,
        )
        .unwrap()
    };

    let ours = features("synthetic");
    let theirs = features("synthetic_b");
    let mut plan = TrainingPlan::of(Preset::PaperBase, Split::Time, 20, 0);
    plan.config.epochs = 2;

    let data = RoomData {
        room: seen.room(),
        revision: 1,
        features: &ours,
    };
    let (adapter, record) = train_adapter(&[data], &plan, &mut |_| ()).unwrap();

    let held_out = RoomData {
        room: other.room(),
        revision: 1,
        features: &theirs,
    };
    let calibrated = calibrate_retrieval(adapter.clone(), record, &[held_out]).unwrap();
    assert_eq!(calibrated.record.calibrated_on.len(), 1);
    let calibrated = calibrated.adapter;
    let found = calibrated.error_covariance().unwrap();

    let poses = other.room().poses();
    let mut expected = Matrix6::zeros();
    let count = poses.len() - 20;
    for from in 0..count {
        let view = |row: usize| View::Feature(theirs.rows().row(row).to_vec());
        let read = motion(&adapter, &view(from), &view(from + 20)).unwrap();
        let truth = body_twist(&poses[from], &poses[from + 20]);

        let numbers = |twist: seese3_core::geometry::Twist| {
            let v = twist.linear;
            let w = twist.angular;
            Vector6::new(v.x, v.y, v.z, w.x, w.y, w.z)
        };
        let residual = numbers(truth) - (numbers(read) - adapter.scale().mean);
        expected += residual * residual.transpose() / count as f64;
    }

    let worst = (found - expected).amax() / expected.amax();
    assert!(worst < 1e-9, "off by {worst}");
}

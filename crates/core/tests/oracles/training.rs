//! The adapter's network and its optimizer against PyTorch in f64, step by step.

use std::path::{Path, PathBuf};

use ndarray::Array2;
use seese3_core::adapter::{
    Adapter, Error, Loss, Mixing, Mixture, Network, Real, Samples, Siamese, TENSOR_NAMES,
    TrainConfig, Trainer, Widths, train,
};
use seese3_core::cancel::Cancellation;
use seese3_core::features::FeatureSource;
use seese3_core::room::Timeline;
use seese3_core::splits::{Pair, Split};

use seese3_testing::oracle_room::{samples, slopes};
use seese3_testing::{Tensors, features, json, near, npy, number, worst};

fn network<T: Real>(path: &Path, prefix: &str, charts: usize) -> Mixture<T> {
    let tensors = Tensors::open(path);
    let read = |name: &str| Ok::<_, Error>(tensors.rows(&format!("{prefix}{name}")).mapv(T::of));
    Mixture::from_tensors(charts, Mixing::Gate, read).unwrap()
}

/// PyTorch's initial weights.
fn initial<T: Real>(folder: &Path, room: &str, charts: usize) -> Mixture<T> {
    let file = folder.join(format!("m4_adapter/{room}_k{charts}_init.safetensors"));
    network(&file, "", charts)
}

/// Batches as the oracle cut them: an epoch's order in pieces, the short last piece kept.
fn batches(folder: &Path, room: &str, batch: usize) -> Vec<Vec<usize>> {
    let order = npy::<u16>(&folder.join(format!("m4_adapter/{room}_batch_order.npy")));
    let mut batches = Vec::new();
    for epoch in order.outer_iter() {
        let epoch: Vec<usize> = epoch.iter().map(|&pair| usize::from(pair)).collect();
        batches.extend(epoch.chunks(batch).map(<[usize]>::to_vec));
    }
    batches
}

/// The worst difference of any tensor; the last bias has no gradient in mathematics and only noise
/// in f32.
fn difference<T: Real>(found: &Mixture<T>, expected: &Mixture<f64>, with_last_bias: bool) -> f64 {
    let tensors = found
        .names()
        .into_iter()
        .zip(found.parameters().into_iter().zip(expected.parameters()));
    let compared = tensors.filter(|(name, _)| with_last_bias || !name.ends_with("phi.3.bias"));

    compared
        .map(|(_, (a, b))| worst(&a.mapv(Real::f64), b))
        .fold(0.0, f64::max)
}

/// A run of the oracle.
struct Run {
    charts: usize,
    loss: Loss,
    /// What of the weights it keeps.
    kept: &'static [usize],
}

const PLAIN: Run = Run {
    charts: 1,
    loss: Loss::MeanSquaredError,
    kept: &[1, 50],
};

fn check<T: Real>(
    run: &Run,
    room: &str,
    folder: &Path,
    tolerance: impl Fn(&serde_json::Value, &str) -> f64,
) {
    let expected = json(&folder.join(format!("m4_adapter/{room}_expected.json")));
    let name = format!("k{}_{}", run.charts, run.loss.name());
    let reference = folder.join(format!("m4_adapter/{room}_{name}.safetensors"));
    let samples = samples::<T>(folder, room);

    for component in 0..6 {
        let [mean, deviation] = ["mu", "sd"].map(|key| number(&expected[key][component]));
        near("mu", samples.scale().mean[component], mean, 1e-12);
        near("sd", samples.scale().deviation[component], deviation, 1e-12);
    }

    let expected_run = &expected[&name];
    let batch = expected["batch_size"].as_u64().unwrap() as usize;

    let config = TrainConfig {
        batch,
        loss: run.loss,
        charts: run.charts,
        ..TrainConfig::default()
    };

    let start = initial::<T>(folder, room, run.charts);
    let mut trainer = Trainer::new(&samples, start, config);
    let is_f64 = std::mem::size_of::<T>() == 8;
    for (step, batch) in (1..=50).zip(batches(folder, room, batch)) {
        if step == 1 {
            let (_, gradient) = trainer.gradient(&batch);
            let off = difference(&gradient, &network(&reference, "grad1.", run.charts), true);
            assert!(
                off <= tolerance(expected_run, "grad1"),
                "{room} {name}: first gradient off by {off}"
            );
        }

        let report = trainer.step(&batch);
        if is_f64 {
            let keys = ["loss", "grad_norm"];
            let [loss, norm] = keys.map(|key| number(&expected_run[key][step - 1]));
            near("loss", report.loss, loss, 1e-10);
            near("gradient norm", report.gradient_norm, norm, 1e-10);
        }

        if run.kept.contains(&step) {
            let kept = format!("after{step}");
            let expected = network(&reference, &format!("{kept}."), run.charts);
            let off = difference(trainer.weights(), &expected, is_f64);
            assert!(
                off <= tolerance(expected_run, &kept),
                "{room} {name}: weights {kept} off by {off}"
            );
        }
    }
}

/// Oracle: PyTorch 2.15 in f64, 50 steps from the same weights in the same order; tolerance 1e-10.
fn fifty_steps_in_f64_match_pytorch(room: &str, folder: PathBuf) {
    check::<f64>(&PLAIN, room, &folder, |_, _| 1e-10);
}

seese3_testing::on_oracle_rooms!(fifty_steps_in_f64_match_pytorch);

/// Oracle: as above; in f32, ten times what PyTorch's own f32 run differs by.
fn fifty_steps_in_f32_stay_as_near_as_pytorch_does(room: &str, folder: PathBuf) {
    check::<f32>(&PLAIN, room, &folder, |run, name| {
        10.0 * number(&run["float32_run"]["max_abs_diff_from_float64"][name])
    });
}

seese3_testing::on_oracle_rooms!(fifty_steps_in_f32_stay_as_near_as_pytorch_does);

/// Oracle: as above, for the other losses.
fn fifty_steps_of_the_other_losses_match_pytorch(room: &str, folder: PathBuf) {
    for loss in [Loss::Cosine, Loss::Rotation] {
        let run = Run {
            charts: 1,
            loss,
            kept: &[50],
        };
        check::<f64>(&run, room, &folder, |_, _| 1e-10);
    }
}

seese3_testing::on_oracle_rooms!(fifty_steps_of_the_other_losses_match_pytorch);

/// Oracle: as above, for mixtures of two and four charts.
fn fifty_steps_of_a_mixture_match_pytorch(room: &str, folder: PathBuf) {
    for charts in [2, 4] {
        check::<f64>(&Run { charts, ..PLAIN }, room, &folder, |_, _| 1e-10);
    }
}

seese3_testing::on_oracle_rooms!(fifty_steps_of_a_mixture_match_pytorch);

/// Oracle: PyTorch's first batch through a mixture of two: the gate, both charts, and what they say
/// together.
fn a_mixtures_gate_and_charts_match_pytorch(room: &str, folder: PathBuf) {
    let mixture = initial::<f64>(&folder, room, 2);
    let expected = Tensors::open(&folder.join(format!("m4_adapter/{room}_k2_mse.safetensors")));
    let samples = samples::<f64>(&folder, room);
    let first: Vec<usize> = batches(&folder, room, 8)[0].clone();
    let rows = features(&folder, room).mapv(f64::from);
    let pairs: Vec<Pair> = Split::Time
        .train_pairs(&Timeline::unbroken(rows.nrows()), 40)
        .unwrap();

    let latents = |end: fn(&Pair) -> usize| {
        let ends: Vec<usize> = first.iter().map(|&p| end(&pairs[p])).collect();
        mixture.embed(rows.select(ndarray::Axis(0), &ends))
    };

    let from = latents(|p| p.source.row());
    let to = latents(|p| p.target.row());
    for (chart, columns) in [(0, 0..20), (1, 20..40)] {
        let g = |latents: &Array2<f64>| latents.slice(ndarray::s![.., columns.clone()]).to_owned();
        assert!(worst(&g(&from), &expected.rows(&format!("first.g_i.{chart}"))) < 1e-12);
        assert!(worst(&g(&to), &expected.rows(&format!("first.g_j.{chart}"))) < 1e-12);
    }

    let gate = from.slice(ndarray::s![.., 40..]).to_owned();
    assert!(worst(&gate, &expected.rows("first.alpha")) < 1e-12);

    let adapter = Adapter::new(
        FeatureSource::imported("oracle", rows.ncols()),
        mixture.cast::<f32>(),
        samples.scale().clone(),
    );
    let adapter = adapter.unwrap();

    for (row, y) in expected.rows("first.y").outer_iter().enumerate() {
        let motion = adapter.motion(from.row(row), to.row(row));
        let seen = samples.scale().normalized(motion);
        let is_near = seen.iter().zip(y).all(|(a, b)| (a - b).abs() < 1e-12);
        assert!(is_near, "{room}, pair {row}");
    }
}

seese3_testing::on_oracle_rooms!(a_mixtures_gate_and_charts_match_pytorch);

/// Oracle: PyTorch 2.15 after `torch.manual_seed(0)`, bit by bit; the prototypes to the last bits
/// of the sine.
fn a_seed_gives_pytorchs_initial_weights(room: &str, folder: PathBuf) {
    for charts in [1, 2, 4] {
        let expected = initial::<f32>(&folder, room, charts);
        let widths = Widths {
            feature: expected.feature_dim(),
            hidden: 64,
            latent: 20,
        };

        let found = Mixture::<f32>::initial(widths, charts, 0);
        for ((name, a), b) in expected
            .names()
            .iter()
            .zip(expected.parameters())
            .zip(found.parameters())
        {
            let off = a.iter().zip(b).map(|(a, b)| (a - b).abs());
            let off = off.fold(0.0, f32::max);
            let bound = if name == "prototypes" { 1e-6 } else { 0.0 };
            assert!(off <= bound, "{room} {name} off by {off}");
        }

        let other = Mixture::<f32>::initial(widths, charts, 1);
        assert_ne!(other, expected, "{room}");
    }
}

seese3_testing::on_oracle_rooms!(a_seed_gives_pytorchs_initial_weights);

/// Oracle: the plain chart itself, bit by bit; the fifty steps above train it as PyTorch trains the
/// plain adapter.
#[test]
fn a_mixture_of_one_is_the_plain_adapter() {
    let folder = seese3_testing::golden();
    let samples = samples::<f32>(&folder, "synthetic");
    let widths = Widths {
        feature: samples.feature_dim(),
        hidden: 64,
        latent: 20,
    };

    let chart = Siamese::<f32>::initial(widths, 7);
    let mixture = Mixture::<f32>::initial(widths, 1, 7);
    assert_eq!(mixture.names(), TENSOR_NAMES);
    assert_eq!(mixture.charts(), std::slice::from_ref(&chart));

    let rows = features(&folder, "synthetic");
    assert_eq!(mixture.embed(rows.clone()), chart.embed(rows));
}

/// Oracle: the definition: charts learned by themselves, from seeds of their own, each for its
/// share of the epochs.
#[test]
fn an_ensembles_members_are_adapters_learned_alone() {
    let samples = samples::<f32>(&seese3_testing::golden(), "synthetic");

    let alone = TrainConfig {
        epochs: 2,
        batch: 128,
        ..TrainConfig::default()
    };

    let together = TrainConfig {
        epochs: 6,
        charts: 3,
        mixing: Mixing::Even,
        ..alone.clone()
    };
    let ensemble = train(&samples, &together, &Cancellation::default(), &mut |_| ()).unwrap();

    let first = train(&samples, &alone, &Cancellation::default(), &mut |_| ()).unwrap();
    assert_eq!(ensemble.chart_count(), 3);
    assert_eq!(ensemble.charts()[0], first.charts()[0]);
    assert_ne!(ensemble.charts()[1], ensemble.charts()[0]);

    let refused = TrainConfig {
        charts: 2,
        standardize: true,
        ..alone
    };

    assert!(matches!(
        train(&samples, &refused, &Cancellation::default(), &mut |_| ()),
        Err(Error::GatedStandardized)
    ));
}

/// Oracle: features that were z-scored before training, by means and deviations taken here: the
/// weights that come back are for features as they are.
#[test]
fn weights_learned_on_z_scored_features_are_folded() {
    let folder = seese3_testing::golden();
    let rows = features(&folder, "synthetic");
    let poses = seese3_testing::poses(&folder.join("rooms/synthetic/poses.npy"));
    let pairs: Vec<[usize; 2]> = (0..500).map(|i| [i, i + 40]).collect();

    let used = rows.slice(ndarray::s![..540, ..]).mapv(f64::from);
    let mean = used.mean_axis(ndarray::Axis(0)).unwrap();
    let deviation = used.std_axis(ndarray::Axis(0), 0.0);
    let scored = ((rows.mapv(f64::from) - &mean) / &deviation).mapv(|x| x as f32);

    let config = TrainConfig {
        epochs: 3,
        batch: 100,
        ..TrainConfig::default()
    };
    let learned = |rows: &Array2<f32>, config: &TrainConfig| {
        let samples = Samples::<f32>::new(rows.view(), poses.clone(), pairs.clone()).unwrap();
        train(&samples, config, &Cancellation::default(), &mut |_| ()).unwrap()
    };

    let expected = learned(&scored, &config).embed(scored.clone());

    let standardized = TrainConfig {
        standardize: true,
        ..config
    };
    let folded = learned(&rows, &standardized).embed(rows);

    let off = worst(&folded.mapv(f64::from), &expected.mapv(f64::from));
    assert!(off < 2e-3, "off by {off}");
}

/// Oracle: by hand, two epochs of one step each. The average moves from the start by min(a, (1 +
/// t)/(10 + t)).
#[test]
fn averaged_weights_lie_between_start_and_end() {
    let samples = samples::<f32>(&seese3_testing::golden(), "synthetic");

    let one_step = TrainConfig {
        epochs: 1,
        batch: 1_000,
        ..TrainConfig::default()
    };
    let last = train(&samples, &one_step, &Cancellation::default(), &mut |_| ()).unwrap();

    let averaging = TrainConfig {
        average: 0.9,
        ..one_step
    };
    let averaged = train(&samples, &averaging, &Cancellation::default(), &mut |_| ()).unwrap();

    let widths = Widths {
        feature: samples.feature_dim(),
        hidden: 64,
        latent: 20,
    };
    let start = Mixture::<f32>::initial(widths, 1, 0);

    let share = 1.0 - 2.0 / 11.0;
    for ((start, last), averaged) in start
        .parameters()
        .iter()
        .zip(last.parameters())
        .zip(averaged.parameters())
    {
        let expected = *start + (last - *start) * share as f32;
        let mut pairs = averaged.iter().zip(&expected);
        assert!(pairs.all(|(a, b)| (a - b).abs() < 1e-6));
    }
}

/// Oracle: central differences of the loss itself, along one direction in each tensor, of every
/// loss and two gates.
#[test]
fn the_gradient_is_the_slope_of_the_loss() {
    let folder = seese3_testing::golden();
    let samples = samples::<f64>(&folder, "synthetic");
    let batch: Vec<usize> = (0..60).collect();
    for (charts, loss) in [
        (1, Loss::MeanSquaredError),
        (1, Loss::Cosine),
        (1, Loss::Rotation),
        (2, Loss::Cosine),
        (4, Loss::MeanSquaredError),
    ] {
        let start = initial::<f64>(&folder, "synthetic", charts);
        let config = TrainConfig {
            loss,
            charts,
            ..TrainConfig::default()
        };
        slopes(&start, |weights| {
            Trainer::new(&samples, weights, config.clone()).gradient(&batch)
        });
    }
}

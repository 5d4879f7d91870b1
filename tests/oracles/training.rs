//! The adapter's network and its optimiser against PyTorch in f64, step by step.

use std::path::Path;

use ndarray::Array2;
use seese3::adapter::{Real, Samples, Siamese, TENSOR_NAMES, TrainConfig, Trainer, Widths};
use seese3::geometry::body_twist;
use seese3::pairs::{Pair, Split};
use seese3::room::Timeline;

use crate::support::{Tensors, features, json, near, npy, number, oracle_rooms, poses, worst};

fn network<T: Real>(path: &Path, prefix: &str) -> Siamese<T> {
    let tensors = Tensors::open(path);
    Siamese::from_tensors(TENSOR_NAMES.map(|name| tensors.rows(&format!("{prefix}{name}")).mapv(T::of))).unwrap()
}

fn samples<T: Real>(folder: &Path, room: &str) -> Samples<T> {
    let (features, poses) = (features(folder, room), poses(&folder.join(format!("rooms/{room}/poses.npy"))));
    let pairs: Vec<Pair> = Split::Time.train_pairs(&Timeline::unbroken(poses.len()), 40).unwrap();
    let twists: Vec<_> = pairs.iter().map(|p| body_twist(&poses[p.source.row()], &poses[p.target.row()])).collect();
    Samples::new(features.view(), pairs.iter().map(|p| [p.source.row(), p.target.row()]).collect(), &twists).unwrap()
}

/// Batches as the oracle cut them: an epoch's order in pieces, the short last piece kept.
fn batches(folder: &Path, room: &str, batch: usize) -> Vec<Vec<usize>> {
    let order = npy::<u16>(&folder.join(format!("m4_adapter/{room}_batch_order.npy")));
    let epochs = order.outer_iter().map(|epoch| epoch.iter().map(|&pair| usize::from(pair)).collect::<Vec<_>>());
    epochs.flat_map(|epoch| epoch.chunks(batch).map(<[usize]>::to_vec).collect::<Vec<_>>()).collect()
}

/// The worst difference of any tensor; the last bias has no gradient in mathematics and only noise in f32.
fn difference<T: Real>(found: &Siamese<T>, expected: &Siamese<f64>, with_last_bias: bool) -> f64 {
    let tensors = TENSOR_NAMES.into_iter().zip(found.tensors().into_iter().zip(expected.tensors()));
    let compared = tensors.filter(|(name, _)| with_last_bias || *name != "phi.3.bias");
    compared.map(|(_, (a, b))| worst(&a.mapv(Real::f64), b)).fold(0.0, f64::max)
}

fn check<T: Real>(room: &str, folder: &Path, tolerance: impl Fn(&serde_json::Value, &str) -> f64) {
    let expected = json(&folder.join(format!("m4_adapter/{room}_expected.json")));
    let run = &expected["k1_mse"];
    let reference = folder.join(format!("m4_adapter/{room}_k1_mse.safetensors"));
    let samples = samples::<T>(folder, room);
    for component in 0..6 {
        near("mu", samples.scale().mean[component], number(&expected["mu"][component]), 1e-12);
        near("sd", samples.scale().deviation[component], number(&expected["sd"][component]), 1e-12);
    }
    let batch = expected["batch_size"].as_u64().unwrap() as usize;
    let config = TrainConfig { batch, ..TrainConfig::default() };
    let start = network::<T>(&folder.join(format!("m4_adapter/{room}_k1_init.safetensors")), "");
    let mut trainer = Trainer::new(&samples, start, config);
    let is_f64 = std::mem::size_of::<T>() == 8;
    for (step, batch) in (1..=50).zip(batches(folder, room, batch)) {
        if step == 1 {
            let (_, gradient) = trainer.gradient(&batch);
            let off = difference(&gradient, &network(&reference, "grad1."), true);
            assert!(off <= tolerance(run, "grad1"), "{room}: first gradient off by {off}");
        }
        let report = trainer.step(&batch);
        if is_f64 {
            near("loss", report.loss, number(&run["loss"][step - 1]), 1e-10);
            near("gradient norm", report.gradient_norm, number(&run["grad_norm"][step - 1]), 1e-10);
        }
        if step == 1 || step == 50 {
            let name = format!("after{step}");
            let off = difference(trainer.weights(), &network(&reference, &format!("{name}.")), is_f64);
            assert!(off <= tolerance(run, &name), "{room}: weights {name} off by {off}");
        }
    }
}

/// Oracle: PyTorch 2.15 in f64, 50 steps from the same weights in the same order; tolerance 1e-10.
#[test]
fn fifty_steps_in_f64_match_pytorch() {
    for (room, folder) in oracle_rooms("fifty_steps_in_f64_match_pytorch") {
        check::<f64>(room, &folder, |_, _| 1e-10);
    }
}

/// Oracle: as above; in f32, ten times what PyTorch's own f32 run differs by.
#[test]
fn fifty_steps_in_f32_stay_as_near_as_pytorch_does() {
    for (room, folder) in oracle_rooms("fifty_steps_in_f32_stay_as_near_as_pytorch_does") {
        check::<f32>(room, &folder, |run, name| 10.0 * number(&run["float32_run"]["max_abs_diff_from_float64"][name]));
    }
}

/// Oracle: PyTorch 2.15 after `torch.manual_seed(0)`, bit by bit.
#[test]
fn a_seed_gives_pytorchs_initial_weights() {
    for (room, folder) in oracle_rooms("a_seed_gives_pytorchs_initial_weights") {
        let expected = network::<f32>(&folder.join(format!("m4_adapter/{room}_k1_init.safetensors")), "");
        let widths = Widths { feature: expected.feature_dim(), hidden: 64, latent: 20 };
        assert_eq!(Siamese::<f32>::initial(widths, 0), expected, "{room}");
        assert_ne!(Siamese::<f32>::initial(widths, 1), expected, "{room}");
    }
}

/// Oracle: central differences of the loss itself, along one direction in each tensor.
#[test]
fn the_gradient_is_the_slope_of_the_loss() {
    let folder = crate::support::golden();
    let samples = samples::<f64>(&folder, "synthetic");
    let start = network::<f64>(&folder.join("m4_adapter/synthetic_k1_init.safetensors"), "");
    let batch: Vec<usize> = (0..60).collect();
    let loss = |weights: Siamese<f64>| Trainer::new(&samples, weights, TrainConfig::default()).gradient(&batch).0;
    let (_, gradient) = Trainer::new(&samples, start.clone(), TrainConfig::default()).gradient(&batch);
    for tensor in 0..TENSOR_NAMES.len() {
        let moved = |by: f64| {
            let mut tensors = start.tensors().map(Array2::clone);
            tensors[tensor].iter_mut().enumerate().for_each(|(k, x)| *x += by * ((k + 1) as f64).sin());
            loss(Siamese::from_tensors(tensors).unwrap())
        };
        let slope = (moved(1e-5) - moved(-1e-5)) / 2e-5;
        let stated: f64 = gradient.tensors()[tensor].iter().enumerate().map(|(k, g)| g * ((k + 1) as f64).sin()).sum();
        near(TENSOR_NAMES[tensor], stated, slope, 1e-6 * slope.abs().max(1e-3));
    }
}

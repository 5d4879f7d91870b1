//! Training pairs, adapter and navigator of an oracle room, and a gradient check.

use std::path::Path;
use std::sync::Arc;

use seese3_core::adapter::{Adapter, Error, Mixing, Mixture, Network, Real, Samples};
use seese3_core::features::{FeatureSource, Features};
use seese3_core::navigation::{IndexKind, Navigator};
use seese3_core::room::{Frames, Provenance, Room, RoomId, Timeline};
use seese3_core::splits::{Pair, Split};

use crate::{Tensors, features, near, poses};

/// The training pairs of an oracle room, stride 40.
pub fn samples<T: Real>(folder: &Path, room: &str) -> Samples<T> {
    let features = features(folder, room);
    let poses = poses(&folder.join(format!("rooms/{room}/poses.npy")));
    let pairs: Vec<Pair> = Split::Time
        .train_pairs(&Timeline::unbroken(poses.len()), 40)
        .unwrap();

    Samples::new(
        features.view(),
        poses,
        pairs
            .iter()
            .map(|p| [p.source.row(), p.target.row()])
            .collect(),
    )
    .unwrap()
}

/// The oracle's trained adapter with `charts` charts; μ and σ are from the training pairs.
pub fn adapter_of(folder: &Path, room: &str, charts: usize) -> Adapter {
    let tensors =
        Tensors::open(&folder.join(format!("m4_adapter/{room}_k{charts}_trained.safetensors")));
    let network = Mixture::from_tensors(charts, Mixing::Gate, |name| {
        Ok::<_, Error>(tensors.rows(name).mapv(|x| x as f32))
    })
    .unwrap();

    let scale = samples::<f32>(folder, room).scale().clone();
    Adapter::new(
        FeatureSource::imported("oracle", network.feature_dim()),
        network,
        scale,
    )
    .unwrap()
}

/// A navigator over all frames of an oracle room, with the exact index.
pub fn navigator(folder: &Path, room: &str, adapter: Arc<Adapter>) -> Navigator {
    let frames = Frames {
        poses: poses(&folder.join(format!("rooms/{room}/poses.npy"))),
        ..Frames::default()
    };

    let features =
        Features::new(FeatureSource::imported("oracle", 0), features(folder, room)).unwrap();
    let room = Room::new(RoomId::new(room).unwrap(), frames, Provenance::default()).unwrap();

    Navigator::new(Arc::new(room), &features, adapter, IndexKind::Exact).unwrap()
}

/// Checks every tensor's gradient against central differences of the loss in one direction.
pub fn slopes<N: Network<f64>>(start: &N, gradient: impl Fn(N) -> (f64, N)) {
    let (_, stated) = gradient(start.clone());
    for (tensor, name) in start.names().iter().enumerate() {
        let moved = |by: f64| {
            let mut weights = start.clone();
            let mut parameters = weights.parameters_mut();
            parameters[tensor]
                .iter_mut()
                .enumerate()
                .for_each(|(k, x)| *x += by * ((k + 1) as f64).sin());

            gradient(weights).0
        };

        let slope = (moved(1e-5) - moved(-1e-5)) / 2e-5;

        let stated: f64 = stated.parameters()[tensor]
            .iter()
            .enumerate()
            .map(|(k, g)| g * ((k + 1) as f64).sin())
            .sum();
        near(name, stated, slope, 1e-6 * slope.abs().max(1e-3));
    }
}

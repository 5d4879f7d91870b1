//! The alternatives A to D against PyTorch at fixed weights: loss, gradient, predicted motions.

use std::path::{Path, PathBuf};

use ndarray::Array2;
use seese3_core::adapter::{Network, Objective, Samples, TrainConfig, Trainer, Widths};
use seese3_core::geometry::Twist;
use seese3_core::room::Timeline;
use seese3_core::splits::{Pair, Split};
use seese3_lab::formulations::{
    AbsolutePose, DifferenceInput, Ends, GeodesicHead, UnanchoredMotion, WorldPose,
};

use seese3_testing::oracle_room::{samples, slopes};
use seese3_testing::{Tensors, digest, features, json, near, npy, number, poses, worst};

/// Weights of a seed in the precision of the tests, checked to be PyTorch's bit by bit.
fn with_weights_of<N: Network<f64>>(mut network: N, file: &Path) -> N {
    let tensors = Tensors::open(file);
    let names = network.names();
    for (name, into) in names.iter().zip(network.parameters_mut()) {
        assert_eq!(*into, tensors.rows(name), "{name} of {}", file.display());
    }

    network
}

fn check<N: Objective<f64, Data = Samples<f64>>>(
    network: &N,
    letter: &str,
    room: &str,
    folder: &Path,
) {
    let expected = json(&folder.join(format!("m4_adapter/{room}_expected.json")));
    let batch = expected["batch_size"].as_u64().unwrap() as usize;
    let order = npy::<u16>(&folder.join(format!("m4_adapter/{room}_batch_order.npy")));
    let batch: Vec<usize> = order
        .iter()
        .take(batch)
        .map(|&pair| usize::from(pair))
        .collect();

    let samples = samples::<f64>(folder, room);
    let (loss, gradient) =
        Trainer::new(&samples, network.clone(), TrainConfig::default()).gradient(&batch);
    let expected = &expected["alternatives"][letter];

    near(
        "loss",
        loss,
        number(&expected["loss"]),
        1e-10 * loss.max(1.0),
    );

    for (name, tensor) in gradient.names().iter().zip(gradient.parameters()) {
        let norm = number(&expected["grad_norm"][name]);
        near(
            name,
            tensor.iter().map(|x| x * x).sum::<f64>().sqrt(),
            norm,
            1e-9 * norm.max(1.0),
        );

        for (found, stated) in digest(tensor)
            .into_iter()
            .zip(expected["grad_digest"][name].as_array().unwrap())
        {
            near(name, found, number(stated), 1e-8 * (norm * norm).max(1.0));
        }
    }
}

/// The first eight test pairs' features, and the poses of their sources.
fn ends(folder: &Path, room: &str) -> ([Array2<f32>; 2], Vec<seese3_core::geometry::Pose>) {
    let rows = features(folder, room);
    let poses = poses(&folder.join(format!("rooms/{room}/poses.npy")));
    let pairs: Vec<Pair> = Split::Time
        .test_pairs(&Timeline::unbroken(poses.len()), 40)
        .unwrap();

    let of = |end: fn(&Pair) -> usize| {
        rows.select(
            ndarray::Axis(0),
            &pairs.iter().take(8).map(end).collect::<Vec<_>>(),
        )
    };

    let sources = pairs
        .iter()
        .take(8)
        .map(|pair| poses[pair.source.row()])
        .collect();

    (
        [of(|pair| pair.source.row()), of(|pair| pair.target.row())],
        sources,
    )
}

#[track_caller]
fn same_motions(letter: &str, found: &[Twist], room: &str, folder: &Path) {
    let expected =
        Tensors::open(&folder.join(format!("m4_adapter/{room}_alternatives.safetensors")));
    let expected = expected.rows(&format!("alt{letter}.test_body_twist_first8"));
    let found = Array2::from_shape_fn((8, 6), |(row, column)| found[row].to_vector()[column]);
    let off = worst(&found, &expected);

    assert!(off < 1e-9, "{room} {letter}: off by {off}");
}

/// Oracle: PyTorch's autograd through its own logarithm, at the weights of its seeds 1 to 4; the
/// motions by NumPy.
fn the_alternatives_match_pytorch(room: &str, folder: PathBuf) {
    let file =
        |letter: &str| folder.join(format!("m4_adapter/{room}_alt{letter}_init.safetensors"));
    let (rows, sources) = ends(&folder, room);
    let widths = Widths {
        feature: rows[0].ncols(),
        hidden: 64,
        latent: 20,
    };

    let features = || [rows[0].view(), rows[1].view()];

    let a = with_weights_of(
        UnanchoredMotion(WorldPose::<f64>::initial(widths, 1)),
        &file("A"),
    );
    check(&a, "A", room, &folder);

    same_motions(
        "A",
        &a.0.motion(Ends {
            features: features(),
            sources: &sources,
        }),
        room,
        &folder,
    );

    let b = with_weights_of(
        AbsolutePose(WorldPose::<f64>::initial(widths, 4)),
        &file("B"),
    );
    check(&b, "B", room, &folder);

    same_motions(
        "B",
        &b.0.motion(Ends {
            features: features(),
            sources: &sources,
        }),
        room,
        &folder,
    );

    let c = with_weights_of(GeodesicHead::<f64>::initial(widths, 2), &file("C"));
    check(&c, "C", room, &folder);
    same_motions("C", &c.motions(features()), room, &folder);
    let d = with_weights_of(DifferenceInput::<f64>::initial(widths, 3), &file("D"));
    check(&d, "D", room, &folder);

    let scale = samples::<f64>(&folder, room).scale().clone();
    same_motions("D", &d.motions(features(), &scale), room, &folder);
}

seese3_testing::on_oracle_rooms!(the_alternatives_match_pytorch);

/// Oracle: central differences of the losses.
#[test]
fn the_alternatives_gradients_are_the_slopes_of_their_losses() {
    let folder = seese3_testing::golden();
    let samples = samples::<f64>(&folder, "synthetic");
    let widths = Widths {
        feature: samples.feature_dim(),
        hidden: 5,
        latent: 4,
    };

    let batch: Vec<usize> = (0..20).collect();
    let config = TrainConfig::default;
    let a = UnanchoredMotion(WorldPose::<f64>::initial(widths, 5));
    slopes(&a, |weights| {
        Trainer::new(&samples, weights, config()).gradient(&batch)
    });

    let b = AbsolutePose(WorldPose::<f64>::initial(widths, 5));
    slopes(&b, |weights| {
        Trainer::new(&samples, weights, config()).gradient(&batch)
    });

    let c = GeodesicHead::<f64>::initial(widths, 5);
    slopes(&c, |weights| {
        Trainer::new(&samples, weights, config()).gradient(&batch)
    });

    let d = DifferenceInput::<f64>::initial(widths, 5);
    slopes(&d, |weights| {
        Trainer::new(&samples, weights, config()).gradient(&batch)
    });
}

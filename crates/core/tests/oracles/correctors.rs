//! The four correctors against PyTorch: outputs, gradients, twenty steps of AdamW.

use seese3_core::adapter::{
    Corrector, CorrectorKind, CorrectorSamples, Error, Network, TrainConfig, Trainer,
};

use seese3_testing::oracle_room::slopes;
use seese3_testing::{Tensors, digest, golden, json, near, number, worst};

/// The oracle's name of a corrector.
fn oracle_name(kind: CorrectorKind) -> &'static str {
    match kind {
        CorrectorKind::Linear => "linear",
        CorrectorKind::Mlp2 => "mlp2",
        CorrectorKind::Mlp3 => "mlp3",
        CorrectorKind::Attention => "attention",
    }
}

fn initial(kind: CorrectorKind) -> Corrector<f64> {
    let file = golden().join(format!(
        "m4_adapter/corrector_{}_init.safetensors",
        oracle_name(kind)
    ));
    let tensors = Tensors::open(&file);

    Corrector::from_tensors(kind, 20, |name| Ok::<_, Error>(tensors.rows(name))).unwrap()
}

fn samples() -> (Tensors, CorrectorSamples<f64>) {
    let io = Tensors::open(&golden().join("m4_adapter/correctors_io.safetensors"));
    let latents = io.rows("g");
    let motions = io.rows("p");
    let imagined = &latents + &motions.dot(&io.rows("W_dagger").t());

    let targets = io.rows("target");
    (
        io,
        CorrectorSamples {
            latents,
            motions,
            imagined,
            targets,
        },
    )
}

/// Oracle: PyTorch 2.15 in f64 (attention also derived anew in NumPy), from the weights of its seed
/// 5.
#[test]
fn correctors_match_pytorch() {
    let (io, samples) = samples();
    let expected = json(&golden().join("m4_adapter/correctors_expected.json"));
    let all: Vec<usize> = (0..samples.latents.nrows()).collect();
    for kind in CorrectorKind::ALL {
        let name = oracle_name(kind);
        let start = initial(kind);
        assert_eq!(
            start.cast::<f32>(),
            Corrector::<f32>::initial(kind, 20, 5),
            "{name}: PyTorch's weights, bit by bit"
        );

        let output = start.output(samples.latents.view(), samples.motions.view());
        assert!(
            worst(&output, &io.rows(&format!("{name}.net"))) < 1e-12,
            "{name}"
        );

        let expected = &expected[name];
        assert_eq!(kind.has_residual(), expected["residual"].as_bool().unwrap());

        let config = TrainConfig {
            batch: all.len(),
            ..TrainConfig::default()
        };
        let mut trainer = Trainer::new(&samples, start, config);
        let (_, gradient) = trainer.gradient(&all);

        for (tensor, array) in gradient.names().iter().zip(gradient.parameters()) {
            for (found, stated) in digest(array)
                .into_iter()
                .zip(expected["grad_digest_step1"][tensor].as_array().unwrap())
            {
                near(&format!("{name} {tensor}"), found, number(stated), 1e-10);
            }
        }

        for step in 0..20 {
            near(
                name,
                trainer.step(&all).loss,
                number(&expected["losses_20_steps"][step]),
                1e-10,
            );
        }
    }
}

/// Oracle: central differences of the loss.
#[test]
fn correctors_gradients_are_the_slopes_of_their_losses() {
    let (_, samples) = samples();
    let batch: Vec<usize> = (0..9).collect();
    for kind in CorrectorKind::ALL {
        slopes(&initial(kind), |weights| {
            Trainer::new(&samples, weights, TrainConfig::default()).gradient(&batch)
        });
    }
}

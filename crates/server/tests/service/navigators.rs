//! Every navigator over the wire: correctors, refits, metrics, mixtures.

use seese3_client::proto::v1 as pb;
use seese3_core::adapter::{Adapter, Corrector, CorrectorKind, Error, Mixing, Mixture};
use seese3_server::Config;
use seese3_store::Store;

use crate::harness::{
    TestServer, features_of, frame, latent, oracle, oracle_adapter, question, record, room_of,
    start_on, to_frame,
};
use seese3_testing::{Tensors, golden, json, near, number};

/// The oracle's correctors on its adapter.
fn corrected() -> Adapter {
    let corrector = |kind: CorrectorKind| {
        let file = format!(
            "navigation/synthetic_corrector_{}.safetensors",
            kind.name().replace('-', "")
        );
        let tensors = Tensors::open(&golden().join(file));

        Corrector::from_tensors(kind, 20, |name| {
            Ok::<_, Error>(tensors.rows(name).mapv(|x| x as f32))
        })
        .unwrap()
    };

    oracle_adapter()
        .with_correctors(CorrectorKind::ALL.map(corrector).to_vec())
        .unwrap()
}

/// The oracle's mixture of two.
fn mixture() -> Adapter {
    let tensors = Tensors::open(&golden().join("m4_adapter/synthetic_k2_trained.safetensors"));
    let read = |name: &str| Ok::<_, Error>(tensors.rows(name).mapv(|x| x as f32));
    let network = Mixture::from_tensors(2, Mixing::Gate, read).unwrap();
    let plain = oracle_adapter();

    Adapter::new(plain.source().clone(), network, plain.scale().clone()).unwrap()
}

async fn start_with(adapter: &Adapter) -> TestServer {
    let folder = tempfile::tempdir().unwrap();
    let store = Store::create(folder.path().to_str().unwrap()).unwrap();

    store
        .publish_room(
            &room_of("synthetic", "synthetic"),
            &[features_of("synthetic")],
        )
        .await
        .unwrap();

    store
        .publish_adapter(
            "oracle",
            adapter,
            &record(),
            features_of("synthetic").rows(),
        )
        .await
        .unwrap();

    start_on(folder, store, Config::default()).await
}

async fn imagined(server: &TestServer, navigator: &str, source: u32) -> pb::NavigateResponse {
    let request = pb::NavigateRequest {
        source: frame(source),
        motion: to_frame(source + 40),
        navigator: navigator.to_owned(),
        ..question()
    };
    server.client.navigate(request).await.unwrap()
}

/// Oracle: PyTorch's correctors and scikit-learn's refits: ĝ of every test pair, number by number.
#[tokio::test]
async fn navigators_imagine_what_the_oracle_imagines() {
    let server = start_with(&corrected()).await;
    for (ours, theirs) in [
        ("inverse-poincare-affine", "g_hat.inverse_affine"),
        ("inverse-poincare-homogeneous", "g_hat.inverse_homogeneous"),
        ("inverse-poincare-literal", "g_hat.inverse_literal"),
        ("corrector-linear", "g_hat.linear"),
        ("corrector-mlp-2", "g_hat.mlp2"),
        ("corrector-mlp-3", "g_hat.mlp3"),
        ("corrector-attention", "g_hat.attention"),
        ("ridge-refit", "g_hat.refit_raw_no_intercept_80_20"),
        (
            "ridge-refit-z-scored-intercept",
            "g_hat.refit_zscored_intercept_80_20",
        ),
        (
            "ridge-refit+row-space",
            "g_hat.refit_raw_no_intercept_80_20",
        ),
    ] {
        for (source, expected) in (480..560).zip(oracle(theirs).outer_iter()) {
            let answer = imagined(&server, ours, source).await;
            assert_eq!(answer.navigator, ours);

            let found = &answer.steps[0].latent.as_ref().unwrap().values;
            assert!(
                found
                    .iter()
                    .zip(expected)
                    .all(|(a, b)| (a - b).abs() < 1e-9),
                "{ours} from {source}"
            );
        }
    }
}

/// Oracle: NumPy's table of the four correctors, through Evaluate.
#[tokio::test]
async fn an_adapters_table_has_its_correctors() {
    let server = start_with(&corrected()).await;

    let request = pb::EvaluateRequest {
        room: "synthetic".to_owned(),
        ..pb::EvaluateRequest::default()
    };
    let report = server.client.evaluate(request, |_| ()).await.unwrap();

    let expected = &json(&golden().join("navigation/synthetic_expected.json"))["navigators"];
    for (ours, theirs) in [
        ("corrector-linear", "linear"),
        ("corrector-mlp-2", "mlp2"),
        ("corrector-mlp-3", "mlp3"),
        ("corrector-attention", "attention"),
    ] {
        let row = report
            .navigators
            .iter()
            .find(|row| row.name == ours)
            .unwrap();

        near(
            ours,
            row.latent_mse.unwrap(),
            number(&expected[theirs]["mse"]),
            1e-9,
        );

        let hits = &expected[theirs]["source_included"]["hit"];
        for hit in &row.hit_rates {
            near(
                ours,
                hit.proportion.unwrap().value,
                number(&hits[hit.threshold.to_string()]),
                1e-12,
            );
        }
    }

    let adapters = server.client.adapters().await.unwrap();
    for name in [
        "corrector-attention",
        "ridge-refit-intercept-in-sample",
        "inverse-poincare-literal",
    ] {
        assert!(
            adapters[0].navigators.iter().any(|known| known == name),
            "{name}"
        );
    }
}

/// Oracle: NumPy's mixture: the gate frozen at the source, both charts looked at; a latent that
/// came back is a view.
#[tokio::test]
async fn a_mixture_answers_and_takes_its_own_latents() {
    let server = start_with(&mixture()).await;
    let expected = oracle("g_hat.mixture_k2_inverse_affine");
    let gates = oracle("mixture_k2.alpha_source");
    for ((source, expected), gate) in (480..560)
        .zip(expected.outer_iter())
        .zip(gates.outer_iter())
    {
        let answer = imagined(&server, "inverse-poincare-affine", source).await;
        let found = answer.steps[0].latent.clone().unwrap().values;
        assert_eq!(found.len(), 42);

        assert!(
            found
                .iter()
                .zip(expected.iter().chain(gate))
                .all(|(a, b)| (a - b).abs() < 1e-9),
            "from {source}"
        );
    }

    let answer = imagined(&server, "inverse-poincare-affine", 480).await;
    let values = answer.steps[0].latent.clone().unwrap().values;
    let place = pb::LocalizeRequest {
        view: latent(values.clone()),
        ..pb::LocalizeRequest::default()
    };
    let places = server.client.localize(place).await.unwrap().frames;

    assert_eq!(
        places[0].frame.as_ref().unwrap().frame_id,
        answer.steps[0].frames[0].frame_id
    );

    let mut broken = values;
    broken[41] += 0.5;

    let place = pb::LocalizeRequest {
        view: latent(broken),
        ..pb::LocalizeRequest::default()
    };
    let refused = server.client.localize(place).await.unwrap_err();

    assert_eq!(refused.code(), Some(tonic::Code::InvalidArgument));
    assert!(refused.to_string().contains("gate"), "{}", refused);
}

/// Oracle: by hand: what an adapter lacks, or what is no way to step, is refused by the field's
/// name.
#[tokio::test]
async fn navigators_that_cannot_answer_are_refused() {
    let server = start_with(&oracle_adapter()).await;
    for (navigator, inverse_variant, field) in [
        ("corrector-mlp-2", 0, "navigator"),
        ("inverse-poincare-affine+calibrated", 0, "navigator"),
        ("no-such", 0, "navigator"),
        ("identity", 0, "navigator"),
        ("ridge-refit+no-such", 0, "navigator"),
        ("ridge-refit", 2, "inverse_variant"),
    ] {
        let request = pb::NavigateRequest {
            navigator: navigator.to_owned(),
            inverse_variant,
            ..question()
        };
        let refused = server.client.navigate(request).await.unwrap_err();

        assert_eq!(
            refused.code(),
            Some(tonic::Code::InvalidArgument),
            "{navigator}"
        );

        assert!(
            refused.to_string().contains(field),
            "{navigator}: {}",
            refused
        );
    }

    let request = pb::EvaluateRequest {
        room: "synthetic".to_owned(),
        navigators: vec!["corrector-linear".to_owned()],
        ..pb::EvaluateRequest::default()
    };
    let refused = server.client.evaluate(request, |_| ()).await.unwrap_err();

    assert_eq!(refused.code(), Some(tonic::Code::InvalidArgument));
    assert!(refused.to_string().contains("corrector"), "{}", refused);
}

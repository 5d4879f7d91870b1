//! Encoders against NumPy, PyTorch and Pillow: tiny models everywhere, real ones where the folder
//! of large inputs is.

use std::path::{Path, PathBuf};

use ndarray::{Array2, ArrayD};
use safetensors::SafeTensors;
use seese3_core::features::FeatureSource;
use seese3_core::image::RgbImage;
use seese3_encoder::{
    Bounds, Device, Encoder, Error, Filter, Layer, ModelTask, Preparation, Resize, Runtime,
    RuntimeKind, decode, normalized, read_image, recipe,
};
use seese3_testing::{Tensors, golden, json, npy, number, shared};

/// The runtimes that this build has and this machine can run; at least one, or the tests that loop
/// over them would assert nothing.
fn runtimes() -> Vec<Runtime> {
    let library = std::env::var_os("ORT_DYLIB_PATH").map(PathBuf::from);
    let can_run = |kind: RuntimeKind| match kind {
        RuntimeKind::Tract => true,
        RuntimeKind::OnnxRuntime => library.is_some(),
    };

    let runtimes: Vec<Runtime> = [RuntimeKind::Tract, RuntimeKind::OnnxRuntime]
        .into_iter()
        .filter(|kind| kind.is_built() && can_run(*kind))
        .map(|kind| Runtime {
            kind,
            threads: 2,
            library: library.clone(),
            device: Device::Cpu,
        })
        .collect();

    assert!(
        !runtimes.is_empty(),
        "build with --features onnx, or with onnxruntime and its library in ORT_DYLIB_PATH"
    );
    runtimes
}

fn layer(name: &str, pooling: &str) -> Layer {
    let pooling = pooling.parse().unwrap();
    Layer {
        name: name.to_owned(),
        base: "name".to_owned(),
        norm: "none".to_owned(),
        pooling,
    }
}

fn centered() -> Preparation {
    Preparation {
        divisor: 255.0,
        mean: [0.5; 3],
        deviation: [0.25; 3],
        ..Preparation::default()
    }
}

fn tiny(file: &str, layers: Vec<Layer>, window: usize) -> ModelTask {
    let preparation = Preparation {
        resize: Resize::Whole {
            width: 8,
            height: 6,
        },
        ..centered()
    };

    ModelTask {
        file: golden().join("encoder").join(file),
        preparation,
        layers,
        window,
        keypoints: None,
        is_prefix_stated: false,
    }
}

/// A task of one layer of a tiny model of single images.
fn tiny_layer(file: &str, name: &str, pooling: &str) -> ModelTask {
    tiny(file, vec![layer(name, pooling)], 1)
}

/// Each image as a clip.
fn alone(images: &[RgbImage]) -> Vec<Vec<&RgbImage>> {
    images.iter().map(|image| vec![image]).collect()
}

#[track_caller]
fn refused(model: Result<Encoder, Error>, word: &str) {
    let message = model.map(|_| ()).unwrap_err().to_string();
    assert!(message.contains(word), "{message}");
}

fn tiny_images() -> Vec<RgbImage> {
    let bytes = std::fs::read(golden().join("encoder/expected.safetensors")).unwrap();
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let pixels = file.tensor("pixels").unwrap().data().to_vec();

    pixels
        .chunks(6 * 8 * 3)
        .map(|bytes| RgbImage {
            width: 8,
            height: 6,
            bytes: bytes.to_vec(),
        })
        .collect()
}

fn close(what: &str, found: &Array2<f32>, expected: &Array2<f64>, bound: f64) {
    assert_eq!(found.dim(), expected.dim(), "{what}");

    let worst = found
        .iter()
        .zip(expected)
        .map(|(a, b)| (f64::from(*a) - b).abs())
        .fold(0.0, f64::max);

    assert!(worst <= bound, "{what}: {worst} off, over {bound}");
}

/// Oracle: the layers' arithmetic in NumPy. Declared outputs and an inner value, several in one
/// pass, each pooled.
#[test]
#[cfg_attr(
    not(any(feature = "onnx", feature = "onnxruntime")),
    ignore = "built without a runtime of models"
)]
fn layers_of_a_tiny_model_are_what_numpy_says() {
    let expected = Tensors::open(&golden().join("encoder/expected.safetensors"));
    let images = tiny_images();
    let clips = alone(&images);
    for runtime in runtimes() {
        let cases = [
            ("map", "mean", "map_mean"),
            ("map", "grid2x2", "map_grid2x2"),
            ("tokens", "mean", "map_mean"),
            ("tokens", "grid2x2", "map_grid2x2"),
            ("classed", "cls", "vector"),
            ("classed", "mean@1", "map_mean"),
            ("classed", "grid2x2@1", "map_grid2x2"),
            ("vector", "mean", "vector"),
            ("hidden", "mean", "hidden_mean"),
        ];

        for (name, pooling, wanted) in cases {
            let task = tiny_layer("image.onnx", name, pooling);
            let encoder = Encoder::model(task, &runtime).unwrap();
            let what = format!("{wanted} by {}", encoder.runtime());
            let rows = encoder.encode(&clips).unwrap();
            close(&what, &rows, &expected.rows(wanted), 1e-5);
        }

        let several = vec![
            layer("hidden", "mean"),
            layer("map", "grid2x2"),
            layer("vector", "mean"),
        ];
        let encoder = Encoder::model(tiny("image.onnx", several, 1), &runtime).unwrap();

        assert_eq!(encoder.dims(), [4, 16, 4]);

        let rows = encoder.encode(&clips).unwrap();
        let middle = rows.slice_move(ndarray::s![.., 4..20]);
        close(
            "middle columns",
            &middle,
            &expected.rows("map_grid2x2"),
            1e-5,
        );

        let names = encoder.sources("m").into_iter().map(|source| source.name);
        let names: Vec<String> = names.collect();
        assert_eq!(names, ["m-hidden-mean", "m-map-grid2x2", "m-vector"]);
    }
}

/// Oracle: NumPy, on four frames around each of five, in both layouts of a clip.
#[test]
#[cfg_attr(
    not(any(feature = "onnx", feature = "onnxruntime")),
    ignore = "built without a runtime of models"
)]
fn clips_are_laid_out_as_their_model_wants_them() {
    let expected = Tensors::open(&golden().join("encoder/expected.safetensors"));
    let images = tiny_images();

    let around = [
        [0, 0, 0, 1],
        [0, 0, 1, 2],
        [0, 1, 2, 3],
        [1, 2, 3, 4],
        [2, 3, 4, 4],
    ];

    let clips: Vec<Vec<&RgbImage>> = around
        .iter()
        .map(|rows| rows.iter().map(|&row| &images[row]).collect())
        .collect();

    for runtime in runtimes() {
        for file in ["clip_time_first.onnx", "clip_colour_first.onnx"] {
            let of_window = |window| {
                let task = tiny(file, vec![layer("colours", "mean")], window);
                Encoder::model(task, &runtime)
            };
            let rows = of_window(4).unwrap().encode(&clips).unwrap();
            close(file, &rows, &expected.rows("clip_colours_mean"), 1e-5);
            assert!(of_window(3).is_err());
        }
    }
}

/// Oracle: a list of bad model files, each with what its error has to name.
#[test]
#[cfg_attr(
    not(any(feature = "onnx", feature = "onnxruntime")),
    ignore = "built without a runtime of models"
)]
fn models_that_cannot_be_used_are_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let broken = folder.path().join("broken.onnx");
    let whole = std::fs::read(golden().join("encoder/image.onnx")).unwrap();
    for runtime in runtimes() {
        let task = |name: &str, pooling: &str| tiny_layer("image.onnx", name, pooling);
        let map = layer("map", "mean");
        let with = |preparation| ModelTask {
            preparation,
            ..task("map", "mean")
        };
        let nowhere = ModelTask {
            file: "nowhere.onnx".into(),
            ..task("map", "mean")
        };
        let wrong_size = with(Preparation {
            resize: Resize::Whole {
                width: 9,
                height: 6,
            },
            ..centered()
        });
        let no_divisor = with(Preparation {
            divisor: 0.0,
            ..task("map", "mean").preparation
        });

        let two_maps = tiny("image.onnx", vec![map.clone(), map.clone()], 1);
        let clips = tiny("image.onnx", vec![map], 4);
        for (task, word) in [
            (task("block9", "mean"), "map, tokens, vector"),
            (task("map", "cls"), "cannot be pooled"),
            (
                task("classed", "grid2x2"),
                "12 patches of the image and 1 before",
            ),
            (task("classed", "mean"), "--prefix-tokens 1"),
            (
                tiny_layer("pairs.onnx", "vector", "mean"),
                "exactly 2 images",
            ),
            (task("tokens", "cls"), "--prefix-tokens 0"),
            (two_maps, "twice"),
            (tiny("image.onnx", Vec::new(), 1), "no layer"),
            (clips, "single images"),
            (nowhere, "nowhere.onnx"),
            (wrong_size, "8x6"),
            (no_divisor, "divisor"),
        ] {
            refused(Encoder::model(task, &runtime), word);
        }

        // Whoever says that every token counts is believed.
        let stated = ModelTask {
            keypoints: None,
            is_prefix_stated: true,
            ..task("classed", "mean")
        };
        assert!(Encoder::model(stated, &runtime).is_ok());

        for cut in [0, 1, 10, whole.len() / 2, whole.len() - 1] {
            std::fs::write(&broken, &whole[..cut]).unwrap();

            let broken = ModelTask {
                file: broken.clone(),
                ..task("map", "mean")
            };

            assert!(Encoder::model(broken, &runtime).is_err(), "cut at {cut}");
        }
    }
}

/// Oracle: what a source says, and that a runtime that is not built names the line that builds it.
#[test]
#[cfg_attr(
    not(any(feature = "onnx", feature = "onnxruntime")),
    ignore = "built without a runtime of models"
)]
fn an_encoder_is_built_again_from_what_its_features_say() {
    let images = tiny_images();
    let file = golden().join("encoder/image.onnx");
    let models = ["pixels".to_owned(), file.to_str().unwrap().to_owned()];
    for runtime in runtimes() {
        let of_source = |source: &FeatureSource, models: &[String]| {
            Encoder::of_source(source, models, &runtime).unwrap()
        };
        let task = tiny_layer("image.onnx", "map", "grid2x2");
        let first = Encoder::model(task, &runtime).unwrap();
        let source = &first.sources("m")[0];
        let again = of_source(source, &models).unwrap();

        assert_eq!(&again.sources("m")[0], source);

        assert_eq!(
            again.encode(&[vec![&images[0]]]).unwrap(),
            first.encode(&[vec![&images[0]]]).unwrap()
        );

        let other = FeatureSource {
            encoder: "image@0000".to_owned(),
            ..source.clone()
        };
        assert!(of_source(&other, &models).is_none());

        let pixels = &Encoder::pixels().sources("p")[0];
        let again = of_source(pixels, &models).unwrap();
        assert_eq!(&again.sources("p")[0], pixels);
        assert!(of_source(pixels, &models[1..]).is_none());
    }

    for kind in [RuntimeKind::Tract, RuntimeKind::OnnxRuntime] {
        let runtime = Runtime {
            kind,
            threads: 1,
            library: None,
            device: Device::Cpu,
        };

        let task = tiny_layer("image.onnx", "map", "mean");
        match Encoder::model(task, &runtime) {
            Err(error @ Error::NotBuilt { .. }) => {
                assert!(error.to_string().contains("--features full"))
            }
            Err(error) => assert!(
                kind.is_built() && error.to_string().contains("pip install onnxruntime"),
                "{error}"
            ),
            Ok(_) => assert!(kind == RuntimeKind::Tract && kind.is_built()),
        }
    }
}

/// Oracle: the contract: a device that the runtime cannot use is an error, never another device.
#[test]
#[cfg_attr(
    not(any(feature = "onnx", feature = "onnxruntime")),
    ignore = "built without a runtime of models"
)]
fn a_device_that_cannot_be_used_is_refused() {
    for runtime in runtimes() {
        // A machine of the tests has fewer GPUs, or none.
        let device = Device::Cuda(999);
        let expected = match runtime.kind {
            RuntimeKind::Tract => "runs on the CPU only; for device cuda:999",
            RuntimeKind::OnnxRuntime => "device cuda:999 cannot be used",
        };
        let runtime = Runtime { device, ..runtime };
        refused(
            Encoder::model(tiny_layer("image.onnx", "map", "mean"), &runtime),
            expected,
        );
    }
}

/// Oracle: by hand: a layer whose first axis is not the batch, and one without axes, are no
/// features of single images.
#[test]
#[cfg_attr(
    not(any(feature = "onnx", feature = "onnxruntime")),
    ignore = "built without a runtime of models"
)]
fn a_layer_that_does_not_count_images_is_refused() {
    for runtime in runtimes() {
        for name in ["turned", "scalar"] {
            let turned = tiny_layer("turned.onnx", name, "mean");
            refused(Encoder::model(turned, &runtime), name);
        }

        for word in ["outside.bin", "beside the model"] {
            let outside = tiny_layer("outside.onnx", "map", "mean");
            refused(Encoder::model(outside, &runtime), word);
        }
    }
}

/// Oracle: NumPy, as for the same model in one file; and the definition of an identity: other
/// weights are another encoder.
#[test]
#[cfg_attr(
    not(any(feature = "onnx", feature = "onnxruntime")),
    ignore = "built without a runtime of models"
)]
fn weights_may_lie_beside_the_model() {
    let expected = Tensors::open(&golden().join("encoder/expected.safetensors"));
    let images = tiny_images();
    let clips = alone(&images);
    let whole = golden().join("encoder");

    for runtime in runtimes() {
        // A declared output, and an inner value, which one runtime takes from a copy in memory.
        for (name, grid) in [("map", "map_grid2x2"), ("hidden", "hidden_mean")] {
            let pooling = if name == "map" { "grid2x2" } else { "mean" };
            let task = tiny_layer("beside.onnx", name, pooling);
            let encoder = Encoder::model(task, &runtime).unwrap();
            let rows = encoder.encode(&clips).unwrap();
            close(name, &rows, &expected.rows(grid), 1e-5);
        }

        let copy = tempfile::tempdir().unwrap();
        let model = copy.path().join("beside.onnx");
        let weights = copy.path().join("beside.bin");
        std::fs::copy(whole.join("beside.onnx"), &model).unwrap();
        let mut bytes = std::fs::read(whole.join("beside.bin")).unwrap();
        std::fs::write(&weights, &bytes).unwrap();
        let id = |file: &Path| {
            let mut task = tiny_layer("beside.onnx", "map", "mean");
            task.file = file.to_owned();
            Encoder::model(task, &runtime).map(|encoder| encoder.id().to_owned())
        };
        assert_eq!(id(&model).unwrap(), id(&whole.join("beside.onnx")).unwrap());

        bytes[0] ^= 1;
        std::fs::write(&weights, &bytes).unwrap();
        assert_ne!(id(&model).unwrap(), id(&whole.join("beside.onnx")).unwrap());

        // A model does not make the program read what lies elsewhere.
        let graph = std::fs::read(&model).unwrap();
        let at = graph.windows(10).position(|w| w == b"beside.bin").unwrap();
        let mut elsewhere = graph;
        for place in (0..elsewhere.len() - 10).filter(|&place| place >= at) {
            if elsewhere[place..place + 10] == *b"beside.bin" {
                elsewhere[place..place + 10].copy_from_slice(b"../top.bin");
            }
        }
        std::fs::write(&model, elsewhere).unwrap();
        let message = id(&model).unwrap_err().to_string();
        assert!(
            message.contains("does not lie in the model's folder"),
            "{message}"
        );
    }
}

/// The 8-bit images of a NumPy file (n, height, width, 3).
fn stack(file: &Path) -> Vec<RgbImage> {
    let array = npy::<u8>(file);
    let &[_, height, width, 3] = array.shape() else {
        panic!("{:?}", array.shape())
    };
    let image = |bytes: ndarray::ArrayViewD<'_, u8>| RgbImage {
        width,
        height,
        bytes: bytes.iter().copied().collect(),
    };

    array.outer_iter().map(image).collect()
}

/// Outputs of a model on the oracle's own input images, with the bounds of its README: (layer,
/// pooled bound, raw bound).
struct RealModel {
    name: &'static str,
    inputs: &'static str,
    preparation: Preparation,
    layers: Vec<String>,
    pooled_bound: f64,
    raw_bound: f64,
}

fn real_model(name: &str, preparation: &Preparation, layers: Vec<Layer>) -> ModelTask {
    ModelTask {
        file: shared().join(format!("models/{name}.onnx")),
        preparation: preparation.clone(),
        layers,
        window: 1,
        keypoints: None,
        is_prefix_stated: true,
    }
}

fn real_models() -> Vec<RealModel> {
    let names = |names: &[&str]| names.iter().map(|&name| name.to_owned()).collect();
    let dino = (1..=6)
        .flat_map(|i| [format!("layer{i}_cls"), format!("layer{i}_patch")])
        .chain(["final_cls".to_owned(), "final_patch".to_owned()]);

    let preparation = |name: &str| recipe(name).unwrap().preparation.clone();
    vec![
        RealModel {
            name: "effnetlite0",
            inputs: "u8_320x240.npy",
            preparation: preparation("effnetlite0"),
            layers: names(&["block4", "block10", "block14", "block15"]),
            pooled_bound: 2e-4,
            raw_bound: 2e-3,
        },
        RealModel {
            name: "xfeat",
            inputs: "u8_320x240.npy",
            preparation: preparation("xfeat"),
            layers: names(&["block4", "block5", "fusion"]),
            pooled_bound: 2e-4,
            raw_bound: 5e-4,
        },
        RealModel {
            name: "dinov2_tiny_random",
            inputs: "u8_224x224.npy",
            preparation: preparation("dinov2-s"),
            layers: dino.collect(),
            pooled_bound: 5e-5,
            raw_bound: 2e-4,
        },
    ]
}

/// Oracle: PyTorch's outputs for 16 photographs and a synthetic picture, pooled, all layers in one
/// pass.
#[test]
#[ignore = "needs the folder of large inputs: SEESE3_SHARED or ../shared"]
fn real_models_give_pytorchs_features() {
    let folder = shared().join("models");
    for runtime in runtimes() {
        for model in real_models() {
            let layers = model.layers.iter().map(|name| layer(name, "mean"));
            let layers = layers.collect();
            let task = real_model(model.name, &model.preparation, layers);
            let encoder = Encoder::model(task, &runtime).unwrap();
            let images = stack(&folder.join("inputs").join(model.inputs));
            let clips = alone(&images);
            let rows = encoder.encode(&clips).unwrap();

            let mut from = 0;
            for (name, &dim) in model.layers.iter().zip(encoder.dims()) {
                let expected =
                    npy::<f32>(&folder.join(format!("expected/{}.{name}.pooled.npy", model.name)));
                let expected: Array2<f32> = expected.into_dimensionality().unwrap();
                let found = rows.slice(ndarray::s![.., from..from + dim]).to_owned();

                let what = format!("{} {name} by {}", model.name, encoder.runtime());
                close(&what, &found, &expected.mapv(f64::from), model.pooled_bound);
                from += dim;
            }
        }
    }
}

/// Oracle: PyTorch's outputs unpooled, for two photographs and the synthetic picture. A grid of as
/// many cells as the map has is the map itself.
#[test]
#[ignore = "needs the folder of large inputs: SEESE3_SHARED or ../shared"]
fn real_models_give_pytorchs_maps() {
    let folder = shared().join("models");
    for runtime in runtimes() {
        for model in real_models() {
            let images = stack(&folder.join("inputs").join(model.inputs));
            let clips: Vec<Vec<&RgbImage>> =
                [0, 8, 16].iter().map(|&row| vec![&images[row]]).collect();
            for name in model.layers.iter().filter(|name| !name.ends_with("_cls")) {
                let expected =
                    npy::<f32>(&folder.join(format!("expected/{}.{name}.raw.npy", model.name)));

                let (pooling, expected) = match *expected.shape() {
                    [_, _, height, width] => (format!("grid{width}x{height}"), expected),
                    [_, tokens, _] => {
                        let side = tokens.isqrt();
                        (
                            format!("grid{side}x{side}"),
                            expected.permuted_axes(vec![0, 2, 1]),
                        )
                    }
                    ref other => panic!("{other:?}"),
                };

                let layers = vec![layer(name, &pooling)];
                let task = real_model(model.name, &model.preparation, layers);
                let encoder = Encoder::model(task, &runtime).unwrap();

                let flat: Vec<f64> = expected.iter().map(|&x| f64::from(x)).collect();
                let expected = Array2::from_shape_vec((3, flat.len() / 3), flat).unwrap();
                let what = format!("{} {name} by {}", model.name, encoder.runtime());
                let rows = encoder.encode(&clips).unwrap();
                close(&what, &rows, &expected, model.raw_bound);
            }
        }
    }
}

/// Oracle: the room's published features, made by PyTorch with Pillow's decoder. What remains is
/// the JPEG decoder's (up to 5 levels a pixel) and the resize filter's rounding: 1 to 2 % of a
/// feature's length for EfficientNet, under 1 % for XFeat and for raw pixels; the nearest other
/// frame is 11 to 56 % away.
#[test]
#[ignore = "needs the folder of large inputs: SEESE3_SHARED or ../shared"]
fn the_kitchens_photographs_give_its_features() {
    let kitchen = shared().join("rooms/kitchen");

    let frames: Vec<usize> = (0..1_000).step_by(40).collect();
    let agree = |encoder: &Encoder, file: &str, bound: f32| {
        let expected: Array2<f32> = npy(&kitchen.join(file)).into_dimensionality().unwrap();

        let read = |&frame: &usize| {
            let image =
                read_image(&kitchen, &format!("seq-01/frame-{frame:06}.color.jpg")).unwrap();
            encoder.prepare(image).unwrap()
        };
        let images: Vec<RgbImage> = frames.iter().map(read).collect();
        let clips = alone(&images);

        for (row, &frame) in encoder.encode(&clips).unwrap().outer_iter().zip(&frames) {
            let expected = expected.row(frame);
            let length = |x: &ndarray::Array1<f32>| x.iter().map(|x| x * x).sum::<f32>().sqrt();
            let off = length(&(&row - &expected)) / length(&expected.to_owned());

            assert!(
                off < bound,
                "{file}, frame {frame}: {off} of its length off"
            );
        }
    };

    agree(&Encoder::pixels(), "features_pixels_rgb16x12.npy", 0.003);

    for runtime in runtimes() {
        for (model, name, pooling, file, bound) in [
            ("effnetlite0", "block14", "mean", "block14_gap", 0.025),
            ("xfeat", "block4", "grid2x2", "block4_p2x2", 0.01),
            ("xfeat", "block5", "grid4x4", "block5_p4x4", 0.01),
        ] {
            let preparation = &recipe(model).unwrap().preparation;
            let task = real_model(model, preparation, vec![layer(name, pooling)]);
            let encoder = Encoder::model(task, &runtime).unwrap();
            agree(&encoder, &format!("features_{model}_{file}.npy"), bound);
        }
    }
}

/// Oracle: the detector's definition in NumPy on onnxruntime's outputs, of Pillow's image
/// (`tests/golden/keypoints`). Decoder and resize filter differ by some levels of a pixel, so that
/// a few weak keypoints differ.
#[test]
#[ignore = "needs the folder of large inputs: SEESE3_SHARED or ../shared"]
fn the_keypoints_of_an_image_are_those_of_numpy() {
    let expected = json(&golden().join("keypoints/image.json"));
    let numbers = |name: &str| expected[name].as_array().unwrap();
    let inputs = shared().join("models/inputs");
    let recipe = recipe("xfeat-keypoints").unwrap();

    for runtime in runtimes() {
        let task = ModelTask {
            keypoints: recipe.keypoints.clone(),
            ..real_model(
                "xfeat_keypoints_320x240",
                &recipe.preparation,
                vec![layer("block4", "grid2x2")],
            )
        };
        let encoder = Encoder::model(task, &runtime).unwrap();
        let image = read_image(&inputs, expected["image"].as_str().unwrap()).unwrap();
        let image = encoder.prepare(image).unwrap();
        let frames = encoder.encode_frames(&[vec![&image]]).unwrap();
        let keypoints = frames[0].keypoints.as_ref().unwrap();
        assert_eq!(keypoints.len(), numbers("scores").len());

        let mut found = 0;
        for (point, score) in numbers("points").iter().zip(numbers("scores")).take(200) {
            let [x, y] = [0, 1].map(|axis| number(&point[axis]));
            let is_it = |place: usize| {
                let point = keypoints.points()[place];
                let off = (f64::from(point.x) * 320.0 - x).hypot(f64::from(point.y) * 240.0 - y);
                let ratio = f64::from(keypoints.scores()[place]) / number(score);
                off < 0.25 && (0.7..1.4).contains(&ratio)
            };
            found += usize::from((0..keypoints.len()).any(is_it));
        }
        assert!(found >= 195, "{found} of the 200 best keypoints");
    }
}

/// Oracle: the tensors that Pillow and NumPy made of the same 8-bit images; the normalization is
/// exact to an f32.
#[test]
#[ignore = "needs the folder of large inputs: SEESE3_SHARED or ../shared"]
fn normalized_tensors_are_numpys() {
    let folder = shared().join("models");
    for model in real_models() {
        let images = stack(&folder.join("inputs").join(model.inputs));
        let expected = npy::<f32>(&folder.join(format!("expected/{}.input.npy", model.name)));
        let mut numbers = Vec::new();

        // Rows 0 and 8 are frames 0 and 533.
        for row in [0, 8] {
            normalized(&model.preparation, &images[row], &mut numbers);
        }

        let found = ArrayD::from_shape_vec(expected.shape().to_vec(), numbers).unwrap();
        let worst = found
            .iter()
            .zip(&expected)
            .map(|(a, b)| (a - b).abs())
            .fold(0.0, f32::max);

        assert!(worst <= 3e-7, "{}: {worst}", model.name);
    }
}

/// The largest difference of two images' bytes.
fn worst_level<'a>(found: &[u8], expected: impl IntoIterator<Item = &'a u8>) -> u8 {
    let pairs = found.iter().zip(expected);
    pairs.map(|(a, b)| a.abs_diff(*b)).max().unwrap()
}

/// Oracle: Pillow's resize of the same decoded pixels. Both round to 8 bit after each pass, in
/// another fixed point and order: at most 1 level for the triangle filter, 2 for the cubic one on a
/// photograph, 9 on hard synthetic edges.
#[test]
#[ignore = "needs the folder of large inputs: SEESE3_SHARED or ../shared"]
fn resized_images_are_pillows() {
    let folder = shared().join("models");
    let inputs = folder.join("inputs");
    let frame = npy::<u8>(&inputs.join("u8_640x480_frame000000.npy"));
    let frame = RgbImage {
        width: 640,
        height: 480,
        bytes: frame.iter().copied().collect(),
    };

    let synthetic = read_image(&inputs, "synthetic.png").unwrap();
    let whole = recipe("effnetlite0").unwrap().preparation.clone();
    let cubic = recipe("dinov2-s").unwrap().preparation.clone();

    assert_eq!(
        (whole.filter, cubic.filter),
        (Filter::Bilinear, Filter::Bicubic)
    );

    for (preparation, image, file, row, bound) in [
        (&whole, &frame, "u8_320x240.npy", 0, 1),
        (&whole, &synthetic, "u8_320x240.npy", 16, 1),
        (&cubic, &frame, "u8_224x224.npy", 0, 2),
        (&cubic, &synthetic, "u8_224x224.npy", 16, 9),
    ] {
        let found = preparation.pixels(image.clone()).unwrap();
        let expected = &stack(&inputs.join(file))[row];
        assert_eq!(
            (found.width, found.height),
            (expected.width, expected.height)
        );

        let worst = worst_level(&found.bytes, &expected.bytes);
        assert!(worst <= bound, "{file} row {row}: {worst} levels");
    }
}

/// Oracle: Pillow's decoding of the same JPEG. Decoders round their transforms and chroma
/// differently: at most 5 levels.
#[test]
#[ignore = "needs the folder of large inputs: SEESE3_SHARED or ../shared"]
fn decoded_photographs_are_pillows() {
    let folder = shared().join("models");
    let expected = npy::<u8>(&folder.join("inputs/u8_640x480_frame000000.npy"));

    let found = read_image(&folder.join("inputs"), "frame-000000.color.jpg").unwrap();
    assert_eq!((found.width, found.height), (640, 480));

    let worst = worst_level(&found.bytes, &expected);
    assert!(worst <= 5, "{worst} levels");
}

/// Oracle: a photograph that is cut is no photograph; a lenient decoder would fill it up with grey.
#[test]
#[ignore = "needs the folder of large inputs: SEESE3_SHARED or ../shared"]
fn cut_photographs_are_refused() {
    let folder = shared().join("models");
    let whole = std::fs::read(folder.join("inputs/frame-000000.color.jpg")).unwrap();

    let refused = |bytes: &[u8]| decode("photo", bytes, Bounds::LOCAL).is_err();
    assert!(!refused(&whole));

    for part in [10, 50, 90, 99] {
        assert!(
            refused(&whole[..whole.len() * part / 100]),
            "cut to {part} %"
        );
    }
}

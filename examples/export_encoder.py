"""Exports an encoder of images or clips of timm, transformers or diffusers to ONNX, for `seese3 encode`.

    pip install torch onnx onnxscript timm transformers diffusers
    python export_encoder.py timm vit_small_patch14_dinov2.lvd142m
    python export_encoder.py transformers facebook/dinov2-small
    python export_encoder.py transformers MCG-NJU/videomae-base
    python export_encoder.py diffusers stable-diffusion-v1-5/stable-diffusion-v1-5 --timestep 261

Writes NAME.onnx with one output for each block, `block0` and so on, before the model's last normalization; NAME.onnx.data with
the weights; and NAME.json, which says how its images are prepared. Prints the command that encodes a room with them.

Of diffusers, it takes models with an autoencoder and a UNet of images (Stable Diffusion, LCM) or clips (Stable Video Diffusion):
the blocks are the UNet's down blocks, its middle block and its up blocks, for the image's latents with fixed noise of one timestep
and without a condition.
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
    """The outputs of the blocks of a transformer of images (3, h, w) or clips (t, 3, h, w): tokens (n, c)."""

    def __init__(self, model):
        super().__init__()
        self.model = getattr(model, "vision_model", model)

    def forward(self, image):
        return tuple(self.model(pixel_values=image, output_hidden_states=True).hidden_states[1:])


class DiffusionBlocks(torch.nn.Module):
    """The outputs of the blocks of a latent diffusion model's UNet: maps (c, h, w) of an image, tokens (n, c), time first, of a
    clip."""

    def __init__(self, name, timestep):
        from diffusers import AutoModel, DDIMScheduler

        super().__init__()
        self.vae = AutoModel.from_pretrained(name, subfolder="vae").eval()
        self.unet = AutoModel.from_pretrained(name, subfolder="unet").eval()
        self.is_of_clips = type(self.unet).__name__ == "UNetSpatioTemporalConditionModel"
        self.frames = self.unet.config.num_frames if self.is_of_clips else 1

        side = self.unet.config.sample_size
        self.height, self.width = (side, side) if isinstance(side, int) else side
        channels = self.vae.config.latent_channels
        noise = torch.randn(1, self.frames, channels, self.height, self.width, generator=torch.Generator().manual_seed(0))
        self.register_buffer("noise", noise)
        self.register_buffer("condition", self.empty_condition(name))
        self.timestep = timestep
        signal = float(DDIMScheduler.from_pretrained(name, subfolder="scheduler").alphas_cumprod[timestep])
        self.signal, self.spread = signal**0.5, (1 - signal) ** 0.5

    def empty_condition(self, name):
        """The embedding of the empty prompt; zeros, which stand for no condition, for a model without a text encoder."""
        from transformers import CLIPTextModel, CLIPTokenizer

        try:
            encoder = CLIPTextModel.from_pretrained(name, subfolder="text_encoder").eval()
            tokenizer = CLIPTokenizer.from_pretrained(name, subfolder="tokenizer")
        except OSError:
            return torch.zeros(1, 1, self.unet.config.cross_attention_dim)
        words = tokenizer("", padding="max_length", max_length=tokenizer.model_max_length, return_tensors="pt")
        with torch.no_grad():
            return encoder(words.input_ids)[0]

    def forward(self, image):
        count = image.shape[0]
        images = image.reshape(count * self.frames, 3, image.shape[-2], image.shape[-1])
        latents = self.vae.encode(images).latent_dist.mode() * self.vae.config.scaling_factor
        latents = latents.reshape(count, self.frames, *latents.shape[1:])
        noisy = self.signal * latents + self.spread * self.noise
        condition = self.condition.expand(count, -1, -1)

        kept = []
        first = lambda output: output[0] if isinstance(output, tuple) else output  # noqa: E731
        blocks = [*self.unet.down_blocks, self.unet.mid_block, *self.unet.up_blocks]
        hooks = [block.register_forward_hook(lambda _, __, output: kept.append(first(output))) for block in blocks]
        if self.is_of_clips:
            # Frames a second minus one, motion bucket and noise of the condition, as Stable Video Diffusion's pipeline has them.
            added = torch.tensor([[6.0, 127.0, 0.02]]).expand(count, -1)
            self.unet(torch.cat([noisy, torch.zeros_like(noisy)], dim=2), self.timestep, condition, added)
        else:
            guidance = self.unet.config.time_cond_proj_dim
            extra = {"timestep_cond": torch.zeros(count, guidance)} if guidance else {}
            self.unet(noisy[:, 0], self.timestep, condition, **extra)
        for hook in hooks:
            hook.remove()

        if not self.is_of_clips:
            return tuple(kept)
        tokens = lambda maps: maps.reshape(count, self.frames, maps.shape[1], -1).transpose(2, 3).flatten(1, 2)  # noqa: E731
        return tuple(tokens(maps) for maps in kept)


def of_diffusers(name, timestep):
    """As `of_timm`. A folder in place of a name is read from the disk."""
    blocks = DiffusionBlocks(name, timestep)
    scale = 2 ** (len(blocks.vae.config.block_out_channels) - 1)
    height, width = blocks.height * scale, blocks.width * scale
    config = {
        "do_resize": True,
        "size": {"height": height, "width": width},
        "resample": 3,
        "do_rescale": True,
        "rescale_factor": 1 / 255,
        "do_normalize": True,
        "image_mean": [0.5] * 3,
        "image_std": [0.5] * 3,
    }
    clip = (blocks.frames,) if blocks.is_of_clips else ()
    # Two, so that the number of images stays open.
    return blocks, torch.randn(2, *clip, 3, height, width), config, 0


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
    frames = getattr(model.config, "num_frames", 1)
    if frames > 1:
        image = processor([blank] * frames, return_tensors="pt").pixel_values
    else:
        image = processor(images=blank, return_tensors="pt").pixel_values

    # What is left over when the patches are taken away stands before them.
    blocks = TransformersBlocks(model)
    patch = blocks.model.config.patch_size
    times = frames // getattr(model.config, "tubelet_size", 1)
    patches = times * (image.shape[-2] // patch) * (image.shape[-1] // patch)
    with torch.no_grad():
        tokens = blocks(image)[0].shape[1]

    return blocks, image, json.loads(processor.to_json_string()), tokens - patches


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("library", choices=["timm", "transformers", "diffusers"])
    parser.add_argument("model", help="the name of a model, or a folder (transformers, diffusers)")
    parser.add_argument("--random", action="store_true", help="random weights in place of trained ones (timm)")
    parser.add_argument("--timestep", type=int, default=261, help="the timestep of the noise (diffusers)")
    parser.add_argument("--out", type=Path, default=Path("."), help="the folder to write into")
    args = parser.parse_args()
    if args.random and args.library != "timm":
        parser.error("--random is for timm; another model with random weights is a folder that was saved")

    of_library = {
        "timm": lambda name: of_timm(name, args.random),
        "transformers": of_transformers,
        "diffusers": lambda name: of_diffusers(name, args.timestep),
    }
    blocks, image, config, prefix_tokens = of_library[args.library](args.model)
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
        + (f" --window {image.shape[1]}" if image.dim() == 5 else "")
    )


if __name__ == "__main__":
    main()

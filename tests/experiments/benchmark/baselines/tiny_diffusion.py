"""Pipelines of diffusers with the real classes, random weights and a handful of channels, saved as others are."""

# pyright: reportPrivateImportUsage=false, reportArgumentType=false, reportAttributeAccessIssue=false

from __future__ import annotations

import json
from pathlib import Path

import torch
from diffusers import (
    AutoencoderKL,
    DDIMScheduler,
    DDPMScheduler,
    FlowMatchEulerDiscreteScheduler,
    FluxKontextPipeline,
    FluxTransformer2DModel,
    StableDiffusionImg2ImgPipeline,
    StableDiffusionPipeline,
    UNet2DConditionModel,
)
from transformers import CLIPTextConfig, CLIPTextModel, CLIPTokenizer, T5Config, T5EncoderModel, T5TokenizerFast

WORDS = ("a", "artifact", "car", "dashboard", "remove", "the", "watermark")


def tokenizer(folder: Path) -> CLIPTokenizer:
    """CLIP's tokenizer with the letters and a few words."""
    folder.mkdir(parents=True, exist_ok=True)
    symbols = [chr(letter) for letter in range(33, 127)]
    pieces = [*symbols, *(f"{s}</w>" for s in symbols), *(f"{word}</w>" for word in WORDS)]
    vocabulary = {piece: number for number, piece in enumerate(["<|startoftext|>", "<|endoftext|>", *pieces])}
    (folder / "vocab.json").write_text(json.dumps(vocabulary))
    (folder / "merges.txt").write_text("#version: 0.2\n")
    return CLIPTokenizer(str(folder / "vocab.json"), str(folder / "merges.txt"), model_max_length=77)


def text_encoder(width: int = 16) -> CLIPTextModel:
    """CLIP's text encoder with one layer."""
    sizes = {"hidden_size": width, "intermediate_size": 16, "num_attention_heads": 2, "num_hidden_layers": 1}
    return CLIPTextModel(CLIPTextConfig(vocab_size=300, projection_dim=width, **sizes))


def autoencoder(shift_factor: float | None = None) -> AutoencoderKL:
    """A variational autoencoder with four channels at an eighth of the resolution; FLUX shifts them, too."""
    return AutoencoderKL(
        block_out_channels=(8, 8, 8, 8),
        down_block_types=("DownEncoderBlock2D",) * 4,
        up_block_types=("UpDecoderBlock2D",) * 4,
        shift_factor=shift_factor,
        norm_num_groups=4,
        layers_per_block=1,
    )


def unet() -> UNet2DConditionModel:
    """Stable Diffusion's U-Net: four levels, attention to the text."""
    return UNet2DConditionModel(
        sample_size=16,
        block_out_channels=(8, 8, 8, 8),
        down_block_types=("CrossAttnDownBlock2D", "CrossAttnDownBlock2D", "CrossAttnDownBlock2D", "DownBlock2D"),
        up_block_types=("UpBlock2D", "CrossAttnUpBlock2D", "CrossAttnUpBlock2D", "CrossAttnUpBlock2D"),
        layers_per_block=1,
        cross_attention_dim=16,
        attention_head_dim=2,
        norm_num_groups=4,
    )


def save_stable_diffusion(folder: Path) -> Path:
    """A StableDiffusionPipeline."""
    torch.manual_seed(0)
    pipeline = StableDiffusionPipeline(
        vae=autoencoder(),
        text_encoder=text_encoder(),
        tokenizer=tokenizer(folder / "words"),
        unet=unet(),
        scheduler=DDIMScheduler(),
        safety_checker=None,
        feature_extractor=None,
        requires_safety_checker=False,
    )
    pipeline.save_pretrained(folder / "weights")
    return folder / "weights"


DIFIX = """
from diffusers import StableDiffusionImg2ImgPipeline


class DifixPipeline(StableDiffusionImg2ImgPipeline):
    def __call__(self, prompt, image, ref_image=None, *, num_inference_steps, timesteps, guidance_scale, generator):
        shown = ref_image and ref_image.size
        DifixPipeline.asked = (prompt, image.size, shown, num_inference_steps, timesteps, guidance_scale)
        return super().__call__(
            prompt, image, strength=1.0, timesteps=timesteps, guidance_scale=guidance_scale, generator=generator
        )
"""
"""A pipeline with code of its own, as nvidia/difix_ref has one: image to image with a reference."""


def save_difix(folder: Path) -> Path:
    """A pipeline with the class DifixPipeline in a file beside its weights."""
    torch.manual_seed(0)
    pipeline = StableDiffusionImg2ImgPipeline(
        vae=autoencoder(),
        text_encoder=text_encoder(),
        tokenizer=tokenizer(folder / "words"),
        unet=unet(),
        scheduler=DDPMScheduler(),
        safety_checker=None,
        feature_extractor=None,
        requires_safety_checker=False,
    )
    weights = folder / "difix"
    pipeline.save_pretrained(weights)
    (weights / "pipeline_difix.py").write_text(DIFIX)
    index = json.loads((weights / "model_index.json").read_text())
    (weights / "model_index.json").write_text(json.dumps({**index, "_class_name": ["pipeline_difix", "DifixPipeline"]}))
    return weights


def save_flux(folder: Path) -> Path:
    """A FluxKontextPipeline."""
    torch.manual_seed(0)
    pieces = [("<pad>", 0.0), ("</s>", 0.0), ("<unk>", 0.0), *((f"\u2581{word}", -1.0) for word in WORDS)]
    pipeline = FluxKontextPipeline(
        scheduler=FlowMatchEulerDiscreteScheduler(),
        vae=autoencoder(shift_factor=0.1),
        text_encoder=text_encoder(8),
        tokenizer=tokenizer(folder / "words"),
        text_encoder_2=T5EncoderModel(T5Config(d_model=16, d_ff=16, d_kv=8, num_layers=1, num_heads=2, vocab_size=32)),
        tokenizer_2=T5TokenizerFast(vocab=pieces),
        transformer=FluxTransformer2DModel(
            in_channels=16,
            num_layers=1,
            num_single_layers=1,
            attention_head_dim=16,
            num_attention_heads=2,
            joint_attention_dim=16,
            pooled_projection_dim=8,
            axes_dims_rope=(4, 4, 8),
            guidance_embeds=True,
        ),
    )
    pipeline.save_pretrained(folder / "flux")
    return folder / "flux"

"""Features of every part of a photo, for SpotLessSplats: those of Stable Diffusion, or hand-made ones without weights.

Tang et al., "Emergent correspondence from image diffusion" (NeurIPS 2023), at the step and the layer of SpotLessSplats;
Tola et al., DAISY (PAMI 2010), and color.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from scipy import sparse
from torch import Tensor

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.benchmark.baselines.diffusion_weights import require

GRID = 50
"""Cells along the longer side of the grid of hand-made features; Stable Diffusion's grid is 50 x 50."""
SIDE = 800
"""Side to which photos are resized for Stable Diffusion, pixels: 16 for each cell."""
TIMESTEP = 261
"""Of 1000: how much noise is added before the features are read."""
DRAWS = 4
"""Of that noise; the features are their mean."""
LAYER = 1
"""Block of the U-Net's upward path whose output they are: 1280 channels."""
WEIGHTS = "stabilityai/stable-diffusion-2-1, CreativeML Open RAIL++-M licence"


def hand_made(photos: Iterable[Tensor]) -> Iterator[Tensor]:
    """DAISY descriptors and mean colors of photos [H, W, 3] in [0, 1]: [107, h, w], max(h, w) = GRID.

    Each half is scaled to unit variance over the photo, so that texture and color count alike.
    """
    from skimage.feature import daisy

    for photo in photos:
        height, width = photo.shape[:2]
        cell = max(height, width) / GRID
        size = max(1, round(height / cell)), max(1, round(width / cell))
        planes = photo.permute(2, 0, 1)[None].float()
        color = F.interpolate(planes, size=size, mode="area")[0]
        radius = max(2, round(1.5 * cell))
        gray = np.pad(planes[0].mean(dim=0).cpu().numpy(), radius, mode="reflect")
        texture = torch.from_numpy(daisy(gray, step=1, radius=radius, rings=2, histograms=6)).permute(2, 0, 1)
        texture = F.interpolate(texture[None].float(), size=size, mode="area")[0].to(color.device)
        yield torch.cat([_standardized(texture), _standardized(color)])


def diffusion(folder: Path, photos: Iterable[Tensor], device: torch.device) -> Iterator[Tensor]:
    """Features of Stable Diffusion for photos [H, W, 3] in [0, 1]: [1280, 50, 50] with the weights of version 2.1.

    Args:
        folder: its weights as diffusers saves a pipeline.
        photos: of any size; they are resized to SIDE x SIDE.
        device: where it runs.

    Raises:
        InputError: the folder holds no such weights, or diffusers is not installed.
    """
    pipeline = _load(folder, device)
    found: list[Tensor] = []
    hook = pipeline.unet.up_blocks[LAYER].register_forward_hook(lambda _, __, output: found.append(output))
    noise = torch.Generator().manual_seed(0)
    prompt, _ = pipeline.encode_prompt("", device, DRAWS, do_classifier_free_guidance=False)
    time = torch.tensor([TIMESTEP], device=device)
    try:
        with torch.no_grad():
            for photo in photos:
                planes = photo.permute(2, 0, 1)[None].to(device)
                resized = F.interpolate(planes, size=(SIDE, SIDE), mode="bicubic", antialias=True).clamp(0.0, 1.0)
                encoded = pipeline.vae.encode((2.0 * resized - 1.0).to(pipeline.vae.dtype)).latent_dist
                latents = torch.cat([encoded.sample(noise) for _ in range(DRAWS)]) * pipeline.vae.config.scaling_factor
                drawn = torch.randn(latents.shape, generator=noise).to(latents)
                pipeline.unet(pipeline.scheduler.add_noise(latents, drawn, time), time, encoder_hidden_states=prompt)
                yield found.pop().float().mean(dim=0)
    finally:
        hook.remove()


def _load(folder: Path, device: torch.device) -> Any:
    require(str(folder), WEIGHTS)
    from diffusers import StableDiffusionPipeline  # pyright: ignore[reportPrivateImportUsage]

    precision = torch.float16 if device.type == "cuda" else torch.float32
    try:
        loaded = StableDiffusionPipeline.from_pretrained(str(folder), torch_dtype=precision, local_files_only=True)
    except (OSError, ValueError, KeyError, TypeError) as error:
        message = f"{folder} holds no Stable Diffusion ({str(error).splitlines()[0]})"
        raise InputError(message, f"download {WEIGHTS}, to that folder") from error
    return loaded.to(device)


def ward_clusters(features: Tensor, count: int) -> Tensor:
    """Cluster the cells of a grid [C, h, w] by Ward's criterion, connected to their 8 neighbors: labels [h, w]."""
    from sklearn.cluster import AgglomerativeClustering

    _, height, width = features.shape
    cells = np.arange(height * width).reshape(height, width)
    pairs = [
        (cells[:, :-1], cells[:, 1:]),
        (cells[:-1], cells[1:]),
        (cells[:-1, :-1], cells[1:, 1:]),
        (cells[:-1, 1:], cells[1:, :-1]),
    ]
    start, end = (np.concatenate([pair[side].ravel() for pair in pairs]) for side in (0, 1))
    links = sparse.coo_matrix((np.ones(len(start)), (start, end)), shape=(cells.size, cells.size))
    ward = AgglomerativeClustering(min(count, cells.size), connectivity=links + links.T, linkage="ward")
    labels = ward.fit_predict(features.flatten(1).T.cpu().numpy())
    return torch.from_numpy(labels.reshape(height, width))


def _standardized(planes: Tensor) -> Tensor:
    """Planes [C, h, w] of mean 0 each, and of unit variance together."""
    centered = planes - planes.mean(dim=(1, 2), keepdim=True)
    return centered / centered.square().mean().sqrt().clamp_min(1e-6) / planes.shape[0] ** 0.5

"""The artifact as files: straight-alpha images, premultiplied layers, matte, masks and a description."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from ssa_nerfstudio import __version__
from ssa_nerfstudio.export.artifact_layers import ArtifactLayers
from ssa_nerfstudio.export.checkpoint import Checkpoint
from ssa_nerfstudio.overlay.rgba import over_checkerboard

FILES = {
    "overlay.png": "RGBA, 8 bits, straight alpha, sRGB as the photos",
    "overlay_16bit.png": "RGBA, 16 bits, straight alpha, sRGB as the photos",
    "overlay_premultiplied.npy": "float32 [H, W, 4]: A W and A, premultiplied; exact also of light that hides nothing, "
    "A W above A",
    "matte.png": "A of overlay.png, 16 bits, white is opaque; of light that hides nothing the least that can carry it",
    "mask_white_is_scene.png": "8 bits, 0 where the matte exceeds the threshold, else 255: for nerfstudio (mask_path) "
    "and COLMAP (ImageReader.camera_mask_path), which both ignore black",
    "mask_white_is_artifact.png": "the same mask inverted, for inpainting and editing tools",
    "preview.png": "the artifact over a checkerboard, as a preview",
}
"""Files that `write_overlay` writes for each camera, and what they hold."""
LAYERS_FILE = "layers.npz"
"""T and B of all cameras in the undistorted frame: what `--pipeline.model.overlay-given` takes."""


def write_overlay(folder: Path, checkpoint: Checkpoint, layers: list[ArtifactLayers], threshold: float) -> dict:
    """Write overlay.json and the artifact of every camera, of several in folders called by the cameras.

    Where the artifact changes, each interval has a folder, interval_1, ...

    Args:
        folder: exists and is empty.
        checkpoint: where the layers come from, for the description.
        layers: one per camera.
        threshold: matte above which a pixel counts as artifact in the masks, in (0, 1).

    Returns:
        The contents of overlay.json.
    """
    cameras = []
    for layer in layers:
        name = layer.name if len(layers) > 1 else "."
        (folder / name).mkdir(exist_ok=True)
        cameras.append(
            {
                "folder": name,
                "name": layer.name,
                "photos_from": layer.start,
                **_write_camera(folder / name, layer, threshold),
            }
        )
    description: dict[str, Any] = {
        "checkpoint": str(checkpoint.path),
        "step": checkpoint.step,
        "ssa_nerfstudio": __version__,
        "threshold": threshold,
        "files": dict(FILES),
        "cameras": cameras,
    }
    if layers[0].frame == "undistorted":
        suffixes = [str(number) if len(layers) > 1 else "" for number in range(len(layers))]
        arrays = {f"T{s}": layer.transmittance for s, layer in zip(suffixes, layers, strict=True)}
        arrays |= {f"B{s}": layer.addition for s, layer in zip(suffixes, layers, strict=True)}
        np.savez_compressed(folder / LAYERS_FILE, **arrays)
        description["files"][LAYERS_FILE] = "T and B [H, W, 3], I = clip(T C + B): for --pipeline.model.overlay-given"
    (folder / "overlay.json").write_text(json.dumps(description, indent=2) + "\n")
    return description


def _write_camera(folder: Path, layers: ArtifactLayers, threshold: float) -> dict[str, Any]:
    color, alpha = layers.straight()
    artifact = layers.covered(threshold)
    straight = np.concatenate([color[..., ::-1], alpha], axis=-1)  # OpenCV's order
    _write_png(folder / "overlay.png", quantized(straight, np.uint8))
    _write_png(folder / "overlay_16bit.png", quantized(straight, np.uint16))
    # Premultiplied, additive light can be expressed (unless T differs by channel): as color above alpha.
    coverage = 1 - layers.transmittance.mean(axis=-1, keepdims=True)
    np.save(folder / "overlay_premultiplied.npy", np.concatenate([layers.addition, coverage], axis=-1))
    _write_png(folder / "matte.png", quantized(alpha, np.uint16))
    _write_png(folder / "mask_white_is_artifact.png", artifact.astype(np.uint8) * 255)
    _write_png(folder / "mask_white_is_scene.png", (~artifact).astype(np.uint8) * 255)
    preview = over_checkerboard(torch.from_numpy(color), torch.from_numpy(alpha)).numpy()
    _write_png(folder / "preview.png", quantized(preview[..., ::-1], np.uint8))
    return {
        "frame": layers.frame,
        "overlay": layers.kind,
        "covered_fraction": float(artifact.mean()),
        "mean_matte": float(alpha.mean()),
        "lost_in_rgba_gray_levels": 255 * _lost(layers, color, alpha),
        "intrinsics": asdict(layers.camera),
    }


def _lost(layers: ArtifactLayers, color: np.ndarray, alpha: np.ndarray) -> float:
    """Mean over pixels of the error of the RGBA image over a black or a white scene, whichever is larger.

    RGBA can express neither a transmittance per channel nor additive light.
    """
    black = alpha * color - layers.addition
    white = black + (1 - alpha) - layers.transmittance
    return float(np.maximum(np.abs(black), np.abs(white)).mean())


def quantized(values: np.ndarray, kind: type[np.unsignedinteger]) -> np.ndarray:
    """Map values in [0, 1] to the whole range of an unsigned integer type, rounded."""
    return np.rint(values.clip(0, 1) * np.float64(np.iinfo(kind).max)).astype(kind)


def _write_png(path: Path, image: np.ndarray) -> None:
    if not cv2.imwrite(str(path), image):
        raise OSError(f"{path} cannot be written")

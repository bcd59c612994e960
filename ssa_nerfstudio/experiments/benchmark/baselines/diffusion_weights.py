"""Pipelines of diffusers from a local folder or a hub's id, and what to say where there are no weights or no memory."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from PIL import Image

from ssa_nerfstudio.errors import InputError


def require(weights: object, what: str) -> None:
    """Refuse to begin without weights or without diffusers.

    Args:
        weights: what a benchmark file states, which may be anything; text is a folder or a hub's id.
        what: which weights are meant and under which licence.

    Raises:
        InputError: `weights` is empty, no text, or a folder without a pipeline, or diffusers is not installed; in one
            line, with what to fetch.
    """
    if not (weights and isinstance(weights, str)):
        raise InputError(f"no weights are stated ({what})", "state a folder that has them, or the id: weights")
    folder = Path(weights)
    # A hub's id is a relative path, too, of a folder that is not there.
    if (folder.is_absolute() or folder.is_dir()) and not (folder / "model_index.json").is_file():
        raise InputError(f"{weights} holds no weights (no model_index.json)", f"fetch {what}, and state its folder")
    try:
        import diffusers  # noqa: F401
    except ImportError as error:
        raise InputError(f"diffusers is not installed, which {weights} needs", "pip install '.[diffusion]'") from error


def load(
    weights: str,
    what: str,
    device: torch.device,
    offload: bool,
    precision: torch.dtype,
    kind: str = "DiffusionPipeline",
) -> Any:
    """Load a pipeline.

    Args:
        weights: a folder as diffusers saves a pipeline, or a hub's id that is in its cache or may be downloaded.
        what: which weights are meant and under which licence, for messages.
        device: where it runs.
        offload: keep only the part that is at work on the GPU.
        precision: of the weights on CUDA; single elsewhere.
        kind: the class; `DiffusionPipeline` takes the one that the weights name, their own code included.

    Raises:
        InputError: there are no usable weights, or no memory for them.
    """
    require(weights, what)
    import diffusers

    precision = precision if device.type == "cuda" else torch.float32
    remote = {"trust_remote_code": True} if kind == "DiffusionPipeline" else {}
    try:
        with enough_memory(weights):
            pipeline: Any = getattr(diffusers, kind).from_pretrained(weights, torch_dtype=precision, **remote)
            pipeline.set_progress_bar_config(disable=True)
            if offload and device.type == "cuda":
                pipeline.enable_model_cpu_offload()
                return pipeline
            return pipeline.to(device)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        if isinstance(error, InputError):
            raise
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise InputError(f"{weights} cannot be loaded ({reason})", f"fetch {what}, and state its folder") from error


@contextmanager
def enough_memory(weights: str) -> Iterator[None]:
    """Turn a lack of GPU memory in the block into an `InputError` in one line."""
    try:
        yield
    except torch.OutOfMemoryError as error:
        raise InputError(f"the GPU has too little memory for {weights}", "set offload: true, or use another") from error


def fitted(width: int, height: int, area: int, multiple: int) -> tuple[int, int]:
    """Sides of about an area, pixels, with the aspect of a picture, each a multiple that a pipeline asks for."""
    scale = math.sqrt(area / (width * height))
    return max(multiple, round(width * scale / multiple) * multiple), max(
        multiple, round(height * scale / multiple) * multiple
    )


def resized_back(image: Image.Image, width: int, height: int) -> Image.Image:
    """A pipeline's picture at the size of the photo that it is of."""
    return image.convert("RGB").resize((width, height), Image.Resampling.LANCZOS)

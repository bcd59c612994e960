"""FLUX.1 Kontext (Black Forest Labs, 2025) as the paper uses it: it restores every photo by itself, then 3DGS trains.

An instruction names the artifact; 28 steps, guidance 2.5, a fixed seed (paper, appendix A). Source: the paper and the
model card; the weights are for non-commercial use.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from PIL import Image

from ssa_nerfstudio.data.dataset import Dataset, View
from ssa_nerfstudio.data.writing import staged_file, staged_folder
from ssa_nerfstudio.experiments.benchmark.baselines.baseline import Baseline, Capture, Count
from ssa_nerfstudio.experiments.benchmark.baselines.diffusion_weights import (
    enough_memory,
    fitted,
    load,
    require,
    resized_back,
)
from ssa_nerfstudio.plugin.model import SSASplatfactoModel, SSASplatfactoModelConfig

WEIGHTS = "black-forest-labs/FLUX.1-Kontext-dev, FLUX.1 [dev] non-commercial licence"
PROMPTS = {
    "dashboard": "remove the car dashboard occluding the view",
    "mud": "remove the mud splatter on the camera lens",
    "watermark": "remove the watermark",
    "ui": "remove the user interface elements",
    "hud": "remove the user interface elements",
    "rain": "remove the rain drops on the camera lens",
    "finger": "remove the finger in front of the camera lens",
    "occlusion": "remove the object in front of the camera lens",
    "vignette": "remove the dark corners of the picture",
    "dust": "remove the dust on the camera lens",
    "bonnet": "remove the car bonnet at the bottom of the picture",
}
"""Instruction by artifact; those of dashboard and mud are the paper's."""
OTHERWISE = "remove what is fixed to the camera in front of the scene"


@dataclass
class RestoredConfig(SSASplatfactoModelConfig):
    """splatfacto's settings; photos are restored in the dataset."""

    _target: type = field(default_factory=lambda: SSASplatfactoModel)
    weights: str = ""
    """Folder of the weights of black-forest-labs/FLUX.1-Kontext-dev, or that id."""
    prompt: str = ""
    """Instruction; empty: the one of PROMPTS for the artifact."""
    restoration_steps: Count = 28
    """Denoising steps for a photo."""
    guidance: float = 2.5
    """Weight of the instruction."""
    area: Count = 1024 * 1024
    """Pixels of the resolution at which photos are restored."""
    batch: Count = 1
    """Photos restored at once."""
    generator_seed: int = 0
    """Of the noise; the same for every photo."""
    offload: bool = False
    """Keep only the part of the model that is at work on the GPU."""


def write_dataset(capture: Capture, folder: Path) -> None:
    """Write the dataset with its training photos restored; photos that an interrupted call restored are kept.

    `restoration.json` in it holds prompt and seconds, which the start-up of the first run that needs it holds, too.

    Raises:
        InputError: no weights, too little memory, or a photo cannot be read.
    """
    stated = RestoredConfig(**capture.settings)
    dataset = Dataset.read(capture.data, eval_interval=8)
    views = [view for view in dataset.views if view.role == "train"]
    kept = folder.with_name(f".{folder.name}.restored")
    kept.mkdir(parents=True, exist_ok=True)
    todo = [(number, view) for number, view in enumerate(views) if not (kept / f"{number:05d}.png").exists()]
    prompt = stated.prompt or PROMPTS.get(capture.artifact, OTHERWISE)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    pipeline = None
    if todo:
        pipeline = load(stated.weights, WEIGHTS, device, stated.offload, torch.bfloat16, "FluxKontextPipeline")
    began = time.monotonic()
    for some in batches(todo, stated.batch):
        photos = [Image.fromarray(dataset.read_photo(view)) for _, view in some]
        width, height = fitted(*photos[0].size, stated.area, 16)
        assert pipeline is not None
        with enough_memory(stated.weights):
            restored = pipeline(
                image=[photo.resize((width, height), Image.Resampling.LANCZOS) for photo in photos],
                prompt=[prompt] * len(photos),
                width=width,
                height=height,
                max_area=width * height,
                guidance_scale=stated.guidance,
                num_inference_steps=stated.restoration_steps,
                generator=[torch.Generator().manual_seed(stated.generator_seed) for _ in photos],
                _auto_resize=False,
            ).images
        for (number, _), photo, image in zip(some, photos, restored, strict=True):
            with staged_file(kept / f"{number:05d}.png") as part:
                resized_back(image, *photo.size).save(part, format="PNG")
    seconds = time.monotonic() - began
    with staged_folder(folder) as part:
        (part / "restored").mkdir()
        for number in range(len(views)):
            (part / "restored" / f"{number:05d}.png").write_bytes((kept / f"{number:05d}.png").read_bytes())
        names = {view.path: f"restored/{number:05d}.png" for number, view in enumerate(views)}
        capture.write_copy(part, {path: {"file_path": name} for path, name in names.items()})
        record = {"prompt": prompt, "photos": len(todo), "seconds": seconds, "seed": stated.generator_seed}
        (part / "restoration.json").write_text(json.dumps(record, indent=1), encoding="utf-8")
    for path in kept.iterdir():
        path.unlink()
    kept.rmdir()


def batches(views: Sequence[tuple[int, View]], size: int) -> Iterator[list[tuple[int, View]]]:
    """Up to `size` numbered views at a time, all of one frame size: a pipeline restores a batch at one resolution."""
    alike: dict[tuple[int, int], list[tuple[int, View]]] = {}
    for number, view in views:
        alike.setdefault(view.size, []).append((number, view))
    for same in alike.values():
        yield from (same[start : start + size] for start in range(0, len(same), size))


BASELINE = Baseline(
    RestoredConfig,
    dataset=write_dataset,
    check=lambda settings: require(settings.get("weights", ""), WEIGHTS),
)

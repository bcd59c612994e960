"""Whether distant seeds are in the sky, and how well gap seeds know their depth, in games whose map is known.

A dataset is a recording of `record_game.py`, in a folder that has the map's name. Its points are true, but the HUD is
estimated, as in a training. Truth follows rays through the map.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from games.doom_map import Map
from record_game import TALL, UNIT

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.evidence.gap_points import SPACING, photos_to_fill
from ssa_nerfstudio.evidence.scene_photos import ScenePhoto, projections

STRETCH = UNIT * np.array([1, 1, TALL])
"""World units per unit of a map."""


@dataclass
class Command:
    """Print numbers of seeds, how many of the distant ones show the sky, and errors of the others' depths."""

    data: list[Path] = field(default_factory=list)
    """Recordings, each in a folder with its map's name, such as e1m5 or map10."""

    def run(self) -> None:
        """Measure recording by recording, and print a table.

        Raises:
            InputError: no dataset is given, one of them has no map's name, or ViZDoom is not installed.
        """
        if not self.data:
            raise InputError("no dataset is given", "add --data DIR, as benchmarks/record_game.py writes it")
        worlds = [_map(path) for path in self.data]
        rows = {path.name: _measure(path, world) for path, world in zip(self.data, worlds, strict=True)}
        rows["all"] = tuple(np.concatenate(parts) for parts in zip(*rows.values(), strict=True))
        print("| game | distant seeds | in the sky in most photos | in none | gap seeds | in the sky ", end="")
        print("| error of the depth: median | 90th percentile |")
        print(f"|{'---|' * 8}")
        for name, (shares, ratios) in rows.items():
            errors = np.abs(ratios[ratios > 0] - 1)
            quantiles = (f"{100 * np.quantile(errors, share):.1f} %" if len(errors) else "" for share in (0.5, 0.9))
            print(
                f"| {name} | {len(shares)} | {(shares >= 0.5).sum()} | {(shares == 0).sum()} | {len(ratios)} ", end=""
            )
            print(f"| {(ratios == 0).sum()} | {' | '.join(quantiles)} |")


def _map(path: Path) -> Map:
    try:
        import vizdoom as vzd
    except ImportError as error:
        raise InputError("ViZDoom is not installed", "pip install 'ssa-nerfstudio[games]'") from error
    name = path.resolve().name.upper()
    wad = Path(vzd.__path__[0]) / f"freedoom{2 if name.startswith('MAP') else 1}.wad"
    try:
        return Map.read(wad, name)
    except InputError as error:
        raise InputError(f"{path} has no map's name", "record it into a folder such as e1m5 or map10") from error


def _measure(path: Path, world: Map) -> tuple[np.ndarray, np.ndarray]:
    """Of each distant seed the share of the photos in which it is in the sky; of each gap seed its depth relative to
    the true one in the photo that it fills, 0 in the sky."""
    from ssa_nerfstudio.experiments.runs.run_configuration import configure
    from ssa_nerfstudio.plugin.extra_seeds import photos_of_scene, seeds_between

    config = configure("ssa-splatfacto", path, Path("outputs"), 1)
    model = config.pipeline.model
    model.overlay, model.distant_seeds, model.gap_seeds = "on", False, False
    pipeline = config.pipeline.setup(device="cpu", test_mode="val", world_size=1, local_rank=0)
    manager, outputs = pipeline.datamanager, pipeline.datamanager.train_dataparser_outputs
    photos = photos_of_scene(pipeline.model.artifacts, manager.cached_train, manager.train_dataset.cameras, None)
    transform, scale = outputs.dataparser_transform.double().numpy(), outputs.dataparser_scale

    def trace(photo: ScenePhoto, positions: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
        """Distances of positions from the camera, relative to the surface behind, and whether there is one."""
        camera = photo.view.position.double().numpy()
        origin = np.linalg.solve(transform[:, :3], camera / scale - transform[:, 3]) / STRETCH
        rays = np.linalg.solve(transform[:, :3], (positions.double().numpy() - camera).T / scale).T / STRETCH
        depth, solid = world.trace(origin, rays)
        return 1 / depth, solid

    seeds = seeds_between(outputs.metadata["points3D_xyz"], photos)
    distant, gaps = seeds.distant, seeds.gaps
    seen, sky = np.zeros(len(distant)), np.zeros(len(distant))
    for photo in photos:
        index = _in_frame(distant.positions, photo)
        if len(index):
            seen[index.numpy()] += 1
            sky[index.numpy()] += ~trace(photo, distant.positions[index])[1]
    ratios = np.full(len(gaps), np.nan)
    for photo in photos_to_fill(photos):
        # A seed is as wide as SPACING working pixels of the photo that it fills.
        pose, index = photo.view.world_to_camera.to(gaps.positions), _in_frame(gaps.positions, photo)
        depth = (gaps.positions[index] @ pose[:3, :3].T + pose[:3, 3])[:, 2]
        stated = gaps.widths[index] * photo.view.intrinsics[0, 0] / (SPACING * photo.reduction)
        own = (stated / depth - 1).abs() < 1e-4
        index = index[own & torch.from_numpy(np.isnan(ratios[index.numpy()]))]
        if len(index):
            ratio, solid = trace(photo, gaps.positions[index])
            ratios[index.numpy()] = np.where(solid, ratio, 0.0)
    return sky / np.maximum(seen, 1), ratios[np.isfinite(ratios)]


def _in_frame(positions: torch.Tensor, photo: ScenePhoto) -> torch.Tensor:
    """Indices of the positions [N, 3] in the frame of a photo."""
    [seen] = projections(positions, [photo])
    return seen.index


if __name__ == "__main__":
    run_script(Command)

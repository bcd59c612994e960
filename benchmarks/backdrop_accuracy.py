"""What a backdrop does for the clean render, by where it is: `python benchmarks/backdrop_accuracy.py --data DIR`

The backdrop comes after the last step, so that one training can be rendered without it and with others: where less of
the scene is left than each of several transmittances (`scene_photos.HIDDEN_BELOW`), by the layers that were learned.
"""

from __future__ import annotations

import statistics
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

from torch import Tensor
from torch.nn import Parameter

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.cli.option_bounds import Count, Factor, Share
from ssa_nerfstudio.data.transforms import Transforms
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.evidence.seeds import Seeds

if TYPE_CHECKING:
    from ssa_nerfstudio.experiments.runs.training_run import Outcome
    from ssa_nerfstudio.plugin.pipeline import SSAPipeline


@dataclass
class Command:
    """Train once; print the PSNR of the test views without a backdrop and with several."""

    data: Path
    """A nerfstudio dataset with an artifact and clean test photos, as `ssa simulate` writes it."""
    steps: Count = 1500
    """Training steps; every schedule is scaled to them."""
    scale_factor: Factor = 1.0
    """Training photos are resized by this; test photos keep their size."""
    settings: tuple[str, ...] = ("overlay=on", "strategy=mcmc")
    """Settings of the model as name=value."""
    hidden: tuple[Share, ...] = (0.1, 0.2, 0.3, 0.5)
    """Transmittances below which a pixel counts as hidden."""

    def run(self) -> None:
        """Train and print a table: the backdrop's seeds, mean, and each test view.

        Raises:
            InputError: the dataset cannot be trained on, or no overlay was trained.
        """
        Transforms.read(self.data)
        from ssa_nerfstudio.experiments.runs.flip_processes import FlipProcesses
        from ssa_nerfstudio.experiments.runs.training_run import evaluate

        outcome, pipeline = self._train()
        if not len(pipeline.model.artifacts):
            raise InputError("no overlay was trained", "add overlay=on to --settings")
        bare = {name: values.data for name, values in pipeline.model.gauss_params.items()}
        print("| hidden where T is below | seeds | PSNR, dB | test views |", "|---|---|---|---|", sep="\n")
        print(f"| no backdrop | | {_psnr(outcome.views)} |")
        for limit in self.hidden:
            backdrop = _backdrop(pipeline, limit)
            _put(pipeline, bare, backdrop)
            print(f"| {limit:g} | {len(backdrop)} | {_psnr(evaluate(pipeline, FlipProcesses(1)))} |")

    def _train(self) -> tuple[Outcome, SSAPipeline]:
        """A training that ends without a backdrop."""
        from ssa_nerfstudio.experiments.runs.run_configuration import configure, model_settings
        from ssa_nerfstudio.experiments.runs.training_run import train_and_evaluate
        from ssa_nerfstudio.plugin import extra_seeds

        found = extra_seeds.gap_points

        def between(*scene: Any) -> tuple[Seeds, Seeds]:
            seeds, _ = found(*scene)
            return seeds, Seeds.none(seeds.positions)

        settings = model_settings(self.settings)
        with tempfile.TemporaryDirectory() as scratch, patch.object(extra_seeds, "gap_points", between):
            config = configure("ssa-splatfacto", self.data, Path(scratch), self.steps, settings, self.scale_factor)
            outcome, pipeline, _ = train_and_evaluate(config, test_scale=1.0)
        return outcome, pipeline


def _backdrop(pipeline: SSAPipeline, limit: float) -> Seeds:
    """Seeds where the learned artifact has a transmittance below a limit."""
    from ssa_nerfstudio.evidence import scene_photos
    from ssa_nerfstudio.plugin.extra_seeds import photos_of_scene, seeds_between

    model, manager = pipeline.model, pipeline.datamanager
    with patch.object(scene_photos, "HIDDEN_BELOW", limit):
        photos = photos_of_scene(model.artifacts, manager.cached_train, manager.train_dataset.cameras, model.exposure)
    points = manager.train_dataparser_outputs.metadata["points3D_xyz"].to(photos[0].color)
    return seeds_between(points, photos).backdrop


def _put(pipeline: SSAPipeline, bare: dict[str, Tensor], backdrop: Seeds) -> None:
    """Give the scene Gaussians [N, ...] and a backdrop behind them."""
    from ssa_nerfstudio.plugin.training.seed_points import BACKDROP_OPACITY, add_seeds

    model = pipeline.model
    for name, values in bare.items():
        model.gauss_params[name] = Parameter(values.clone())
    add_seeds(backdrop, model.gauss_params, model.config.sh_degree, BACKDROP_OPACITY)


def _psnr(views: dict[str, dict[str, float]]) -> str:
    """Mean over test views, and each of them."""
    values = [view["psnr"] for view in views.values()]
    return f"{statistics.mean(values):.2f} | {', '.join(f'{value:.1f}' for value in values)}"


if __name__ == "__main__":
    run_script(Command)

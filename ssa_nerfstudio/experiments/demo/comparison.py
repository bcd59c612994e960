"""The demonstration: the same model without and with the overlay, on scenes with an artifact, against clean views."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ssa_nerfstudio.data.transforms import Transforms
from ssa_nerfstudio.experiments.effects.dashboard import Dashboard
from ssa_nerfstudio.experiments.effects.watermark import Watermark
from ssa_nerfstudio.experiments.runs.machine import versions
from ssa_nerfstudio.experiments.runs.run_configuration import configure
from ssa_nerfstudio.experiments.runs.training_run import Outcome, train_and_evaluate
from ssa_nerfstudio.experiments.runs.view_pictures import view_pictures
from ssa_nerfstudio.experiments.simulation.built_in_scene import DemoScene
from ssa_nerfstudio.plugin.pipeline import SSAPipeline

ARTIFACTS = {"dashboard": Dashboard, "watermark": Watermark}
"""The artifacts that the built-in scene is shown behind."""
METHODS: dict[str, dict[str, Any]] = {"overlay-off": {"overlay": "off"}, "ssa-splatfacto": {"overlay": "on"}}
"""The two trainings that are compared: one method, one setting apart."""
SMALL_SCENE: dict[str, Any] = {"num_downscales": 0, "densify_grad_thresh": 0.006}
"""For 160 x 112 pixels: full resolution from the start, and fewer new Gaussians than photos of megapixels need."""


@dataclass
class Comparison:
    """Both trainings on one dataset."""

    name: str
    """The artifact's name, or the capture's."""
    outcomes: dict[str, Outcome]
    """By method."""
    pictures: dict[str, np.ndarray]
    """Title to image [H, W, 3] in [0, 1], in the order of the sheet."""
    configs: dict[str, str]
    """By method: the run's config.yml."""
    clean_test_views: bool = True
    """Whether the test photos are known to be free of the artifact."""


@dataclass
class Demonstration:
    """Everything that the report shows."""

    comparisons: list[Comparison] = field(default_factory=list)

    def results(self) -> dict[str, Any]:
        """For results.json: each method's metrics on the first dataset, and all of them under `datasets`."""
        first = self.comparisons[0]
        metrics = {c.name: {m: _metrics(o) for m, o in c.outcomes.items()} for c in self.comparisons}
        return {
            **metrics[first.name],
            "datasets": metrics,
            "clean_test_views": first.clean_test_views,
            "versions": versions(),
        }


def demonstrate(output: Path, steps: int, on_step: Callable[[str, str, int], None]) -> Demonstration:
    """Build the scene behind each artifact and train both methods on it.

    Args:
        output: folder for datasets and runs; its `demo-data` and `demo-runs` are replaced.
        steps: training steps of each run.
        on_step: called with (dataset, method, finished steps).
    """
    scene = DemoScene()
    data, runs = output / "demo-data", output / "demo-runs"
    shutil.rmtree(data, ignore_errors=True)
    shutil.rmtree(runs, ignore_errors=True)
    data.mkdir(parents=True)
    demonstration = Demonstration()
    for name, artifact in ARTIFACTS.items():
        layers = artifact().layers(scene.height, scene.width, np.random.default_rng(0))
        scene.write(data / name, layers)
        demonstration.comparisons.append(compare(name, data / name, runs, steps, on_step, SMALL_SCENE))
    return demonstration


def compare(
    name: str,
    data: Path,
    runs: Path,
    steps: int,
    on_step: Callable[[str, str, int], None],
    model: dict[str, Any],
    scale_factor: float = 1.0,
) -> Comparison:
    """Train both methods on a nerfstudio dataset and take pictures of a test and a training view."""
    outcomes, configs, pipelines = {}, {}, {}
    for method, setting in METHODS.items():
        config = configure("ssa-splatfacto", data, runs / method, steps, {**model, **setting}, scale_factor)
        outcomes[method], pipelines[method], path = train_and_evaluate(
            config, lambda step, method=method: on_step(name, method, step)
        )
        configs[method] = str(path)
    clean = Transforms.read(data).test_photos_are_clean
    return Comparison(name, outcomes, _pictures(pipelines), configs, clean)


def _pictures(pipelines: dict[str, SSAPipeline]) -> dict[str, np.ndarray]:
    """A training photo, a test photo, what each method draws there, and the artifact that was learned."""
    off, on = view_pictures(pipelines["overlay-off"]), view_pictures(pipelines["ssa-splatfacto"])
    return {
        "training photo": on["photo"],
        "test photo": on["test"],
        "splats, overlay off": off["render"],
        "splats, ssa-splatfacto": on["render"],
        "artifact learned": on["artifact"],
        "matte": on["matte"],
    }


def _metrics(outcome: Outcome) -> dict[str, Any]:
    return {
        # The composite is not what the clean test photos show.
        **{k: value for k, value in outcome.metrics.items() if not k.endswith("_std") and k != "composite_psnr"},
        "seconds": sum(outcome.seconds.values()),
        "seconds_by_stage": outcome.seconds,
        "gaussians": outcome.gaussians,
    }

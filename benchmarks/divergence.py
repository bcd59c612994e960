"""Whether and when MCMC diverges behind an artifact, and which parameter does: `python benchmarks/divergence.py`

The same dataset is trained four times, with the overlay and the guards off and on. Each run gets a JSON file; the files
of the folder are plotted: the largest scale, the share of living Gaussians and the norm of all gradients by step.
"""

from __future__ import annotations

import itertools
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.cli.option_bounds import Count, Factor
from ssa_nerfstudio.data.training_requirements import check_training
from ssa_nerfstudio.data.transforms import Transforms
from ssa_nerfstudio.errors import TrainingError
from ssa_nerfstudio.experiments.runs.machine import versions

ALIVE = 0.005
"""Opacity above which a Gaussian is alive (MCMC's smallest)."""
PANELS = {"largest scale": "world units", "alive share": "of all Gaussians", "gradient norm": "2-norm of all gradients"}


@dataclass
class Command:
    """Train with MCMC, with and without overlay and guards, and plot how each run went."""

    data: Path
    """A nerfstudio dataset with an artifact in front (`ssa simulate --effects dashboard`)."""
    output: Path
    """Folder for a JSON file of each training, and for divergence.png."""
    overlay: tuple[Literal["off", "on"], ...] = ("off", "on")
    """Overlays to train with; several processes, one a GPU, can share the four trainings and the folder."""
    guards: tuple[bool, ...] = (False, True)
    """Whether to train with guards."""
    steps: Count = 15_000
    """Training steps of each run; schedules are scaled to them."""
    cap_max: Count = 300_000
    """The largest number of Gaussians."""
    scale_factor: Factor = 1.0
    """Photos are resized by this."""
    every: Count = 10
    """Steps between two recorded values."""

    def run(self) -> None:
        """Train, write, draw.

        Raises:
            InputError: the dataset cannot be trained on.
        """
        check_training(Transforms.read(self.data))
        self.output.mkdir(parents=True, exist_ok=True)
        for overlay, guards in itertools.product(self.overlay, self.guards):
            run = self._train(overlay, guards)
            print(f"{run['name']}: {run['verdict']}")
            asked = {"data": self.data.name, "steps": self.steps, "cap_max": self.cap_max, "every": self.every}
            path = self.output / f"{run['name'].replace(', ', '-').replace(' ', '-')}.json"
            path.write_text(json.dumps({**asked, "versions": versions(), **run}) + "\n")
        runs = [json.loads(path.read_text()) for path in sorted(self.output.glob("overlay-*.json"))]
        draw(runs, self.output / "divergence.png")

    def _train(self, overlay: str, guards: bool) -> dict[str, Any]:
        from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation

        from ssa_nerfstudio.experiments.runs.prepared_trainer import prepared_trainer
        from ssa_nerfstudio.experiments.runs.run_configuration import configure
        from ssa_nerfstudio.plugin.training.event_writers import no_event_writers_left

        model = {"overlay": overlay, "guards": guards, "cap_max": self.cap_max}
        config = configure("ssa-splatfacto-mcmc", self.data, self.output / "runs", self.steps, model, self.scale_factor)
        failure, notes = None, []
        with no_event_writers_left():
            trainer = prepared_trainer(config)

            @torch.no_grad()
            def note(step: int) -> None:
                if step % self.every:
                    return
                params = trainer.pipeline.model.gauss_params
                squares = torch.stack([p.grad.square().sum() for p in params.values() if p.grad is not None])
                finite = [torch.isfinite(p).all().float() for p in params.values()]
                alive = (torch.sigmoid(params["opacities"]) > ALIVE).float().mean()
                notes.append(torch.stack([params["scales"].max().exp(), alive, squares.sum().sqrt(), *finite]))

            # Before the densification, which replaces these parameters by new ones without gradients.
            trainer.callbacks.insert(0, TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], note))
            try:
                trainer.train()
            except TrainingError as failed:
                failure = str(failed)
        names = list(trainer.pipeline.model.gauss_params)
        table = torch.stack(notes).cpu().numpy().astype(float)
        steps = (np.arange(len(table)) * self.every).tolist()
        series = {name: [v if math.isfinite(v) else None for v in table[:, k]] for k, name in enumerate(PANELS)}
        broken = table[:, len(PANELS) :] == 0
        verdict = "it does not diverge"
        if broken.any():
            first = int(broken.any(axis=1).argmax())
            which = ", ".join(name for name, is_broken in zip(names, broken[first], strict=True) if is_broken)
            verdict = f"{which} first not finite at step {steps[first]}"
        elif failure is not None:
            verdict = failure
        name = f"overlay {overlay}, guards {'on' if guards else 'off'}"
        return {"name": name, "verdict": verdict, "failure": failure, "noted": steps, **series}


def draw(runs: list[dict[str, Any]], path: Path) -> None:
    """Plot every run's three series over the steps (see `Command`)."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(len(PANELS), 1, figsize=(9, 9), sharex=True, constrained_layout=True)
    for axis, (name, unit) in zip(axes, PANELS.items(), strict=True):
        for run in runs:
            values = [math.nan if v is None else v for v in run[name]]
            style = "--" if run["name"].endswith("guards on") else "-"
            axis.plot(run["noted"], values, style, label=f"{run['name']}: {run['verdict'][:60]}", linewidth=1)
        axis.set_ylabel(f"{name}\n({unit})")
        if name != "alive share":
            axis.set_yscale("log")
    axes[-1].set_xlabel("step")
    axes[0].legend(fontsize=8)
    figure.savefig(path, dpi=130)
    pyplot.close(figure)


if __name__ == "__main__":
    run_script(Command)

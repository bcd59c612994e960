"""What the overlay's elements cost a frame of the viewer: `python benchmarks/viewer_frames.py --data DIR`

One scene is drawn without artifact, with one that is off, and with one that is shown, in turns, so that a machine that
drifts drifts for all three. Prints milliseconds and the ratios with their 95 % intervals.
"""

from __future__ import annotations

import copy
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
import tyro
from nerfstudio.viewer.render_state_machine import RenderStateMachine

from ssa_nerfstudio.experiments.runs.training_run import configure, train_and_evaluate, versions


@dataclass
class Command:
    """Measure frames of the viewer."""

    data: Path
    """A nerfstudio dataset."""
    steps: int = 100
    """Training steps before the measurement: how many Gaussians there are decides what a frame costs."""
    frames: int = 200
    """Frames of each kind; a tenth more warm up."""
    width: int = 1024
    """Of the viewport, pixels."""
    height: int = 576
    """Of the viewport, pixels."""

    def run(self) -> None:
        """Train, draw in turns, and print a line for each kind."""
        with TemporaryDirectory() as folder:
            config = configure("ssa-splatfacto", self.data, Path(folder), self.steps, {"overlay": "on"})
            _, pipeline, _ = train_and_evaluate(config)
        model = pipeline.eval().model
        camera = copy.deepcopy(pipeline.datamanager.eval_dataset.cameras[0:1]).to(model.device)
        camera.rescale_output_resolution(self.width / int(camera.width))
        camera.width[:], camera.height[:] = self.width, self.height
        artifacts, nothing = model.artifacts, type(model.artifacts)()

        def draw(kind: str) -> float:
            model.artifacts = nothing if kind == "without" else artifacts
            model._controls.a_show.default_value = kind == "shown"
            _wait()
            start = time.perf_counter()
            model.get_outputs_for_camera(camera)["rgb"].cpu()
            return time.perf_counter() - start

        times = {kind: np.empty(self.frames) for kind in ("without", "off", "shown")}
        warm_up = self.frames // 10

        def take_turns() -> None:
            with torch.no_grad():
                for frame in range(-warm_up, self.frames):
                    for kind, taken in times.items():
                        seconds = draw(kind)
                        if frame >= 0:
                            taken[frame] = seconds

        _in_a_viewer(take_turns)
        milliseconds = 1e3 * np.median(times["without"])
        where = f"{model.num_points} Gaussians, {self.width} x {self.height}, {versions()['device']}"
        print(f"without an overlay: {milliseconds:.2f} ms a frame ({where})")
        for kind in ("off", "shown"):
            print(f"{kind}: {_ratio(times[kind], times['without'])}")


def _in_a_viewer(work: Callable[[], None]) -> None:
    """Do it in a thread of the viewer's kind, by which the model knows whom it draws for."""
    failed: list[BaseException] = []

    class Drawing(RenderStateMachine):
        def __init__(self) -> None:
            threading.Thread.__init__(self)

        def run(self) -> None:
            try:
                work()
            except BaseException as error:
                failed.append(error)

    thread: Any = Drawing()
    thread.start()
    thread.join()
    if failed:
        raise failed[0]


def _ratio(times: np.ndarray, reference: np.ndarray) -> str:
    percent = 100 * (times / reference - 1)
    draws = np.random.default_rng(0).choice(percent, (2_000, len(percent)))
    low, high = np.percentile(np.median(draws, axis=1), [2.5, 97.5])
    return f"{np.median(percent):+.2f} % (95 %: {low:+.2f} to {high:+.2f} %)"


def _wait() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()


if __name__ == "__main__":
    tyro.cli(Command).run()

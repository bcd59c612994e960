"""Cost of the overlay in a frame of the viewer: `python benchmarks/viewer_frame_time.py --data DIR`

One scene is drawn without an overlay, with one that is hidden and with one that is shown, in turns, so that drift of
the machine affects all three. Prints milliseconds and the ratios with their 95 % intervals.
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

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.cli.option_bounds import Count
from ssa_nerfstudio.experiments.benchmark.report.bootstrap import percent_change
from ssa_nerfstudio.experiments.runs.machine import versions


@dataclass
class Command:
    """Time frames of the viewer without an overlay, with a hidden one and with a shown one."""

    data: Path
    """A nerfstudio dataset."""
    steps: Count = 100
    """Training steps before the measurement; the number of Gaussians decides what a frame costs."""
    frames: Count = 200
    """Frames of each kind; a tenth as many warm up."""
    width: Count = 1024
    """Width of the viewport, pixels."""
    height: Count = 576
    """Height of the viewport, pixels."""

    def run(self) -> None:
        """Train, draw in turns, and print a line for each kind.

        Raises:
            InputError: the dataset cannot be trained on.
        """
        from ssa_nerfstudio.experiments.runs.run_configuration import configure
        from ssa_nerfstudio.experiments.runs.training_run import train_and_evaluate

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
            print(f"{kind}: {percent_change(times[kind], times['without'])}")


def _in_a_viewer(work: Callable[[], None]) -> None:
    """Work in a thread of the viewer's class, from which the model knows that it draws for the viewer."""
    from nerfstudio.viewer.render_state_machine import RenderStateMachine

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


def _wait() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()


if __name__ == "__main__":
    run_script(Command)

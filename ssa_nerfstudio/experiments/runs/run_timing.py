"""What a training takes: seconds of its stages, memory, and metrics at marked steps with the clock stopped."""

from __future__ import annotations

import resource
import time
from collections.abc import Callable
from typing import Literal, cast

import torch

from ssa_nerfstudio.plugin.datamanager import SSADatamanager
from ssa_nerfstudio.plugin.pipeline import SSAPipeline


class TimedDatamanager(SSADatamanager):
    """A datamanager that tells what decoding and undistorting took."""

    photo_seconds = 0.0

    def _load_images(self, split: Literal["train", "eval"], cache_images_device: Literal["cpu", "gpu"]):
        start = time.perf_counter()
        photos = super()._load_images(split, cache_images_device)
        self.photo_seconds += time.perf_counter() - start
        return photos


class TimedPipeline(SSAPipeline):
    """A pipeline that tells what examining the photos took (the overlay's statistics), without decoding them."""

    statistics_seconds = 0.0

    def _examine_photos(self) -> None:
        start = time.perf_counter()
        super()._examine_photos()
        # The photos may have been decoded meanwhile.
        self.statistics_seconds = time.perf_counter() - start - cast(TimedDatamanager, self.datamanager).photo_seconds

    def read_photos(self, test_scale: float | None) -> None:
        """Decode the training photos, which nothing may have asked for yet; choose the test photos' size."""
        _ = self.datamanager.cached_train
        if test_scale is not None and test_scale != self.datamanager.config.camera_res_scale_factor:
            self.datamanager.config.camera_res_scale_factor = test_scale
            self.datamanager.eval_dataset = self.datamanager.create_eval_dataset()


class StepClock:
    """Seconds of training, stopped while test views are evaluated."""

    def __init__(
        self,
        pipeline: TimedPipeline,
        steps: int,
        marks: tuple[int, ...],
        on_step: Callable[[int], None],
        judge: Callable[[], dict[str, dict[str, float]]],
    ) -> None:
        self.cuda = pipeline.model.device.type == "cuda"
        self.training = self.paused = self.peak_memory_mb = 0.0
        self.curve: list[dict[str, float]] = []
        self.views: dict[str, dict[str, float]] = {}
        self._pipeline, self._steps, self._marks = pipeline, steps, set(marks)
        self._on_step, self._judge = on_step, judge

    def start(self) -> None:
        """Start counting."""
        self._began = self._now()

    def after_step(self, step: int) -> None:
        """What happens after every training step, given its number from 0."""
        done = step + 1
        self._on_step(done)
        if done != self._steps and done not in self._marks:
            return
        stopped = self._now()
        self.training = stopped - self._began - self.paused
        if self.cuda:
            self.peak_memory_mb = torch.cuda.max_memory_allocated() / 2**20
        else:
            self.peak_memory_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
        if done in self._marks:
            self.views = self._judge()
            seconds = self._pipeline.statistics_seconds + self.training
            gaussians = self._pipeline.model.num_points
            self.curve.append({"step": done, "seconds": seconds, "gaussians": gaussians, **mean_metrics(self.views)})
            self.paused += self._now() - stopped

    def _now(self) -> float:
        if self.cuda:
            torch.cuda.synchronize()
        return time.perf_counter()


def mean_metrics(views: dict[str, dict[str, float]]) -> dict[str, float]:
    """Mean over the views of every metric."""
    names = next(iter(views.values()))
    return {name: sum(view[name] for view in views.values()) / len(views) for name in names}

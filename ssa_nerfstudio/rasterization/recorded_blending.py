"""Sorting and blending with gsplat's kernels as a CUDA graph, in lists with room for more than a view needs."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ssa_nerfstudio._system.cuda_graphs import CapturedPrograms, Record, RecordedCalls
from ssa_nerfstudio.rasterization import cuda
from ssa_nerfstudio.rasterization.interface import Cameras, RenderOptions
from ssa_nerfstudio.rasterization.tile_lists import entries_of, list_tiles

ROOM = 1.5
"""Entries of the lists, as a multiple of the most that a view has needed."""
TIGHT = 0.9
"""Share of the entries above which the lists become longer."""
SHRINK = 0.9
"""Least factor from the length of the lists to that for other Gaussians, each as many of which need as many entries."""
LOOK_EVERY = 10
"""Steps between two looks at what views have needed; each sees what was so at the one before, and waits for nothing."""


class RecordedBlending:
    """Blends the Gaussians of one camera, again and again, for a training.

    How many entries the lists need differs from view to view. A view that needs more than there are is drawn as NaN, so
    that its step is skipped (`plugin.training.nonfinite`), and the lists become longer some steps later.
    """

    def __init__(self, record: Callable[[], Record] = CapturedPrograms) -> None:
        """Record nothing yet; `record` is what records (`RecordedCalls`)."""
        self._calls = RecordedCalls(record)
        self._count, self._frames = 0, set[tuple[int, int]]()
        self._capacity = 0
        self._steps = 0

    def __call__(
        self, projected: cuda.Projected, channels: Tensor, cameras: Cameras, options: RenderOptions
    ) -> tuple[Tensor, Tensor]:
        """As `cuda.blend`, of one camera, without a background, in the mode RGB."""
        means2d, conics, alphas, depths, radii = projected
        count, frame = means2d.shape[1], (cameras.width, cameras.height)
        if count != self._count or frame not in self._frames:
            self._begin(frame, means2d, radii)
        elif self._steps % LOOK_EVERY == 0:
            self._look()
        self._steps += 1
        self._magnitudes.grad = None
        self._centers = means2d if options.absgrad else None
        capacity = self._capacity

        def compute(*values: Tensor) -> tuple[Tensor, ...]:
            centers, conics, channels, alphas, depths, radii, magnitudes = values
            wanted = magnitudes if options.absgrad else None
            lists = list_tiles(centers[0], radii[0], depths[0], cameras.width, cameras.height, capacity)
            torch.maximum(self._needed, lists.needed, out=self._needed)
            missing = torch.zeros_like(alphas[0, 0]).masked_fill_(lists.needed > capacity, torch.nan)
            image, alpha = cuda.blend_lists(centers, conics, channels, alphas, cameras, lists, wanted)
            return image + missing, alpha

        inputs = [means2d, conics, channels, alphas, depths, radii]
        return self._calls(compute, inputs, [self._magnitudes], frame, epoch=(count, capacity))  # pyright: ignore

    def _begin(self, frame: tuple[int, int], means2d: Tensor, radii: Tensor) -> None:
        """Choose the lists' length for other Gaussians, or for a frame that is new; waits for the device."""
        count, device = means2d.shape[1], means2d.device
        here = int(entries_of(means2d[0], radii[0], *frame)[1].prod(dim=1).sum())
        if not self._capacity:
            self._needed = torch.zeros((), dtype=torch.int64, device=device)
            self._seen = torch.zeros((), dtype=torch.int64, pin_memory=device.type == "cuda")
        if count == self._count:
            self._capacity = max(self._capacity, _room_for(here))
        else:
            growth = count / max(self._count, 1)
            before = max(int(self._needed), int(SHRINK * self._capacity / ROOM))
            self._capacity = _room_for(max(here, int(growth * before)))
            self._needed.zero_()
            self._seen.zero_()
            self._count, self._frames = count, set()
            self._magnitudes = torch.zeros_like(means2d).requires_grad_()
            self._magnitudes.register_post_accumulate_grad_hook(self._hand_over)
        self._frames.add(frame)

    def _look(self) -> None:
        """Make the lists longer where a view has needed nearly all of them."""
        needed = int(self._seen)
        if needed > TIGHT * self._capacity:
            self._capacity = _room_for(needed)
        self._seen.copy_(self._needed, non_blocking=True)

    def _hand_over(self, magnitudes: Tensor) -> None:
        """Leave the summed magnitudes of the centers' gradients where `interface.Render` says."""
        if self._centers is not None:
            self._centers.absgrad = magnitudes.grad  # pyright: ignore[reportAttributeAccessIssue]
            self._centers = None


def _room_for(needed: int) -> int:
    return max(1, int(ROOM * needed))

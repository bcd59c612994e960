"""Several effects in front of one another: I = clip(T2 (T1 C + B1) + B2, 0, 1), clipped once, at the end."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce

import numpy as np

from ssa_nerfstudio.experiments.effects.layers import Box, Layers, VaryingLayers


class Composition:
    """Effects of one frame, the first nearest to the scene and the last nearest to the camera.

    Layers that all views share are composed once; only the rectangle around the effects that vary is composed for each
    view.
    """

    def __init__(self, parts: Sequence[Layers | VaryingLayers], coverage: np.ndarray | None = None) -> None:
        """Store the effects' layers, all of one frame size.

        Args:
            parts: at least one.
            coverage: where they are seen, float32 [H, W] in [0, 1]; everywhere where None.
        """
        self.parts = list(parts)
        self._coverage = coverage
        self._varying = [part for part in self.parts if isinstance(part, VaryingLayers)]
        self.box: Box | None = _bounding_box([part.box for part in self._varying]) if self._varying else None
        """Rectangle in which views differ; None where none does."""
        still = [part for part in self.parts if isinstance(part, Layers)]
        self.static: Layers | None = self._seen(reduce(Layers.behind, still)) if still else None
        """The layers outside `box`; None where nothing covers it."""

    def view(self, generators: Sequence[np.random.Generator]) -> Layers:
        """Draw one view's layers inside `box`, rounded to float16 so that they can be stored as such, exactly.

        Args:
            generators: one for each effect that varies, in their order.

        Raises:
            ValueError: no effect varies.
        """
        if self.box is None:
            raise ValueError("no effect varies from view to view")
        draw = iter(generators)
        inside = reduce(
            Layers.behind,
            (
                part.crop(self.box) if isinstance(part, Layers) else _pasted(part.view(next(draw)), part.box, self.box)
                for part in self.parts
            ),
        )
        inside = self._seen(inside, self.box)
        pair = inside.transmittance, inside.addition
        return Layers(*(values.astype(np.float16).astype(np.float32) for values in pair))

    def within(self, coverage: np.ndarray) -> Composition:
        """The same, seen only where coverage float32 [H, W] in [0, 1] is 1."""
        return Composition(self.parts, coverage)

    def _seen(self, layers: Layers, box: Box = np.s_[:, :]) -> Layers:
        return layers if self._coverage is None else layers.within(self._coverage[box])

    def apply(self, image: np.ndarray, inside: Layers | None) -> np.ndarray:
        """Put the artifact in front of an image.

        Args:
            image: clean photo, uint8 [H, W, 3].
            inside: result of `view` where effects vary, else None.

        Returns:
            uint8 [H, W, 3].
        """
        formed = image.copy() if self.static is None else self.static.apply(image)
        if inside is not None and self.box is not None:
            formed[self.box] = inside.apply(np.ascontiguousarray(image[self.box]))
        return formed

    def whole(self, inside: Layers | None, height: int, width: int) -> Layers:
        """Return the layers of the whole frame: `static`, with `inside` in its box."""
        base = Layers.clear(height, width) if self.static is None else self.static
        return base if inside is None or self.box is None else base.pasted(self.box, inside)


def _bounding_box(boxes: list[Box]) -> Box:
    rows, columns = (
        slice(min(box[axis].start for box in boxes), max(box[axis].stop for box in boxes)) for axis in (0, 1)
    )
    return rows, columns


def _pasted(layers: Layers, box: Box, frame: Box) -> Layers:
    """Layers of `box` in a rectangle `frame` around it that is clear elsewhere."""
    if box == frame:
        return layers
    rows, columns = (slice(b.start - f.start, b.stop - f.start) for b, f in zip(box, frame, strict=True))
    return Layers.clear(*(side.stop - side.start for side in frame)).pasted((rows, columns), layers)

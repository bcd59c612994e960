"""albumentations' `Spatter`, drawn once for a capture instead of for every photo: what rain and mud share."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.effects.parameters import STRICT, Color, Share, Unit

if TYPE_CHECKING:
    from albumentations import Spatter


@dataclass(frozen=True, config=STRICT)
class SpatterEffect:
    """Parameters of `Spatter`, under clearer names."""

    intensity: Share = 0.6
    """Spatter's `intensity`, in (0, 1]."""
    color: Color = (255, 255, 255)
    """Spatter's `color`, sRGB, 0..255."""
    mean: Unit = 0.65
    """Spatter's `mean`: of the liquid layer's normal distribution, in [0, 1]; higher covers more."""
    deviation: Unit = 0.3
    """Spatter's `std`: standard deviation of the liquid layer before it is blurred, in [0, 1]."""
    blur: Annotated[float, Field(ge=0.5, le=50)] = 2.0
    """Spatter's `gauss_sigma`: blur of the liquid layer, pixels, in [0.5, 50]; sets the size of the spots."""
    threshold: Unit = 0.68
    """Spatter's `cutout_threshold`: liquid below this leaves no trace, in [0, 1]."""

    def _draw(
        self, mode: Literal["rain", "mud"], height: int, width: int, rng: np.random.Generator
    ) -> dict[str, np.ndarray]:
        """Draw the arrays that `Spatter` puts into a photo.

        Args:
            mode: which of Spatter's two formations.
            height, width: frame size, pixels.
            rng: seeds the transform.

        Returns:
            Spatter's own: `drops` for rain, `mud` and `non_mud` for mud, each float [height, width, 3].

        Raises:
            InputError: albumentations is not installed.
        """
        transform = _spatter(mode)(
            mode=mode,
            color=self.color,
            intensity=(self.intensity, self.intensity),
            mean=(self.mean, self.mean),
            std=(self.deviation, self.deviation),
            gauss_sigma=(self.blur, self.blur),
            cutout_threshold=(self.threshold, self.threshold),
            p=1.0,
        )
        transform.set_random_seed(int(rng.integers(2**31)))
        drawn: dict[str, Any] = transform.get_params_dependent_on_data({"shape": (height, width, 3)}, {})
        return {name: values.astype(np.float32) for name, values in drawn.items() if isinstance(values, np.ndarray)}


def _spatter(effect: str) -> type[Spatter]:
    """Import albumentations' class without the side effects of its import."""
    # It asks its server for a newer version, which stalls without a network.
    os.environ.setdefault("NO_ALBUMENTATIONS_UPDATE", "1")
    # It imports torch where it can, for a transform that is not used here: two of the three seconds that it takes.
    hidden = "torch" not in sys.modules
    if hidden:
        sys.modules["torch"] = None  # type: ignore[assignment]
    try:
        from albumentations import Spatter
    except ModuleNotFoundError as error:
        raise InputError(
            f"the effect {effect} needs the package {error.name}", "pip install 'ssa-nerfstudio[experiments]'"
        ) from error
    finally:
        if hidden:
            del sys.modules["torch"]
    return Spatter

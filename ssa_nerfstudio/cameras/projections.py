"""What photos can be projections of, and the faces that panoramas are cut into; light, for commands' options."""

from __future__ import annotations

from typing import Literal

Projection = Literal["auto", "perspective", "fisheye", "equirectangular"]
"""Of photos; auto: as `data.equirectangular.wraps_around` says."""
FaceName = Literal["front", "right", "back", "left", "up", "down"]
"""Where a face looks."""

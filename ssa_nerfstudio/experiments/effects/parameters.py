"""Types of an effect's parameters; pydantic checks their ranges whenever an effect is made."""

from __future__ import annotations

from typing import Annotated

from pydantic import ConfigDict, Field

STRICT = ConfigDict(strict=True, extra="forbid")
"""Configuration of every effect: no conversion but of whole numbers to floats, no unknown parameter."""
Share = Annotated[float, Field(gt=0, le=1)]
"""A number in (0, 1]."""
Unit = Annotated[float, Field(ge=0, le=1)]
"""A number in [0, 1]."""
Channel = Annotated[int, Field(ge=0, le=255)]
Color = tuple[Channel, Channel, Channel]
"""An sRGB color, 0..255."""

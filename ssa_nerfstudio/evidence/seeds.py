"""Seeds: points that a scene starts from beside those of structure from motion."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Seeds:
    """Points with a color and a width."""

    positions: Tensor
    """[N, 3], world units."""
    colors: Tensor
    """[N, 3] in [0, 1]."""
    widths: Tensor
    """[N], world units: about the distance to the next seed."""

    def __len__(self) -> int:
        return len(self.positions)

    @classmethod
    def none(cls, like: Tensor) -> Seeds:
        """No seeds, of the dtype and on the device of a tensor."""
        return cls(like.new_zeros(0, 3), like.new_zeros(0, 3), like.new_zeros(0))

    @classmethod
    def joined(cls, *parts: Seeds) -> Seeds:
        """All seeds of at least one part, in order."""
        return cls(*(torch.cat([getattr(part, name) for part in parts]) for name in ("positions", "colors", "widths")))

    def subset(self, which: Tensor) -> Seeds:
        """Those of which `which` [N] is True."""
        return Seeds(self.positions[which], self.colors[which], self.widths[which])

    def table(self) -> Tensor:
        """[N, 7], for a checkpoint: positions, colors and widths."""
        return torch.cat([self.positions, self.colors, self.widths[:, None]], dim=-1)

    @classmethod
    def of_table(cls, table: Tensor) -> Seeds:
        """The seeds of a `table`."""
        return cls(table[:, :3], table[:, 3:6], table[:, 6])

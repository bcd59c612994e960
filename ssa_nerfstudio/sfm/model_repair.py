"""What became of a model that COLMAP had made behind an artifact."""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import dataclass

import numpy as np

from ssa_nerfstudio._system.name_list import name_list
from ssa_nerfstudio.sfm.existing_model import ExistingModel
from ssa_nerfstudio.sfm.ingest import Photo


@dataclass(frozen=True)
class Repair:
    """What was kept of a model, dropped, and found."""

    photos: int
    """Number of photos, with a pose or without."""
    posed: int
    """Number of those that had a pose."""
    refused: tuple[str, ...]
    """Photos whose pose the features off the artifact contradict; found anew, or without a pose."""
    added: tuple[str, ...]
    """Photos that had no pose and have one now."""
    observations: int
    """Number of observations of points in the model."""
    on_artifact: int
    """Number of those that lay on the masked artifact."""

    @property
    def anew(self) -> bool:
        """Whether the poses were of no use."""
        return len(self.refused) == self.posed

    @classmethod
    def of(
        cls,
        known: ExistingModel,
        photos: Sequence[Sequence[Photo]],
        masks: Sequence[np.ndarray | None],
        kept: Set[str],
        registered: Set[str],
    ) -> Repair:
        """Compare a model with what came of it.

        Args:
            known: the model.
            photos: of the dataset, for each of its cameras.
            masks: bool [H, W] for each, False on the artifact; None: nothing was masked.
            kept: names of the photos whose poses were kept.
            registered: names of the photos that have a pose now.
        """
        refused, added, observations, on_artifact = [], [], 0, 0
        for source, each, mask in zip(known.sources, photos, masks, strict=True):
            for file, photo in zip(source.photos, each, strict=True):
                if (before := known.photos.get(file)) is None:
                    added += [photo.source] if photo.name in registered else []
                    continue
                refused += [] if photo.name in kept else [photo.source]
                observations += len(before.observations)
                if mask is not None:
                    x, y = np.clip(before.observations.astype(int).T, 0, [[mask.shape[1] - 1], [mask.shape[0] - 1]])
                    on_artifact += int((~mask[y, x]).sum())
        total = sum(map(len, photos))
        return cls(total, len(known.photos), tuple(refused), tuple(added), observations, on_artifact)

    def in_words(self) -> str:
        """One sentence without a period."""
        words = [f"{self.posed} of {self.photos} photos had a pose"]
        if self.on_artifact:
            words.append(f"{self.on_artifact:,} of {self.observations:,} observations lay on the artifact, dropped")
        if self.anew:
            words.append("most poses do not fit the photos off the artifact, all were found anew")
        elif self.refused:
            words.append(f"poses that do not fit the photos were dropped and tried again: {_some(self.refused)}")
        if self.added:
            words.append(f"photos without a pose have one now: {_some(self.added)}")
        return "; ".join(words)


def _some(names: Sequence[str]) -> str:
    """Their number, and the first of them."""
    return f"{len(names)} ({name_list(names)})"

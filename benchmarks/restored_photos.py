"""Restored photos against their clean counterparts: `python benchmarks/restored_photos.py --load-config CONFIG ...`

Each photo is restored as `ssa export-overlay --apply` does it, and so is its clean counterpart, which has to be left as
it is. Prints one row.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from PIL import Image

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.cli.option_bounds import Share
from ssa_nerfstudio.data.photos import read_photo
from ssa_nerfstudio.errors import InputError

BLOB = 50
"""Gray levels by which a pixel has to be wrong to be seen as part of a blob."""


@dataclass
class Command:
    """Measure restored photos where their clean counterparts are known."""

    load_config: Path
    """The run's config.yml; it has one camera."""
    photos: Path
    """Folder of photos with the artifact."""
    clean: Path
    """Folder of their clean counterparts, of the same names up to the suffix; others are ignored."""
    threshold: Share = 0.5
    """Matte above which a pixel counts as hidden."""

    def run(self) -> None:
        """Restore and print.

        Raises:
            InputError: no photo has a counterpart, or one cannot be restored.
        """
        from ssa_nerfstudio.export.artifact_layers import raw_layers, undistorted_layers
        from ssa_nerfstudio.export.checkpoint import Checkpoint
        from ssa_nerfstudio.export.restoration import find_photos, restore_photos

        checkpoint = Checkpoint.read(self.load_config, None)
        frames = [*raw_layers(checkpoint), *undistorted_layers(checkpoint)]
        counterparts = {path.stem: path for path in find_photos(self.clean)}
        truths = {p: counterparts[p.stem] for p in find_photos(self.photos) if p.stem in counterparts}
        # Test views have no artifact: they are their own counterparts.
        truths = {p: clean for p, clean in truths.items() if (_read(p) != _read(clean)).any()}
        if not truths:
            raise InputError(f"no photo in {self.photos} differs from one of its name in {self.clean}")
        with TemporaryDirectory() as scratch:
            out = Path(scratch)
            found = list(restore_photos(self.photos, [*truths], frames, out / "with", self.threshold))
            clean = list(restore_photos(self.clean, [*truths.values()], frames, out / "clean", self.threshold))
            errors = [
                self._errors(path, truth, out / "with")
                for (path, truth), photo in zip(truths.items(), found, strict=True)
                if photo.shows
            ]
        # Where all of the artifact is hidden, nothing of it is there to be compared.
        inside, before, outside, holes, blobs = (float(np.nanmean(column)) for column in zip(*errors, strict=True))
        row = [f"{sum(p.shows for p in found)} of {len(found)}", f"{sum(p.shows for p in clean)} of {len(clean)}"]
        row += [f"{_decibels(before)} / {_decibels(inside)}", _decibels(outside), f"{holes:.0%}", f"{blobs:.2%}"]
        print("| restored | clean photos, too | artifact: photo / restored, dB | elsewhere, dB | hidden | blobs |")
        print(f"|---|---|---|---|---|---|\n| {' | '.join(row)} |")

    def _errors(self, path: Path, truth: Path, out: Path) -> list[float]:
        """Mean squared errors of the restored and of the given photo where the artifact is, of the restored elsewhere,
        both of what is recovered; the share of the artifact that is not, and of all that is wrong by BLOB."""
        from ssa_nerfstudio.export.restoration import NOISE

        photo, clean = _read(path).astype(float), _read(truth).astype(float)
        restored = _read((out / "photos" / path.relative_to(self.photos)).with_suffix(".png")).astype(float)
        height, width = photo.shape[:2]
        seen = np.asarray(Image.open(out / f"mask_white_is_scene_{width}x{height}.png")) > 0
        artifact = (np.abs(photo - clean) > 255 * NOISE).any(axis=-1)
        there, elsewhere = seen & artifact, seen & ~artifact
        wrong = (np.abs(restored - clean) > BLOB).any(axis=-1) & seen
        squares = [((a - clean)[there] ** 2).mean() if there.any() else math.nan for a in (restored, photo)]
        return [*squares, ((restored - clean)[elsewhere] ** 2).mean(), 1 - seen[artifact].mean(), wrong.mean()]


def _read(path: Path) -> np.ndarray:
    from ssa_nerfstudio.export.restoration import photo_size

    return read_photo(path, photo_size(path))


def _decibels(squared: float) -> str:
    return "-" if math.isnan(squared) else f"{10 * math.log10(255**2 / squared):.1f}"


if __name__ == "__main__":
    run_script(Command)

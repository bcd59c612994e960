"""The folder of a benchmark: where its datasets, results, pictures, logs and unfinished runs are."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from ssa_nerfstudio._system.file_lock import locked_folder


@dataclass(frozen=True)
class ResultsFolder:
    """The output folder of `ssa bench` and `ssa tradeoff`."""

    folder: Path

    @property
    def scenes(self) -> Path:
        """Prepared datasets by `Run.dataset`."""
        return self.folder / "scenes"

    @property
    def artifacts(self) -> Path:
        """Drawn effects: all that a machine without albumentations lacks."""
        return self.folder / "artifacts"

    def result(self, run: str) -> Path:
        """The JSON of a run."""
        return self.folder / "results" / f"{run}.json"

    def pictures(self, run: str) -> Path:
        """Folder of a run's pictures."""
        return self.folder / "pictures" / run

    def model(self, run: str) -> Path:
        """Where a run's config.yml and checkpoint are kept if that is asked for; an absolute path."""
        return self.folder.resolve() / "models" / run

    def log(self, run: str) -> Path:
        """What a run printed."""
        return self.folder / "logs" / f"{run}.log"

    @property
    def unfinished(self) -> Path:
        """Folders of the runs at work; what interrupted runs leave here is cleared."""
        return self.folder / "running"

    def running(self, run: str) -> Path:
        """Where a run works until it has finished."""
        return self.unfinished / run

    def request(self, run: str) -> Path:
        """What is asked of a run at work; removing it stops the run."""
        return self.running(run) / "request.json"

    def progress(self, run: str) -> Path:
        """What a run at work does, and how many steps are done, in one line."""
        return self.running(run) / "progress"

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Lock the folder against a second benchmark, and clear what interrupted runs left.

        Raises:
            InputError: another process holds it, or it cannot be written.
        """
        with locked_folder(self.folder, "ssa bench"):
            shutil.rmtree(self.unfinished, ignore_errors=True)
            yield

"""The folder of a benchmark: where its datasets, results, pictures, logs and unfinished runs are."""

from __future__ import annotations

import fcntl
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from ssa_nerfstudio.errors import refuse


@dataclass(frozen=True)
class Workplace:
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

    def log(self, run: str) -> Path:
        """What a run printed."""
        return self.folder / "logs" / f"{run}.log"

    def running(self, run: str) -> Path:
        """Where a run works until it has finished; what an interrupted one left there means nothing."""
        return self.folder / "running" / run

    @contextmanager
    def held(self) -> Iterator[None]:
        """Keeps a second benchmark out of the folder, and clears what interrupted runs left.

        Raises:
            BadInput: another process holds it, or it cannot be written.
        """
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            lock = (self.folder / ".lock").open("w")
        except OSError as error:
            raise refuse(f"{self.folder} cannot be written ({error}); name another --output") from error
        with lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                raise refuse(
                    f"another ssa bench is at work in {self.folder}; wait for it, or name another --output"
                ) from error
            shutil.rmtree(self.folder / "running", ignore_errors=True)
            yield

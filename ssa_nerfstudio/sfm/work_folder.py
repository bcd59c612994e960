"""The folder in which a capture is worked on: it outlives a kill, and becomes the output only when complete."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ssa_nerfstudio._system.file_lock import locked_folder
from ssa_nerfstudio.errors import InputError


class Work:
    """Folders of work beside the output, each kept for the next run as long as what it was made from stays the same."""

    def __init__(self, output: Path) -> None:
        """Take the output: the work is done in `.NAME.work` beside it."""
        self.output = output
        self.folder = output.parent / f".{output.name}.work"
        self.kept = False
        """Whether a refusal leaves the work for the next run."""

    def room(self, name: str, made_from: Any) -> Path:
        """A folder, empty if it was made from something else or not at all.

        Args:
            name: of the folder.
            made_from: what its contents follow from, JSON.
        """
        folder, record = self.folder / name, self.folder / f"{name}.json"
        text = json.dumps(made_from, sort_keys=True)
        if not record.is_file() or record.read_text(encoding="utf-8") != text:
            record.unlink(missing_ok=True)
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            record.write_text(text, encoding="utf-8")
        return folder

    def discard(self) -> None:
        """Removes all work."""
        shutil.rmtree(self.folder, ignore_errors=True)


@contextmanager
def resumable_work(output: Path) -> Iterator[Work]:
    """Work towards `output`, alone; what a run leaves behind when it is killed, the next one finds.

    A refusal removes the work, unless it is marked as kept, or memory was all that lacked.

    Raises:
        InputError: `output` exists or cannot be written, another process works towards it, or memory ran out.
    """
    work = Work(output)
    with locked_folder(work.folder, "ssa process"):
        try:
            # Only now: another process may have completed it before it let go of the work.
            if output.exists():
                raise InputError(f"{output} exists already", "remove it or name another folder with --output")
            yield work
        except InputError:
            if not work.kept:
                work.discard()
            raise
        except KeyboardInterrupt as error:
            raise KeyboardInterrupt(f"stopped; the same command continues from {work.folder}") from error
        except MemoryError as error:
            raise InputError(f"{error}", f"the same command goes on from the work in {work.folder}") from error
        except OSError as error:
            work.discard()
            raise InputError(
                f"{output} cannot be written ({error})", "free space there or name another --output"
            ) from error

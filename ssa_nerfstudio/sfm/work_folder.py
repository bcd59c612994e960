"""The folder that intermediate results are kept in, so that an interrupted run can be continued."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ssa_nerfstudio._system.file_lock import locked_folder
from ssa_nerfstudio.data.writing import unwritable_as_input_error
from ssa_nerfstudio.errors import InputError


class WorkFolder:
    """A folder `.NAME.work` beside the output, with a subfolder for each intermediate result."""

    def __init__(self, output: Path) -> None:
        """Derive the folder's path from that of the output."""
        self.path = output.parent / f".{output.name}.work"
        self.keep_after_error = False
        """Whether an `InputError` leaves the folder for the next run."""

    def subfolder(self, name: str, inputs: Any) -> Path:
        """Return a subfolder with what an earlier run made from the same inputs; empty where the inputs differ.

        Args:
            name: name of the subfolder.
            inputs: all that its contents depend on, as JSON values.
        """
        folder, record = self.path / name, self.path / f"{name}.json"
        text = json.dumps(inputs, sort_keys=True)
        if not record.is_file() or record.read_text(encoding="utf-8") != text:
            record.unlink(missing_ok=True)
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            record.write_text(text, encoding="utf-8")
        return folder

    def remove(self) -> None:
        """Remove the folder."""
        shutil.rmtree(self.path, ignore_errors=True)


@contextmanager
def resumable_work(output: Path) -> Iterator[WorkFolder]:
    """Lock and yield the work folder of an output.

    The folder stays when the process is killed or interrupted, when memory runs out, and after an `InputError` with
    `keep_after_error`. Other errors remove it.

    Raises:
        InputError: `output` exists or cannot be written, another process works on it, or memory ran out.
    """
    work = WorkFolder(output)
    with locked_folder(work.path, "ssa process"), unwritable_as_input_error(output):
        try:
            # Checked under the lock: another process may have completed the output before it released the folder.
            if output.exists():
                raise InputError(f"{output} exists already", "remove it or choose another output folder")
            yield work
        except InputError:
            if not work.keep_after_error:
                work.remove()
            raise
        except KeyboardInterrupt as error:
            raise KeyboardInterrupt(f"stopped; the same command continues from {work.path}") from error
        except MemoryError as error:
            raise InputError(f"{error}", f"the same command continues from the work in {work.path}") from error
        except OSError:
            work.remove()
            raise

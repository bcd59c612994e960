"""Files and folders that appear only when they are complete."""

from __future__ import annotations

import errno
import glob
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from ssa_nerfstudio._system.file_lock import held
from ssa_nerfstudio._system.unwritable_output import unwritable
from ssa_nerfstudio.errors import InputError

_PART = ".part"
_EARLIER = ".earlier"
_PATIENCE = 2.0
"""Seconds to wait for another process that makes a folder beside an output; that takes milliseconds."""


def is_text(name: str) -> bool:
    """Whether a name of a file is UTF-8, which C++ libraries ask for; the file system takes any bytes."""
    try:
        name.encode()
    except UnicodeEncodeError:
        return False
    return True


@contextmanager
def unwritable_as_input_error(path: Path) -> Iterator[None]:
    """Turn an `OSError` of the block into an `InputError` that names the output.

    Args:
        path: the output as the user knows it, a file or a folder.

    Raises:
        InputError: the block raised an `OSError`, for example because the disk is full.
    """
    try:
        yield
    except OSError as error:
        raise unwritable(path, error) from error


@contextmanager
def staged_folder(output: Path, replaces: bool = False) -> Iterator[Path]:
    """Write a folder that appears when the block ends without an error, and not otherwise.

    What a process left of the same folder that was killed is removed first.

    Args:
        output: the folder to make. Its parents are made where missing.
        replaces: whether it takes the place of an earlier folder, which goes once the new one is whole.

    Yields:
        An empty hidden folder beside `output`, renamed to `output` at the end.

    Raises:
        InputError: `output` exists, unless it is replaced, or cannot be written.
    """
    if output.exists() and not (replaces and output.is_dir()):
        raise _exists_already(output)
    with unwritable_as_input_error(output):
        output.parent.mkdir(parents=True, exist_ok=True)
        with _scratch(output) as scratch:
            folder = scratch / output.name
            folder.mkdir()
            yield folder
            earlier = scratch / f"{output.name}{_EARLIER}"
            try:
                if replaces and output.exists():
                    output.rename(earlier)
                folder.rename(output)
            except OSError as error:
                if earlier.exists() and not output.exists():
                    earlier.rename(output)
                if error.errno in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):  # another process was faster
                    raise _exists_already(output) from error
                raise


@contextmanager
def _scratch(output: Path) -> Iterator[Path]:
    """A folder beside an output that is locked while it is in use, so that the next process knows it as abandoned."""
    with ExitStack() as stack:
        with ExitStack() as making:
            alone = False
            with suppress(BlockingIOError):  # somebody else's, such as `flock . ssa ...`: nothing is removed
                # Nobody makes one, and has not locked it yet.
                alone = making.enter_context(held(output.parent, wait=_PATIENCE))
            for left in output.parent.glob(f".{glob.escape(output.name)}.????????{_PART}") if alone else ():
                _remove_abandoned(left, output.name)
            made = tempfile.TemporaryDirectory(prefix=f".{output.name}.", suffix=_PART, dir=output.parent)
            scratch = Path(stack.enter_context(made))
            stack.enter_context(held(scratch))
        yield scratch


def _remove_abandoned(scratch: Path, name: str) -> None:
    with suppress(OSError), held(scratch) as abandoned:
        if abandoned and {path.name for path in scratch.iterdir()} <= {name}:  # else it holds what was to be replaced
            shutil.rmtree(scratch, ignore_errors=True)


def _exists_already(output: Path) -> InputError:
    return InputError(f"{output} exists already", "remove it or choose another output folder")


@contextmanager
def staged_file(path: Path) -> Iterator[Path]:
    """Write a file that appears, or replaces an older one, when the block ends without an error.

    The temporary name is always the same, so that what a killed process leaves behind is overwritten by the next
    attempt. It ends in `.part`, so libraries that choose a format by the suffix need the format as an argument.

    Args:
        path: the file to write; its folder exists.

    Yields:
        The temporary path `.NAME.part` beside it, an empty file.

    Raises:
        InputError: another process is writing the file.
        OSError: the temporary file cannot be made.
    """
    part = path.with_name(f".{path.name}{_PART}")
    with ExitStack() as stack:
        part.touch()
        try:
            stack.enter_context(held(part))
        except BlockingIOError as error:
            raise InputError(
                f"another process is writing {path}", "wait until it ends, or choose another place"
            ) from error
        try:
            os.truncate(part, 0)
            yield part
            part.replace(path)
        except BaseException:  # and not after the replacement: it would be that of another process
            part.unlink(missing_ok=True)
            raise


@contextmanager
def staged_files(folder: Path, scratch: Path) -> Iterator[Path]:
    """Write files that appear in a folder one after the other when the block ends without an error.

    For readers that take every name in `folder` for a complete file. The data reach the disk before the names do: a
    machine that loses power leaves no file with a name and without its data.

    Args:
        folder: where the files go; made where missing.
        scratch: a folder on the same file system. It is emptied first and removed at the end.

    Yields:
        `scratch`, empty.
    """
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir(parents=True)
    try:
        yield scratch
        for path in scratch.iterdir():
            with path.open("rb") as file:
                os.fsync(file.fileno())
            folder.mkdir(parents=True, exist_ok=True)
            path.replace(folder / path.name)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file at once; links, devices and pipes such as /dev/stdout are written in place.

    Raises:
        InputError: it cannot be written.
    """
    with unwritable_as_input_error(path):
        if path.is_symlink() or (path.exists() and not path.is_file()):
            path.write_text(text, encoding="utf-8")
            return
        with staged_file(path) as part:
            part.write_text(text, encoding="utf-8")

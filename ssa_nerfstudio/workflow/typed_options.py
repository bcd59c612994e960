"""Options in messages of the stages' own commands, as they are typed for `ssa run`."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

from ssa_nerfstudio.errors import SSAError

_OPTION = re.compile(
    r"(?<![\w-])--(?!(?:help|output|steps|method)(?![\w-])|(?:detect|process|train)\.)([a-z](?:[\w.-]*\w)?)"
)
"""Options that `ssa run` does not take as they are."""
_COMMAND = re.compile(r"(?<![\w.])(?:ssa [a-z-]+|ns-[a-z-]+|colmap)(?: [\w./'-]+)* $")
"""What stands before an option of a command that is quoted as a whole."""
_INSTEAD = {
    "detect": {"data": "PHOTOS"},
    "process": {"train": "PHOTOS"},
    "train": {"data": "PHOTOS", "max-num-iterations": "--steps"},
}
"""What `ssa run` sets by itself."""
_READER = re.compile(
    r"(?:pipeline\.datamanager\.dataparser\.|"
    r"(?=(?:train-split-fraction|eval-interval|eval-mode|scale-factor|scene-scale)$))"
)
"""Options of the dataset's reader, which ns-train takes after its name."""
_RESUME = re.compile(r"resume from .*--load-dir.*")


def typed_for_run(text: str, stage: str) -> str:
    """Give the options that a stage's own command names the prefix that `ssa run` takes them with.

    Args:
        text: a message of that command.
        stage: detect, process or train; messages of others have no options.
    """
    if stage not in _INSTEAD:
        return text

    def typed(match: re.Match[str]) -> str:
        name = match[1]
        if "_" in name or _COMMAND.search(text[: match.start()]):
            return match[0]  # an option of COLMAP, or of a command that is named as a whole
        if stage == "train" and (reader := _READER.match(name)):
            return f"--train.nerfstudio-data.{name[reader.end() :]}"
        return _INSTEAD[stage].get(name, f"--{stage}.{name}")

    text = _RESUME.sub("repeat the command, which continues, or choose another --output and other options", text)
    return _OPTION.sub(typed, text)


@contextmanager
def errors_for_run(stage: str) -> Iterator[None]:
    """Let errors name options as `typed_for_run` does."""
    try:
        yield
    except SSAError as error:
        raise type(error)(typed_for_run(error.problem, stage), typed_for_run(error.remedy, stage)) from error

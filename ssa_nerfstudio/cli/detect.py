"""`ssa detect`."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from ssa_nerfstudio._system.cores import usable_cores
from ssa_nerfstudio._system.terminal_messages import plain_console
from ssa_nerfstudio.cli.arguments import STANDARD_OUTPUT
from ssa_nerfstudio.cli.option_bounds import Count, at_least
from ssa_nerfstudio.errors import InputError

_MAX_DRAWS = 100_000
"""A p-value of 0.01 then has a standard error of 0.0003; more take hours and decide nothing."""


@dataclass
class Command:
    """Say whether photos have a static screen-space artifact, and where; poses are not needed."""

    data: Path
    """A nerfstudio dataset (its training photos), a folder of photos or videos, or one video."""
    output: Path | None = None
    """Folder to write evidence.png, mask_nerfstudio.png and mask_colmap.png to; must not exist. Default:
    outputs/detection/NAME, where an earlier detection is replaced."""
    json: Path | None = None
    """File to write verdict, coverage, p_value, views and more of each camera to; must not exist. -: the standard
    output, and what else is said goes to the error stream."""
    draws: Annotated[int, at_least(200)] = 200
    """Number of captures of randomly shifted views to compare with, from 200 to 100000."""
    frames: Annotated[int, at_least(2)] = 200
    """Number of frames to take from videos."""
    threads: Count = field(default_factory=usable_cores)
    """Number of photos decoded at once."""

    def check(self) -> None:
        """Check the options.

        Raises:
            InputError: one cannot be used.
        """
        if self.draws > _MAX_DRAWS:
            raise InputError(f"--draws must be at most {_MAX_DRAWS}, got {self.draws}")
        file = None if self.json == STANDARD_OUTPUT else self.json
        if file is not None and not file.parent.is_dir():
            raise InputError(f"--json {file}: there is no folder {file.parent}", "make it first")
        if file is not None and (file.is_dir() or file.is_file()):
            raise InputError(f"--json {file} exists already", "remove it or name another file")
        if self.output is not None and self.output.exists():
            raise InputError(f"{self.output} exists already", "remove it or choose another --output")

    def place(self) -> Path:
        """The folder to write to.

        Raises:
            InputError: it is not given, and that of the data's name holds what no detection wrote, or --json is there.
        """
        if self.output is not None:
            return self.output
        from ssa_nerfstudio.evidence.capture_detection import FILES

        data = self.data.resolve()
        data = data.parent if data.name == "transforms.json" else data
        place = Path("outputs/detection") / ((data.name if data.is_dir() else data.stem) or "root")
        other = [path.name for path in place.rglob("*") if not path.is_dir() and path.name not in FILES]
        if other or place.is_symlink():
            raise InputError(
                f"{place} {f'holds {other[0]}' if other else 'is a link'} and is not replaced", "choose an --output"
            )
        if self.json not in (None, STANDARD_OUTPUT) and place.resolve() in self.json.resolve().parents:
            raise InputError(f"--json {self.json} is in {place}, which is replaced", "name a file elsewhere")
        return place

    def run(self) -> None:
        """Detect, print the verdict, and write evidence, masks and JSON.

        Raises:
            InputError: an option or a photo cannot be used.
        """
        from ssa_nerfstudio.data.writing import staged_folder, write_text
        from ssa_nerfstudio.evidence.capture_detection import (
            detect_camera,
            detections_to_json,
            read_cameras,
            write_detections,
        )
        from ssa_nerfstudio.evidence.verdict_in_words import verdict_in_words

        self.check()
        output = self.place()
        printed = self.json == STANDARD_OUTPUT
        console = plain_console(stderr=printed)
        cameras = read_cameras(self.data, self.frames)
        found = {camera.name: detect_camera(camera, self.threads, console, self.draws) for camera in cameras}
        with staged_folder(output, replaces=self.output is None) as folder:
            write_detections(folder, found)
            if self.json is not None and not printed:
                write_text(self.json, detections_to_json(found))
        if printed:
            print(detections_to_json(found), end="", flush=True)
        for name, detection in found.items():
            camera = f"{name}: " if len(found) > 1 else ""
            console.print(f"{camera}{verdict_in_words(detection)}")
        console.print(f"{output}: evidence.png, and masks whose black is the artifact")
        if all(detection.nothing_moves for detection in found.values()):
            return
        wanted = any(detection.verdict != "none" for detection in found.values())
        console.print(
            f"Train {'with' if wanted else 'without'} an overlay: ssa run {shlex.quote(str(self.data))} --output OUT"
        )
        if wanted:
            console.print("Masks for other programs: ssa export-dataset --help")

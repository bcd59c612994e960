"""`ssa report`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass
class Command:
    """Tables, paired differences and pictures from the results of `ssa bench`, as HTML and Markdown."""

    folders: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FOLDERS")] = ()
    """Output folders of `ssa bench`; several are added up."""
    output: Path | None = None
    """Folder of the report; `report` in the first folder where not given."""

    def run(self) -> None:
        """Write the report and print what was ignored.

        Raises:
            InputError: there are no results.
        """

        from ssa_nerfstudio._system.terminal_messages import plain_console
        from ssa_nerfstudio.errors import InputError
        from ssa_nerfstudio.experiments.benchmark.report.benchmark_report import report

        if not self.folders:
            raise InputError("name the --output folder of ssa bench: ssa report DIR")
        files, problems = report([*self.folders], self.output or self.folders[0] / "report")
        console = plain_console()
        for problem in problems:
            console.print(f"ignored: {problem}", style="yellow")
        for file in files:
            console.print(str(file))

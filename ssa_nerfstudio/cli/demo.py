"""`ssa demo`."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from ssa_nerfstudio._system import termination
from ssa_nerfstudio._system.terminal_messages import plain_console
from ssa_nerfstudio.cli.option_bounds import Bound, Count
from ssa_nerfstudio.errors import InputError


@dataclass
class Command:
    """Options of `ssa demo`."""

    output: Path = Path("outputs/demo")
    """Folder for report.html, sheet.png, results.json, the datasets and the trained models."""
    data: Path | None = None
    """A nerfstudio dataset to show instead of the built-in scene; trained as it is, no artifact is added."""
    steps: Count = 800
    """Training steps of each run; schedules are scaled to it. Photos of megapixels need thousands and a GPU."""
    scale_factor: Annotated[float, Bound("in (0, 1]", lambda value: 0 < value <= 1)] = 1.0
    """Photos of --data are resized by this, in (0, 1]."""

    def run(self) -> None:
        """Train, print the tables, write the report.

        Raises:
            SSAError: an option or the dataset cannot be used, or a training cannot continue.
        """
        if self.data is None and self.scale_factor != 1:
            raise InputError("--scale-factor is for the photos of --data", "add --data, or leave it out")
        if self.data is not None:
            from ssa_nerfstudio.data.training_requirements import check_training
            from ssa_nerfstudio.data.transforms import Transforms

            check_training(Transforms.read(self.data))
        console = plain_console()
        console.print("Loading nerfstudio ...")
        with termination.ended_at_once("ssa demo"):
            from ssa_nerfstudio.experiments.demo import comparison as run
            from ssa_nerfstudio.experiments.demo import demo_report as report

        title = TextColumn("{task.description}", markup=False)
        columns = (title, BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        # Without a terminal, a finished bar leaves an empty line.
        with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
            tasks = {}

            def on_step(dataset: str, method: str, step: int) -> None:
                key = dataset, method
                if key not in tasks:
                    tasks[key] = progress.add_task(f"{dataset}: {method}", total=self.steps)
                progress.update(tasks[key], completed=step)

            if self.data is None:
                demonstration = run.demonstrate(self.output, self.steps, on_step)
            else:
                name = self.data.resolve().stem
                runs = self.output / "demo-runs"
                compared = run.compare(name, self.data, runs, self.steps, on_step, {}, self.scale_factor)
                demonstration = run.Demonstration([compared])
        command = f"ssa demo --steps {self.steps}"
        if self.data is not None:
            command += f" --data {shlex.quote(str(self.data))} --scale-factor {self.scale_factor}"
        page = report.write_report(demonstration, self.output, command)
        for comparison in demonstration.comparisons:
            console.print(report.console_table(comparison))
            if not comparison.clean_test_views:
                console.print(report.CORRUPTED, style="yellow")
        console.print(f"Images and metrics: {page}")

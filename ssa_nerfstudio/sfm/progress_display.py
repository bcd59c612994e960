"""Progress of the stages of processing, shown in a terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

ProgressCallback = Callable[[str, int, int], None]
"""Called with the name of the stage, how many items are done and how many there are."""


@contextmanager
def progress_display(console: Console) -> Iterator[ProgressCallback]:
    """Show one bar per stage; where the console is no terminal, print one line when a stage is done."""
    columns = (TextColumn("{task.description:<10}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    bars = Progress(
        *columns, TextColumn("left:"), TimeRemainingColumn(), console=console, disable=not console.is_terminal
    )
    tasks = {}
    finished: set[str] = set()

    def on_progress(stage: str, done: int, total: int) -> None:
        if stage not in tasks:
            tasks[stage] = bars.add_task(stage, total=total, completed=done)
        bars.update(tasks[stage], completed=done, total=total)
        if done == total and stage not in finished and not console.is_terminal:
            console.print(f"{stage}: {total}")
        finished.update({stage} if done == total else ())

    with bars:
        yield on_progress

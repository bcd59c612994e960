"""One line a stage in the terminal: a bar while it works, then its time and what came out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta

import rich
from nerfstudio.utils.rich_utils import CONSOLE
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from ssa_nerfstudio.workflow.stages import FinishedStage


class TerminalDisplay:
    """Bars of all stages in a terminal, elsewhere a line for each that is done."""

    def __init__(self, names: Sequence[str], console: Console) -> None:
        """Make a line for each stage; none has begun."""
        self._console = console
        self.bars = Progress(
            TextColumn("{task.description:<10}"),
            BarColumn(24),
            TextColumn("{task.fields[said]}"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=console,
            disable=not console.is_terminal,
        )
        self._warned: set[str] = set()
        self._tasks = {name: self.bars.add_task(name, total=None, start=False, said="") for name in names}

    def begin(self, stage: str) -> None:
        """Let a stage's clock run."""
        self.bars.start_task(self._tasks[stage])

    def advance(self, stage: str, part: str, done: int, total: int) -> None:
        """Show how far a stage is."""
        self.bars.update(self._tasks[stage], completed=done, total=total, said=f"{part} {done:,} of {total:,}")

    def tell(self, decision: str) -> None:
        """Print a decision above the bars."""
        self._console.print(decision, markup=False, emoji=False, highlight=False)

    def warn(self, warning: str) -> None:
        """Print a warning above the bars, once."""
        if warning not in self._warned:
            self._warned.add(warning)
            self._console.print(f"[yellow]warning: {escape(warning)}[/yellow]", highlight=False)

    def finish(self, stage: FinishedStage, earlier: bool) -> None:
        """Replace a stage's bar by what came out, with the warnings that have not been shown."""
        self.bars.update(self._tasks[stage.name], visible=False)
        took = "done before" if earlier else str(timedelta(seconds=round(stage.seconds)))
        self._console.print(f"[bold]{stage.name:<10}[/bold] {took:>11}  {escape(stage.text)}", highlight=False)
        for warning in stage.warnings:
            self.warn(warning)


@contextmanager
def terminal_display(names: Sequence[str], console: Console) -> Iterator[TerminalDisplay]:
    """Show the stages; nerfstudio's own messages and bars are silent meanwhile.

    Args:
        names: of all stages.
        console: where they are shown.
    """
    display = TerminalDisplay(names, console)
    others = [CONSOLE, rich.get_console()]
    former = [other.quiet for other in others]
    try:
        for other in others:
            other.quiet = True
        with display.bars:
            yield display
    finally:
        for other, quiet in zip(others, former, strict=True):
            other.quiet = quiet

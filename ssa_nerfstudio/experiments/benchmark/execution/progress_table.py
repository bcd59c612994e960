"""The live table of a benchmark: what runs, how far, what came out, and when all will be over."""

from __future__ import annotations

import time
from collections import Counter

from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from ssa_nerfstudio.experiments.benchmark.execution.run_process import Request
from ssa_nerfstudio.experiments.benchmark.results import Result
from ssa_nerfstudio.experiments.benchmark.specification.plan import Run


class ProgressTable:
    """A table that is redrawn in a terminal; elsewhere a line for every run that ends."""

    def __init__(self, console: Console, total: int, done: int, runs_at_once: int) -> None:
        """Take how many runs there are, how many are done already, and how many work at once."""
        self._console, self._total, self._before = console, total, done
        self._at_once = max(1, runs_at_once)
        self._ended: list[tuple[Run, Result | None]] = []
        self._counts: Counter[str] = Counter()
        self._seconds: list[float] = []
        self._live = Live(console=console, refresh_per_second=4, transient=True) if console.is_terminal else None

    def __enter__(self) -> ProgressTable:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *exception: object) -> None:
        if self._live is not None:
            self._live.stop()

    def ended(self, run: Run, result: Result | None) -> None:
        """A run came to its end."""
        status = result.status if result is not None else "vanished"
        self._counts[status] += 1
        if result is not None and result.status == "finished":
            self._seconds.append(result.total_seconds)
        self._ended.append((run, result))
        self._console.print(f"{self._number()} {run.id}: {_outcome(result)}", highlight=False, soft_wrap=True)

    def watch(self, requests: list[Request], waiting: int) -> None:
        """Draw the runs at work, and how many wait."""
        if self._live is None:
            return
        table = Table(box=None, padding=(0, 1), expand=False)
        for column in ("run", "device", "", "steps", "", "seconds"):
            table.add_column(column, no_wrap=True, justify="right" if column in ("steps", "seconds") else "left")
        for request in requests:
            stage, step = request.state()
            table.add_row(
                request.run.id,
                f"GPU {request.device}" if request.device else "CPU",
                stage,
                f"{step} / {request.run.steps}",
                ProgressBar(total=request.run.steps, completed=step, width=20),
                f"{time.time() - (request.asked or time.time()):.0f}",
            )
        self._live.update(Group(table, Text(self._summary(len(requests), waiting))))

    def _number(self) -> str:
        return f"[{self._before + len(self._ended)}/{self._total}]"

    def _summary(self, running: int, waiting: int) -> str:
        text = f"{self._before + len(self._ended)} of {self._total} done, {running} running, {waiting} waiting"
        troubles = [f"{n} {status}" for status, n in self._counts.items() if status != "finished"]
        if troubles:
            text += "; " + ", ".join(troubles)
        if self._seconds and waiting + running:
            minutes = sum(self._seconds) / len(self._seconds) * (waiting + running / 2) / self._at_once / 60
            text += f"; about {minutes:.0f} min left"
        return text


def _outcome(result: Result | None) -> str:
    if result is None:
        return "its process ended without a result; see its log"
    if result.status != "finished":
        return f"{result.status}: {result.reason}"
    psnr = result.metrics["psnr"]
    shown = "inf" if psnr is None else f"{psnr:.2f}"
    return (
        f"PSNR {shown} dB, SSIM {result.metrics['ssim']:.3f}, FLIP {result.metrics['flip']:.3f}, "
        f"{result.seconds['training']:.0f} s training, {result.gaussians:,} Gaussians"
        f"{'' if result.alone else ', device shared'}"
    )

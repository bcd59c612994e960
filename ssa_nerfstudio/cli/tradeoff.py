"""`ssa tradeoff`."""

from __future__ import annotations

from dataclasses import dataclass

from ssa_nerfstudio._system.terminal_messages import plain_console
from ssa_nerfstudio.cli.bench import Command as BenchCommand
from ssa_nerfstudio.cli.bench import require_none, update
from ssa_nerfstudio.errors import InputError


@dataclass
class Command(BenchCommand):
    """Vary one knob at a time and a few together, and draw what accuracy costs in time."""

    report_only: bool = False
    """Start nothing; draw what the folder holds."""

    def run(self) -> None:
        """Run what is missing, then write frontier figures, CSV and tables into the folder's `tradeoff`.

        Raises:
            InputError: the arguments or the benchmark cannot be worked with, or no run had its device to itself.
            TrainingError: runs failed.
        """

        # Before hours of training, so that a missing package is noticed now.
        from ssa_nerfstudio.experiments.benchmark.report.tradeoff_report import analyze
        from ssa_nerfstudio.experiments.benchmark.specification.benchmark_file import read_benchmark
        from ssa_nerfstudio.experiments.benchmark.specification.plan import plan_tradeoff

        benchmark = read_benchmark(self.benchmark)
        if benchmark.tradeoff is None:
            raise InputError(f"{self.benchmark} states no tradeoff", "add the key 'tradeoff' or name another benchmark")
        planned = plan_tradeoff(benchmark)
        failed = [] if self.report_only else update(self, "tradeoff", benchmark, planned)[1]
        if self.prepare_only or self.list:
            return
        from ssa_nerfstudio.experiments.benchmark.execution.execute import select

        chosen = {run.id for run in select(planned, self.scenes, self.only)}
        console = plain_console()
        files, problems = analyze([self.output, *self.merge], self.output / "tradeoff", chosen)
        for problem in problems:
            console.print(f"left out: {problem}", style="yellow")
        for file in files:
            console.print(str(file))
        require_none(failed)

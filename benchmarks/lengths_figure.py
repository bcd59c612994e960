"""What more training steps gain: `python benchmarks/lengths_figure.py RESULTS --output FILE.png`

RESULTS is the output folder of `ssa tradeoff lengths` and `ssa bench lengths`. A capture's bar is what splatfacto's
settings reach in 30,000 steps on photos with nothing in front; PSNR is shown as its distance from there.
"""

from __future__ import annotations

import statistics
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.cli.option_bounds import file_to_write
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.benchmark.results import Result, read_named

STYLES = {"adc": "-o", "mcmc": "--s"}
BAR = "none", "3dgs"
"""Effect and method of the run of full length that a capture is compared with."""
Curves = dict[tuple[str, str], dict[int, list[Result]]]
"""Results of each capture and densification: all seeds of every number of steps."""
PRESETS = ("ssa-splatfacto-fast", "ssa-splatfacto")


@dataclass
class Command:
    """Draw PSNR over the number of steps, and print it as a table."""

    results: Annotated[Path, tyro.conf.Positional]
    """Folder of a benchmark's results."""
    output: Annotated[Path, file_to_write(".png", ".svg")]
    """Picture to write, .png or .svg."""

    def run(self) -> None:
        """Write the picture and print Markdown.

        Raises:
            InputError: the folder has no finished run at several lengths, or no bar.
        """
        found = [result for result in read_named([self.results])[0] if result.status == "finished"]
        bars = {result.run.scene: result.metrics["psnr"] for result in found if _is_bar(result)}
        runs = [result for result in found if _is_of_a_curve(result)]
        missing = sorted({result.run.scene for result in runs} - bars.keys())
        if not runs or missing:
            what = f"no bar of {', '.join(missing)}" if missing else "no run of several lengths"
            raise InputError(f"{self.results} has {what}", "run ssa tradeoff lengths and ssa bench lengths first")
        curves: Curves = {}
        for result in sorted(runs, key=lambda each: each.run.steps):
            curve = curves.setdefault((result.run.scene, result.run.densification), {})
            curve.setdefault(result.run.steps, []).append(result)
        _draw(curves, bars, self.output)
        lengths = sorted({result.run.steps for result in runs})
        print(
            f"| | | {' | '.join(f'{steps:,}' for steps in lengths)} | bar |",
            "|---" * (len(lengths) + 3) + "|",
            sep="\n",
        )
        for (scene, densification), curve in sorted(curves.items()):
            cells = [_cell(curve[steps]) if steps in curve else "" for steps in lengths]
            print(f"| `{scene}` | {densification.upper()} | {' | '.join(cells)} | {bars[scene]:.2f} |")


def _is_bar(result: Result) -> bool:
    from ssa_nerfstudio.plugin.training.schedules import FULL_LENGTH

    run = result.run
    return (run.effect, run.method, run.steps) == (*BAR, FULL_LENGTH) and not run.variation


def _is_of_a_curve(result: Result) -> bool:
    run = result.run
    varied = run.variation.keys() - {"steps", "densification"}
    return run.method == "overlay-on" and run.effect != "none" and run.clean_tests and not varied


def _psnr(seeds: list[Result]) -> float:
    return statistics.mean(result.metrics["psnr"] for result in seeds)


def _seconds(seeds: list[Result]) -> float | None:
    """Of statistics and training, where a run had its device to itself."""
    alone = [result.learning_seconds for result in seeds if result.alone]
    return statistics.mean(alone) if alone else None


def _cell(seeds: list[Result]) -> str:
    seconds = _seconds(seeds)
    return f"{_psnr(seeds):.2f}" + ("" if seconds is None else f" ({seconds:.0f} s)")


def _draw(curves: Curves, bars: dict[str, float], path: Path) -> None:
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    from ssa_nerfstudio.plugin.methods import METHODS

    figure, axes = pyplot.subplots(figsize=(8, 4.6), constrained_layout=True)
    colors = {scene: f"C{number}" for number, scene in enumerate(sorted(bars))}
    for (scene, densification), curve in sorted(curves.items()):
        gains = [_psnr(seeds) - bars[scene] for seeds in curve.values()]
        label = f"{scene}, {densification.upper()}"
        axes.plot([*curve], gains, STYLES[densification], color=colors[scene], label=label, markersize=4)
    lengths = sorted({steps for curve in curves.values() for steps in curve})
    for method in PRESETS:
        axes.axvline(METHODS[method].max_num_iterations, color="0.75", linewidth=6, zorder=0)
        axes.annotate(method, (METHODS[method].max_num_iterations, 0.02), xycoords=("data", "axes fraction"),
                      rotation=90, ha="center", va="bottom", fontsize=7)  # fmt: skip
    axes.axhline(0, color="0.4", linewidth=0.8)
    axes.set_xscale("log")
    axes.set_xticks(lengths, [f"{steps:,}" for steps in lengths])
    axes.minorticks_off()
    axes.set_xlabel("training steps")
    axes.set_ylabel("PSNR of clean test views, dB\nagainst clean photos and 30,000 steps")
    axes.legend(fontsize=7, frameon=False, loc="lower right", handlelength=3)
    times = [(_seconds(seeds), steps) for curve in curves.values() for steps, seeds in curve.items()]
    alone = [seconds / steps for seconds, steps in times if seconds is not None]
    if alone:
        pace = statistics.median(alone)
        above = axes.secondary_xaxis("top", functions=(lambda steps: steps * pace, lambda seconds: seconds / pace))
        above.set_xticks([steps * pace for steps in lengths], [f"{steps * pace:.0f} s" for steps in lengths])
        above.minorticks_off()
        above.set_xlabel(f"time at {1e3 * pace:.1f} ms a step, the median of runs that had their GPU to themselves")
    figure.savefig(path, dpi=130)
    pyplot.close(figure)


if __name__ == "__main__":
    run_script(Command)

"""The table of a training in the console: loss, PSNR, time a step and time left, in place of rays a second."""

from __future__ import annotations

import sys
from typing import Any

from nerfstudio.configs.base_config import LocalWriterConfig
from nerfstudio.utils import writer
from nerfstudio.utils.writer import EventName, LocalWriter

REDIRECTED_LINES = 100
"""About as many lines are written where the output is no terminal."""


class ConsoleTable(LocalWriter):
    """`LocalWriter` with what tells whether a training goes well.

    PSNR compares a training photo with its composite, or with the render where there is no overlay.
    """

    def __init__(self, config: LocalWriterConfig, banner_messages: list[str] | None = None) -> None:
        """Set up as upstream does; where the output is no terminal, rows are not drawn over each other."""
        super().__init__(config, banner_messages)
        self.stats_to_track = ["Loss", "PSNR (dB)", EventName.ITER_TRAIN_TIME.value, EventName.ETA.value]
        self._redirected = not sys.stdout.isatty()
        if self._redirected:
            config.max_log_size = 0

    def write_stats_log(self, step: int) -> None:
        """Write a row; upstream calls this at every step."""
        every, total = writer.GLOBAL_BUFFER["steps_per_log"], writer.GLOBAL_BUFFER["max_iter"]
        if self._redirected and step % (every * max(1, total // (every * REDIRECTED_LINES))):
            return
        super().write_stats_log(step)

    def _update_header(self, latest_map: dict[str, Any], new_key: bool) -> None:
        if not self.past_mssgs[0] and latest_map:
            header = "".join(f"{name:<20} " for name in latest_map)
            self.past_mssgs[:2] = [f"{'Step (% Done)':<20}{header}", "-" * (20 + len(header))]
            print(*self.past_mssgs[:2], sep="\n")

    def _print_stats(self, latest_map: dict[str, Any], padding: str = " ") -> None:
        if latest_map:  # nothing was logged after the last step
            super()._print_stats(latest_map, padding)

    def _consolidate_events(self) -> tuple[dict[str, Any], bool]:
        latest, _ = super()._consolidate_events()
        if "Train Loss" not in latest:
            return {}, False
        metrics = latest["Train Metrics Dict"]
        psnr = metrics.get("composite_psnr", metrics.get("psnr"))
        found = {"Loss": latest["Train Loss"], "PSNR (dB)": psnr}
        found |= {name: latest.get(name) for name in (EventName.ITER_TRAIN_TIME.value, EventName.ETA.value)}
        return {name: value for name, value in found.items() if value is not None}, False

"""What of a training is written where: times and rates now and then, losses always; and the console's table."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import pytest
from nerfstudio.configs.base_config import LocalWriterConfig
from nerfstudio.utils import writer

from ssa_nerfstudio.plugin.training.console_table import ConsoleTable
from ssa_nerfstudio.plugin.training.event_writers import ThinnedWriter, no_event_writers_left, thin_event_writers

ALWAYS = ("Train Loss", "Eval PSNR", "my learning_rate/means")
NOW_AND_THEN = (
    "Train Iter (time)", "ETA (time)", "Train Rays / Sec", "Vis Rays / Sec", "learning_rate/means",
)  # fmt: skip


class Recorder:
    """A writer that remembers."""

    log_dir = "somewhere"

    def __init__(self) -> None:
        self.written: list[tuple[str, Any, int]] = []

    def write_scalar(self, name: str, scalar: Any, step: int) -> None:
        self.written.append((name, scalar, step))


def test_the_module_can_be_imported_before_any_other():
    code = "import ssa_nerfstudio.plugin.training.event_writers"
    subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=True, timeout=100)


def test_times_and_learning_rates_are_written_when_losses_are_logged():
    inner = Recorder()
    thinned = ThinnedWriter(inner, 4)
    for step in range(9):
        for name in (*ALWAYS, *NOW_AND_THEN):
            thinned.write_scalar(name, 0.5 * step, step)
    assert thinned.log_dir == "somewhere"
    for name in ALWAYS:
        assert [entry for entry in inner.written if entry[0] == name] == [(name, 0.5 * s, s) for s in range(9)]
    for name in NOW_AND_THEN:
        assert [entry for entry in inner.written if entry[0] == name] == [(name, 0.5 * s, s) for s in (0, 4, 8)]


@pytest.mark.parametrize(("every", "seen"), [(3, [0, 3, 6]), (1, [*range(8)]), (0, [*range(8)])])
def test_every_writer_but_the_console_is_thinned(monkeypatch, every, seen):
    inner, console = Recorder(), writer.LocalWriter(LocalWriterConfig())
    monkeypatch.setattr(writer, "EVENT_WRITERS", writers := [inner, console])
    thin_event_writers(every)
    assert writer.EVENT_WRITERS is writers
    assert writers[1] is console
    for step in range(8):
        writers[0].write_scalar("ETA (time)", 1.0, step)
    assert [step for _, _, step in inner.written] == seen


@pytest.fixture
def table(monkeypatch):
    """A function that makes a table of a training of some steps, on a terminal or not, and logs steps to it."""

    def make(
        steps: int, every: int, terminal: bool = False, banner: list[str] | None = None
    ) -> tuple[ConsoleTable, Any]:
        monkeypatch.setattr("sys.stdout.isatty", lambda: terminal, raising=False)
        monkeypatch.setattr(
            writer, "GLOBAL_BUFFER", {"steps_per_log": every, "max_iter": steps, "step": 0, "events": {}}
        )
        made = ConsoleTable(LocalWriterConfig(max_log_size=10), banner)

        def log(step: int, **scores: float) -> None:
            events: dict[str, Any] = {"Train Loss": 0.25, "Train Metrics Dict": {"psnr": 11.0, **scores}}
            events |= {"ETA (time)": 90.0, "Train Iter (time)": 0.002, "Train Rays / Sec": 5.0}
            monkeypatch.setattr(writer, "EVENT_STORAGE", [{"name": n, "event": e} for n, e in events.items()])
            writer.GLOBAL_BUFFER["step"] = step
            made.write_stats_log(step)

        return made, log

    return make


def test_a_row_has_loss_psnr_and_times_and_one_heading_stands_above_all(table, capsys):
    _, log = table(200, 10)
    for step in (0, 5, 10, 20):
        log(step)
    heading, rule, *rows = capsys.readouterr().out.splitlines()
    assert heading.split("  ")[0] == "Step (% Done)"
    assert heading.split()[3:] == ["Loss", "PSNR", "(dB)", "Train", "Iter", "(time)", "ETA", "(time)"]
    assert set(rule) == {"-"}
    assert [row.split()[:4] for row in rows] == [
        ["0", "(0.00%)", "0.2500", "11.0000"],
        ["10", "(5.00%)", "0.2500", "11.0000"],
        ["20", "(10.00%)", "0.2500", "11.0000"],
    ]
    assert all("2.000 ms" in row and "1 m, 30 s" in row and "Rays" not in row for row in rows)
    assert heading.index("PSNR") == rows[0].index("11.0000")


def test_the_composite_is_what_is_compared_where_there_is_one(table, capsys):
    _, log = table(200, 10)
    log(0, composite_psnr=23.5)
    assert "23.5000" in capsys.readouterr().out


def test_without_a_loss_there_is_no_row(table, capsys, monkeypatch):
    made, _ = table(200, 10)
    monkeypatch.setattr(writer, "EVENT_STORAGE", [{"name": "ETA (time)", "event": 1.0}])
    made.write_stats_log(10)
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("steps", "every", "rows"), [(30_000, 10, 101), (999, 10, 100), (5_000, 10, 101), (50, 10, 6), (1_500, 10, 151)]
)
def test_a_file_gets_about_a_hundred_rows(table, capsys, steps, every, rows):
    made, log = table(steps, every)
    assert made.config.max_log_size == 0
    for step in range(0, steps + 1, every):
        log(step)
    assert len(capsys.readouterr().out.splitlines()) == 2 + rows


def test_a_terminal_gets_every_row(table, capsys):
    made, log = table(30_000, 10, terminal=True)
    assert made.config.max_log_size == 10
    for step in (0, 10, 20):
        log(step)
    out = capsys.readouterr().out
    assert all(f"{step} (" in out for step in (0, 10, 20))


def test_the_banner_stays_below_the_rows_of_a_terminal(table, capsys):
    """It says where the viewer is."""
    _, log = table(30_000, 10, terminal=True, banner=["viewer: http://localhost:7007"])
    for step in (0, 10, 20):
        log(step)
    *_, row, rule, last = capsys.readouterr().out.splitlines()
    assert "20 (" in row
    assert set(rule.strip(" \x1b[0m")) == {"-"}
    assert "viewer: http://localhost:7007" in last


def test_event_writers_are_cleared_after_an_error_too():
    writer.EVENT_STORAGE.append({})
    with pytest.raises(KeyError), no_event_writers_left():
        raise KeyError
    assert writer.EVENT_STORAGE == []

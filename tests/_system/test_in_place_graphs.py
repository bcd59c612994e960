"""Programs that change tensors in place: on a CPU run again and again, on CUDA as graphs."""

from __future__ import annotations

import weakref
from types import SimpleNamespace

import pytest
import torch
from recordings import CUDA, recorder
from torch import Tensor

from ssa_nerfstudio._system import in_place_graphs
from ssa_nerfstudio._system.in_place_graphs import RecordedChanges, repeat, side_by_side


def add(total: Tensor) -> None:
    total += 1


class FormerPool:
    """In place of `CapturedPrograms`: as CUDA does, it captures nothing once all that it captured is gone."""

    def __init__(self) -> None:
        self._alive: list[weakref.ref] = []

    def capture(self, program):
        if self._alive and not any(each() for each in self._alive):
            raise RuntimeError("the pool's last graph is gone")

        def replay() -> None:
            program()

        self._alive.append(weakref.ref(replay))
        return [], replay


@pytest.mark.parametrize("device", ["cpu", CUDA])
def test_changes_are_recorded_after_all_earlier_recordings_were_given_up(device, monkeypatch, caplog):
    if device == "cpu":
        monkeypatch.setattr(in_place_graphs, "CapturedPrograms", FormerPool)
    changes, total = RecordedChanges(limit=2), torch.zeros((), device=device)
    random = torch.zeros(3, device=device)
    for key in "aaabbbcdefggghhhaaa":
        changes(lambda: add(total), key)
        random.uniform_()  # a capture that fails would break the generator
    assert total.item() == len("aaabbbcdefggghhhaaa")
    assert changes._known["a"] is not None
    assert "cannot be used" not in caplog.text


@pytest.mark.parametrize("device", ["cpu", CUDA])
def test_programs_side_by_side_come_after_what_was_before_and_before_what_is_after(device):
    length = 1 << 22  # long enough that a branch which waits for nothing is too early
    source, parts, total = (torch.zeros(*shape, device=device) for shape in ((length,), (3, length), (length,)))

    def program() -> list[Tensor]:
        source.add_(1).sqrt_().square_()
        side_by_side([lambda part=part: part.copy_(source).mul_(2) for part in parts])
        torch.sum(parts, dim=0, out=total)
        return [total]

    (found,), repeat = recorder(device)()(program)
    for _ in range(3):
        repeat()
        torch.testing.assert_close(found, 6 * source)
    assert source[0] > 3


@pytest.mark.parametrize("device", ["cpu", CUDA])
@pytest.mark.parametrize("times", [1, 2, 50])
def test_a_repeated_program_runs_as_often_as_asked(device, times):
    values = torch.ones(3, dtype=torch.float64, device=device)
    repeat(lambda: values.mul_(2).sub_(values.mean() / 4), times, values.device)
    assert values.tolist() == [pytest.approx(1.5**times)] * 3


def test_what_cannot_be_captured_is_repeated_plainly(monkeypatch, caplog):
    class NoCapture:
        def capture(self, program):
            raise RuntimeError("operation not permitted when stream is capturing")

    monkeypatch.setattr(in_place_graphs, "graphs_are_usable", lambda: True)
    monkeypatch.setattr(in_place_graphs, "CapturedPrograms", NoCapture)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda: SimpleNamespace(synchronize=lambda: None))
    for device in ("cpu", "cuda:1", "cuda:0"):  # the last one alone is captured on
        assert "CUDA graphs cannot be used" not in caplog.text
        total = torch.zeros(())
        repeat(lambda total=total: add(total), 5, torch.device(device))
        assert total.item() == 5
    assert "CUDA graphs cannot be used" in caplog.text

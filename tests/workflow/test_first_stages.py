"""What the stages of a run say while they work, and what is left of it in the report."""

from __future__ import annotations

import logging
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.evidence.detection import Detection
from ssa_nerfstudio.workflow import photos_to_splats
from ssa_nerfstudio.workflow.photos_to_splats import Plan, stages
from ssa_nerfstudio.workflow.stages import Result


def found(verdict: Any, coverage: float) -> Detection:
    nowhere = torch.zeros(6, 8)
    hidden = nowhere > 0
    return Detection(verdict, coverage, 0.5, (0.4, 0.6), 12, (0.0, 0.0), (0.0, 0.0), nowhere, hidden, hidden)


def work(name: str, output: Path, detection: Detection, overlay: str = "auto") -> Result:
    """What a stage of a run says in which this is detected."""
    model = SimpleNamespace(overlay=overlay)
    training: Any = SimpleNamespace(get_base_dir=lambda: output, pipeline=SimpleNamespace(model=model))
    choices: dict[str, dict[str, Any]] = {"detect": {}, "train": {}}
    plan = Plan(output, lambda _: {"camera_0": detection}, None, output, training, choices, ("it takes a while",))
    (stage,) = [stage for stage in stages(plan) if stage.name == name]
    return stage.work(lambda *_: None)


@pytest.mark.parametrize("overlay", ["auto", "off"])
def test_that_training_looks_again_is_a_note_and_no_warning_of_the_run(tmp_path, caplog, overlay):
    caplog.set_level(logging.INFO, "ssa_nerfstudio")
    assert work("detect", tmp_path, found("none", 0.0), overlay).warnings == ()
    notes = [record for record in caplog.records if "training looks again" in record.getMessage()]
    assert [note.levelno for note in notes] == [logging.INFO] * (overlay == "auto")


def test_what_is_known_about_the_training_is_said_before_it_starts(tmp_path, caplog, monkeypatch):
    def stop(*_: object) -> None:
        assert caplog.messages == ["it takes a while"]
        raise InputError("the first step")

    monkeypatch.setattr(photos_to_splats, "train", stop)
    with pytest.raises(InputError, match="the first step"):
        work("train", tmp_path, found("none", 0.0))

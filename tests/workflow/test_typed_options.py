"""Messages of the stages' commands name options as `ssa run` takes them."""

from __future__ import annotations

import re

import pytest

from ssa_nerfstudio.errors import InputError, TrainingError
from ssa_nerfstudio.workflow.typed_options import errors_for_run, typed_for_run


@pytest.mark.parametrize(
    ("stage", "said", "typed"),
    [
        ("train", "(--pipeline.model.overlay off trains)", "(--train.pipeline.model.overlay off trains)"),
        ("train", "run with --train.pipeline.model.overlay on and another --output", None),
        ("train", "--max-num-iterations must be at least 1, got 0", "--steps must be at least 1, got 0"),
        ("train", "choose another --eval-mode", "choose another --train.nerfstudio-data.eval-mode"),
        (
            "train",
            "leave --pipeline.datamanager.dataparser.auto-scale-poses True",
            "leave --train.nerfstudio-data.auto-scale-poses True",
        ),
        ("train", "Unrecognized options: --x (ns-train ssa-splatfacto --help)",
         "Unrecognized options: --train.x (ns-train ssa-splatfacto --help)"),
        ("train", "make room on the disk and resume from step-3.ckpt: --load-dir a/b",
         "make room on the disk and repeat the command, which continues, or choose another --output and other options"),
        ("process", "invalid choice for argument '--matching'", "invalid choice for argument '--process.matching'"),
        ("process", "photo.jpg is in --train, too; --clean takes others",
         "photo.jpg is in PHOTOS, too; --process.clean takes others"),
        ("process", "give the folder that COLMAP had as --image_path", None),
        ("process", "make it with ssa process --train X --clean Y", None),
        ("process", "there or here; choose another --output", None),
        ("detect", "--draws must be at least 200", "--detect.draws must be at least 200"),
        ("export", "choose another with --step", None),
    ],
)  # fmt: skip
def test_options_have_the_prefix_that_is_typed(stage, said, typed):
    assert typed_for_run(said, stage) == (said if typed is None else typed)
    assert typed_for_run(typed_for_run(said, stage), stage) == typed_for_run(said, stage)


@pytest.mark.parametrize("kind", [InputError, TrainingError])
def test_errors_name_them_so_too(kind):
    expected = re.escape("--process.mask is one camera's; use --process.detect")
    with pytest.raises(kind, match=expected), errors_for_run("process"):
        raise kind("--mask is one camera's", "use --detect")

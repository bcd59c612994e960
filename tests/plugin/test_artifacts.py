"""Which overlays a checkpoint has: allocated as they were stored, and refused where they cannot be."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.overlay.layer import OracleOverlay, ScreenSpaceOverlay
from ssa_nerfstudio.plugin.artifacts import Artifacts

KEYS = torch.tensor([[4, 3, 0.1, 0.1, 2, 1.5], [4, 3, 0.7, 0.7, 2, 1.5]], dtype=torch.float64)
"""Two cameras, with focal lengths that float32 does not hold."""


def trained(overlay: ScreenSpaceOverlay | OracleOverlay) -> Artifacts:
    """Of a rig whose second camera has no artifact."""
    made = Artifacts()
    made.assign([overlay, None], KEYS, [0, 1], torch.zeros(2, 16, dtype=torch.float64))
    return made


def state() -> dict[str, Any]:
    """What a checkpoint holds of it."""
    return {f"a.{name}": value for name, value in trained(ScreenSpaceOverlay(3, 4)).state_dict().items()}


def test_cameras_are_known_again_to_the_last_bit():
    stored, made = state(), Artifacts()
    made.allocate(stored, "a.", wanted=True)
    made.load_state_dict({name.removeprefix("a."): value for name, value in stored.items()})
    assert torch.equal(made.camera_keys, KEYS[:1])
    assert torch.equal(made.bare_keys, KEYS[1:])


def test_a_resumed_run_knows_its_cameras_before_it_has_loaded_the_checkpoint():
    """Without any change to what is loaded later."""
    stored, made = state(), Artifacts()
    made.resume_from(stored, "a.", KEYS, [0, 1], "auto", ["0.png", "1.png"])
    assert torch.equal(made.camera_keys, KEYS[:1])
    assert torch.equal(made.bare_keys, KEYS[1:])
    assert torch.equal(made.lenses, stored["a.lenses"])
    assert made.camera_keys.data_ptr() != stored["a.camera_keys"].data_ptr()
    assert [made.group_of_view(view) for view in (0, 1)] == [0, None]


@pytest.mark.parametrize("frame", [(0, 4), (30_000, 30_000)])
def test_an_overlay_of_a_size_that_no_photo_has(frame):
    stored = state()
    stored["a.overlays.0.frame"][:2] = torch.tensor(frame)
    with pytest.raises(InputError, match=rf"has an overlay of {frame[0]} x {frame[1]} pixels; take another$"):
        Artifacts().allocate(stored, "a.", wanted=True)


@pytest.mark.parametrize("name", ["starts", "cameras"])
def test_names_of_other_groups_than_there_are(name):
    stored = {key.removeprefix("a."): value for key, value in state().items()}
    stored["_extra_state"][name] = ["one"]
    made = Artifacts()
    made.allocate(stored, "", wanted=True)
    with pytest.raises(InputError, match=rf"the {name} in the checkpoint are not one for each of .*; take another$"):
        made.load_state_dict(stored)


@pytest.mark.parametrize(
    ("overlay", "says"),
    [
        (ScreenSpaceOverlay(6, 8), r"are learned, .* \[\(3, 4, 1, 0\)\], this run's are \[\(6, 8, 1, 0\)\]"),
        (OracleOverlay(torch.ones(3, 4, 3), torch.zeros(3, 4, 3)), "are learned, "),
    ],
    ids=["of another size", "given"],
)
def test_a_run_with_other_overlays(overlay, says):
    remedy = "; resume with the photos, camera-res-scale-factor and overlay options it was trained with$"
    with pytest.raises(InputError, match=says + ".*" + remedy):
        trained(overlay).allocate(state(), "a.", wanted=True)


def test_a_run_whose_photos_have_no_artifact():
    bare = Artifacts()
    bare.assign([None, None], KEYS, [0, 1], torch.zeros(2, 16, dtype=torch.float64))
    with pytest.raises(InputError, match="this run's are absent"):
        bare.allocate(state(), "a.", wanted=True)

"""Checkpoints of overlays behind a lens with a falloff, and from before overlays had one."""

from __future__ import annotations

import pytest
import torch
from export.small_checkpoints import one_camera

from ssa_nerfstudio.overlay.layer import ScreenSpaceOverlay
from ssa_nerfstudio.plugin.artifacts import Artifacts


def artifacts(falloff: float | None) -> Artifacts:
    overlay = ScreenSpaceOverlay(6, 8)
    torch.nn.init.normal_(overlay.alpha_logits)
    if falloff is not None:
        overlay.falloff = torch.full_like(overlay.evidence, falloff)
    return one_camera(overlay)


@pytest.mark.parametrize("here", ["nothing", "the same", "no falloff", "another falloff"])
@pytest.mark.parametrize("saved", [0.5, None])
def test_the_checkpoint_says_whether_there_is_a_falloff(saved: float | None, here: str) -> None:
    before = artifacts(saved)
    state = before.state_dict()
    if saved is None:
        del state["overlays.0.falloff"], state["overlays.0.reliable"], state["overlays.0.noise"]
    resumed = {"nothing": Artifacts, "the same": lambda: artifacts(saved)}.get(
        here, lambda: artifacts(None if here == "no falloff" else 0.7)
    )()
    resumed.allocate(state, "", wanted=True)
    resumed.load_state_dict(state)
    for found, expected in zip(resumed[0].layers(), before[0].layers(), strict=True):
        assert torch.equal(found, expected)


def test_a_falloff_of_another_frame_is_refused() -> None:
    state = artifacts(0.5).state_dict()
    state["overlays.0.falloff"] = torch.ones(4, 4, 1)
    resumed = Artifacts()
    resumed.allocate(state, "", wanted=True)
    with pytest.raises(RuntimeError, match="falloff"):
        resumed.load_state_dict(state)

"""Where the viewer opens."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO, Viewer
from viser.transforms import SO3

from ssa_nerfstudio.plugin.first_view import FirstView


def test_a_browser_starts_where_the_middle_photo_was_taken():
    poses = torch.eye(4)[:3].repeat(5, 1, 1)
    poses[:, :, 3] = torch.arange(15.0).reshape(5, 3)
    poses[2, :, :3] = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # looks along -x, +y is up
    client = SimpleNamespace(camera=SimpleNamespace(), atomic=nullcontext)
    connected = []
    viewer = SimpleNamespace(viser_server=SimpleNamespace(on_client_connect=connected.append))
    control = FirstView(lambda: Cameras(poses, fx=100.0, fy=50.0, cx=40.0, cy=30.0, width=80, height=60))
    control._setup(cast(Viewer, viewer))
    connected[0](client)
    assert client.camera.position == pytest.approx(np.array([6.0, 7.0, 8.0]) * VISER_NERFSTUDIO_SCALE_RATIO)
    # viser's cameras look along their +z and have +y down.
    turned = SO3(np.asarray(client.camera.wxyz))
    assert turned.apply(np.array([0.0, 0.0, 1.0])) == pytest.approx(-poses[2, :, 2].numpy())
    assert turned.apply(np.array([0.0, -1.0, 0.0])) == pytest.approx(poses[2, :, 1].numpy())
    assert client.camera.fov == pytest.approx(2 * np.arctan(60 / 2 / 50))

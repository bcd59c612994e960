"""What the seed points say about the space before the cameras."""

from __future__ import annotations

import copy

import pytest
import torch

from ssa_nerfstudio.plugin.training.seed_points import color_parameters, nearest_depth, outside_cameras
from ssa_nerfstudio.rasterization.constants import NEAR_PLANE

K = torch.tensor([[50.0, 0.0, 32.0], [0.0, 50.0, 24.0], [0.0, 0.0, 1.0]])


def test_the_nearest_depth_is_that_of_points_in_a_frame() -> None:
    points = torch.tensor([[0.0, 0.0, 3.0], [0.0, 0.0, 2.0], [0.0, 0.0, -1.0], [5.0, 0.0, 1.0]])
    behind = torch.eye(4)
    behind[2, 3] = 4.0
    poses = torch.stack([torch.eye(4), behind])
    assert nearest_depth(points, poses[:1], K[None], 64, 48) == 2.0
    assert nearest_depth(points, poses, K.expand(2, 3, 3), 64, 48) == 2.0, "the second camera is farther back"
    assert nearest_depth(points[2:], poses[:1], K[None], 64, 48) is None


def test_a_few_wrong_matches_before_a_camera_do_not_count() -> None:
    points = torch.cat([torch.tensor([[0.0, 0.0, 0.05]]), torch.tensor([[0.0, 0.0, 2.0]]).expand(2000, 3)])
    assert nearest_depth(points, torch.eye(4)[None], K[None], 64, 48) == 2.0


@pytest.mark.parametrize(("strategy", "clearance"), [("adc", 0.5), ("adc", 0.0), ("mcmc", 0.5), ("mcmc", 0.0)])
def test_a_blob_before_a_camera_is_not_drawn_and_a_checkpoint_remembers_it(
    tiny_scene, tmp_path, configure_training, strategy: str, clearance: float
) -> None:
    """A Gaussian at a tenth of the nearest depth fills the picture without clearance."""
    settings = {"overlay": "off", "num_downscales": 0, "strategy": strategy, "clearance": clearance, "cap_max": 1000}
    config = configure_training("ssa-splatfacto", tiny_scene, tmp_path, 2, settings)
    pipeline = config.pipeline.setup(device="cpu", test_mode="val", world_size=1, local_rank=0)
    model = pipeline.model
    plane = float(model.near_plane)
    pipeline.eval()
    camera, _ = pipeline.datamanager.fixed_indices_eval_dataloader[0]
    before = model.get_outputs_for_camera(camera)["rgb"]
    center, forward = camera.camera_to_worlds[0, :3, 3], -camera.camera_to_worlds[0, :3, 2]
    depth = plane / 5 if plane > NEAR_PLANE else 2 * NEAR_PLANE
    with torch.no_grad():
        model.means[0] = center + max(depth, 1.1 * NEAR_PLANE) * forward
        model.scales[0], model.opacities[0] = -3.0, 8.0
    after = model.get_outputs_for_camera(camera)["rgb"]
    hidden = clearance > 0
    assert (plane > NEAR_PLANE) == hidden
    assert ((after - before).abs().mean() < 0.05) == hidden
    state = copy.deepcopy(model.state_dict())
    model.set_near_plane(None)
    model.load_state_dict(state)
    assert float(model.near_plane) == plane
    assert torch.equal(model.get_outputs_for_camera(camera)["rgb"], after)
    del state["near_plane"]  # a checkpoint of before
    model.load_state_dict(state)
    assert float(model.near_plane) == pytest.approx(NEAR_PLANE)


def test_only_seed_points_inside_a_camera_are_dropped(caplog):
    """Nearer than the near plane to any of the cameras, of which there are more than are compared at once."""
    positions = torch.zeros(130, 3, dtype=torch.float64)
    positions[:, 0] = torch.arange(130)
    means = torch.tensor([[0.0, 0.0, 0.009], [0.0, 0.0, 0.011], [129.0, 0.005, 0.0], [64.5, 0.0, 0.0]])
    assert outside_cameras(means, positions).tolist() == [False, True, False, True]
    assert not caplog.text


def test_a_scene_within_a_camera_keeps_its_points_and_says_so(caplog):
    assert outside_cameras(torch.zeros(3, 3), torch.zeros(2, 3)).tolist() == [True] * 3
    assert "every seed point is within 0.01 of a camera" in caplog.text
    assert "auto-scale-poses True" in caplog.text


def test_seed_colors_are_what_is_drawn():
    colors = torch.tensor([[0, 51, 255], [128, 200, 10]], dtype=torch.uint8)
    values = colors.double() / 255
    constant = color_parameters(colors, 3).double()
    torch.testing.assert_close(0.28209479177387814 * constant + 0.5, values, atol=1e-6, rtol=0)
    torch.testing.assert_close(torch.sigmoid(color_parameters(colors, 0)).double(), values, atol=2e-6, rtol=0)
    assert color_parameters(colors, 0).isfinite().all()

"""The viewer's elements and the frames they ask for, without a browser."""

from __future__ import annotations

import copy
import threading
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
import viser
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.viewer.render_state_machine import RenderStateMachine
from nerfstudio.viewer.utils import parse_object
from nerfstudio.viewer.viewer_elements import ViewerElement

from ssa_nerfstudio.plugin.artifacts import Artifacts
from ssa_nerfstudio.plugin.viewer import LazyOutputs, _SaveButton


class Drawing(RenderStateMachine):
    """The viewer's own kind of thread, drawing one frame."""

    def __init__(self, model, camera) -> None:
        threading.Thread.__init__(self)
        self.model, self.camera, self.outputs = model, camera, {}

    def run(self) -> None:
        with torch.no_grad():
            self.outputs = self.model.get_outputs_for_camera(self.camera)


def frame(model, camera) -> dict[str, Any]:
    thread = Drawing(model, camera)
    thread.start()
    thread.join()
    return thread.outputs


@pytest.fixture(scope="module")
def pipelines(tiny_scene, tmp_path_factory, configure_training, train_and_evaluate):
    folder = tmp_path_factory.mktemp("viewer")
    return {
        overlay: train_and_evaluate(
            configure_training("ssa-splatfacto", tiny_scene, folder, 40, {"num_downscales": 0, "overlay": overlay})
        )[1].eval()
        for overlay in ("on", "off")
    }


@pytest.fixture
def model(pipelines):
    model = pipelines["on"].model
    yield model
    for element in (model.overlay.a_show, model.overlay.b_layer, model.overlay.c_strength, model.overlay.d_camera):
        element.default_value = {"Show overlay": False, "Layer": "composite", "Strength": 1.0}.get(
            element.name, "of the view"
        )


@pytest.fixture
def camera(pipelines):
    return copy.deepcopy(pipelines["on"].datamanager.eval_dataset.cameras[0:1])


def choose(model, **values) -> None:
    """Set elements as a user would; without a viewer their value is the default."""
    for name, value in values.items():
        getattr(model.overlay, name).default_value = value


def test_the_viewer_finds_the_elements_in_order(pipelines):
    found = parse_object(pipelines["on"], ViewerElement, "Custom Elements")
    ours = [(path, element.name) for path, element in found if "/overlay/" in path]
    assert [name for _, name in ours] == ["Show overlay", "Layer", "Strength", "Camera", "Summary", "Save artifact"]
    assert {path.rpartition("/")[0] for path, _ in ours} == {"Custom Elements/model/overlay"}


def test_a_model_without_an_artifact_has_no_elements(pipelines):
    assert not [path for path, _ in parse_object(pipelines["off"], ViewerElement, "") if "overlay" in path]


def test_the_elements_add_nothing_to_checkpoints_and_optimizers(model):
    assert not [name for name in model.state_dict() if "controls" in name or name.startswith("overlay")]


def test_off_is_the_default_and_shows_the_clean_scene(model, camera):
    elsewhere = model.get_outputs_for_camera(camera)
    seen = frame(model, camera)
    assert torch.equal(seen["rgb"], elsewhere["rgb"])
    assert seen.keys() == elsewhere.keys()
    for name in ("composite", "overlay_rgb", "overlay_alpha"):
        torch.testing.assert_close(seen[name], elsewhere[name])


def test_every_layer_is_what_its_name_says(model, camera):
    plain = model.get_outputs_for_camera(camera)
    choose(model, a_show=True)
    assert torch.equal(frame(model, camera)["rgb"], plain["composite"])
    choose(model, b_layer="clean")
    assert torch.equal(frame(model, camera)["rgb"], plain["rgb"])
    choose(model, b_layer="matte")
    torch.testing.assert_close(frame(model, camera)["rgb"], plain["overlay_alpha"].expand_as(plain["rgb"]))
    choose(model, b_layer="artifact")
    artifact = frame(model, camera)["rgb"]
    opaque = plain["overlay_alpha"][..., 0] > 0.99
    assert (artifact - plain["overlay_rgb"])[opaque].abs().max() < 0.02
    clear = plain["overlay_alpha"][..., 0] < 0.02
    assert clear.any()
    assert ((artifact[clear] - 0.425).abs() - 0.075).abs().max() < 0.03


def test_depth_is_that_of_what_is_seen_however_transparent_it_is(model, camera):
    solid = model.get_outputs_for_camera(camera)
    before = model.opacities.detach().clone()
    try:
        with torch.no_grad():
            model.opacities.fill_(-4.0)
        faint = model.get_outputs_for_camera(camera)
    finally:
        with torch.no_grad():
            model.opacities.copy_(before)
    seen = faint["accumulation"] > 0.01
    assert seen.any()
    assert faint["accumulation"].max() < 0.9
    near, far = solid["depth"].min(), solid["depth"].max()
    assert faint["depth"][seen].min() > 0.9 * near
    assert faint["depth"][seen].median() < far


def test_a_crop_leaves_what_is_inside_of_it(model, camera):
    whole = model.get_outputs_for_camera(camera)
    x, y, z = model.means.detach().median(dim=0).values.tolist()
    box = OrientedBox.from_params((x, y, z), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    inside = box.within(model.means.detach())
    assert 0 < inside.sum() < len(inside)
    cropped = model.get_outputs_for_camera(camera, obb_box=box)
    before = model.opacities.detach().clone()
    try:
        with torch.no_grad():
            model.opacities[~inside] = -30.0
        alone = model.get_outputs_for_camera(camera)
    finally:
        model.set_crop(None)
        with torch.no_grad():
            model.opacities.copy_(before)
    torch.testing.assert_close(cropped["rgb"], alone["rgb"], atol=1e-4, rtol=0)
    assert not torch.allclose(cropped["rgb"], whole["rgb"], atol=0.05)


def test_a_crop_around_nothing_shows_the_background(model, camera):
    box = OrientedBox.from_params((1e4, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    try:
        cropped = model.get_outputs_for_camera(camera, obb_box=box)
    finally:
        model.set_crop(None)
    assert cropped["rgb"].shape == (48, 64, 3)
    assert torch.equal(cropped["rgb"].cpu(), model.background_color.expand(48, 64, 3))
    assert not cropped["accumulation"].any()


def test_strength_scales_the_matte(model, camera):
    plain = model.get_outputs_for_camera(camera)
    choose(model, a_show=True, c_strength=0.0)
    torch.testing.assert_close(frame(model, camera)["rgb"], plain["rgb"])
    choose(model, c_strength=0.5)
    half = frame(model, camera)
    torch.testing.assert_close(half["overlay_alpha"], 0.5 * plain["overlay_alpha"])
    torch.testing.assert_close(half["rgb"], 0.5 * (plain["rgb"] + plain["composite"]), atol=1e-5, rtol=0)


def test_light_that_hides_nothing_is_added_and_shown_with_the_least_matte(model, camera, monkeypatch):
    overlay = model.artifacts.learned()[0]
    monkeypatch.setattr(overlay, "adds_light", True)
    light, hides = overlay.color().detach(), overlay.matte().detach()
    assert (light.amax(dim=-1, keepdim=True) > hides + 0.1).any()
    clean = frame(model, camera)["rgb"]
    choose(model, a_show=True)
    seen = frame(model, camera)
    torch.testing.assert_close(seen["rgb"], ((1 - hides) * clean + light).clamp(0, 1))
    torch.testing.assert_close(seen["overlay_alpha"], torch.maximum(hides, light.amax(dim=-1, keepdim=True)))
    torch.testing.assert_close(seen["overlay_alpha"] * seen["overlay_rgb"], light)
    choose(model, c_strength=0.5)
    half = frame(model, camera)
    torch.testing.assert_close(half["rgb"], ((1 - 0.5 * hides) * clean + 0.5 * light).clamp(0, 1))
    torch.testing.assert_close(half["overlay_alpha"], 0.5 * seen["overlay_alpha"])
    choose(model, b_layer="matte")
    torch.testing.assert_close(frame(model, camera)["rgb"], half["overlay_alpha"].expand_as(clean))
    assert "more than half hidden or lit" in model.artifacts.summary(0)


@pytest.mark.parametrize(("width", "height"), [(200, 48), (64, 200), (30, 30), (513, 385)])
def test_any_viewport_shows_the_artifact_letterboxed(model, camera, width, height):
    camera.width[:], camera.height[:] = width, height
    choose(model, a_show=True, b_layer="matte")
    matte = frame(model, camera)["rgb"][..., 0]
    assert matte.shape == (height, width)
    scale = min(width / 64, height / 48)
    across, down = (width - 64 * scale) / 2, (height - 48 * scale) / 2
    if across > 2:
        assert matte[:, : int(across) - 1].max() == 0
        assert matte[:, width - int(across) + 1 :].max() == 0
    if down > 2:
        assert matte[: int(down) - 1].max() == 0
    bottom = height - down - 4 * scale
    assert matte[int(bottom) : int(height - down - 1), width // 3 : width // 2].mean() > 0.8


def test_what_is_off_costs_nothing(model, camera, monkeypatch):
    asked = []
    original = Artifacts.layers_of_camera
    monkeypatch.setattr(Artifacts, "layers_of_camera", lambda self, *a: asked.append(a) or original(self, *a))
    model.overlay._summarized = float("inf")
    seen = frame(model, camera)
    assert not asked
    assert seen["composite"].shape == (48, 64, 3)
    assert seen["overlay_alpha"].shape == (48, 64, 1)
    assert len(asked) == 1
    model.overlay._summarized = 0.0


def test_one_overlay_of_a_rig_can_be_chosen(model, camera, monkeypatch):
    asked = []
    original = Artifacts.layers_of_camera
    monkeypatch.setattr(
        Artifacts, "layers_of_camera", lambda self, c, w, h, group: asked.append(group) or original(self, c, w, h, 0)
    )
    choose(model, a_show=True)
    frame(model, camera)
    choose(model, d_camera="camera 2")
    monkeypatch.setattr(Artifacts, "summary", lambda self, group: "")
    frame(model, camera)
    assert asked == [None, 2]


def test_outputs_on_demand_are_computed_once():
    calls = []
    outputs = LazyOutputs(a=torch.ones(1), b=lambda: calls.append(1) or torch.zeros(1))
    assert list(outputs) == ["a", "b"]
    assert not calls
    assert outputs["b"] is outputs["b"]
    assert calls == [1]


def test_the_saved_picture_is_the_artifact(model):
    import cv2

    name, content = model.overlay._picture()
    assert name == "artifact-camera-0.png"
    rgba = cv2.cvtColor(cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED), cv2.COLOR_BGRA2RGBA)
    alpha = model.artifacts.learned()[0].matte().numpy(force=True)
    np.testing.assert_allclose(rgba[..., 3:] / 255, alpha, atol=0.5 / 255 + 1e-6)


def test_the_button_sends_the_file_to_who_pressed_it():
    handle, client = MagicMock(spec=viser.GuiButtonHandle), MagicMock()
    server: Any = SimpleNamespace(gui=SimpleNamespace(add_button=lambda name, **_: handle))
    _SaveButton(lambda: ("artifact.png", b"picture")).install(server)
    (pressed,) = handle.on_click.call_args.args
    pressed(SimpleNamespace(client=None))
    pressed(SimpleNamespace(client=client))
    client.send_file_download.assert_called_once_with("artifact.png", b"picture")


def test_the_log_has_scalars_and_pictures_of_the_artifact(pipelines):
    pipeline = pipelines["on"]
    camera, batch = pipeline.datamanager.fixed_indices_eval_dataloader[0]
    outputs = pipeline.model.get_outputs_for_camera(camera)
    _, pictures = pipeline.model.get_image_metrics_and_images(outputs, batch)
    assert pictures.keys() == {"img", "clean_and_composite", "overlay_and_matte"}
    assert all(picture.shape == (48, 128, 3) for picture in pictures.values())
    pipeline.model.step = 0
    scalars = pipeline.model.get_metrics_dict(outputs, batch)
    alpha = pipeline.model.artifacts.learned()[0].matte().detach()
    assert float(scalars["overlay_covered"]) == pytest.approx(float((alpha > 0.5).float().mean()))
    assert float(scalars["overlay_matte"]) == pytest.approx(float(alpha.mean()))

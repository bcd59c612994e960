"""Controls of the overlay in nerfstudio's viewer: a checkbox, a choice of layers, a summary, a button that saves.

The viewer finds elements by walking every public attribute of the model and sorts them by the attributes' names, hence
the letters that start the names. Without a viewer elements have their default value, and the overlay is off.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from functools import cache
from typing import Any

import torch
import viser
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.viewer.render_state_machine import RenderStateMachine
from nerfstudio.viewer.viewer_elements import ViewerCheckbox, ViewerDropdown, ViewerElement, ViewerSlider
from torch import Tensor, nn

from ssa_nerfstudio.overlay.compositing import composite
from ssa_nerfstudio.overlay.resampling import straight_color
from ssa_nerfstudio.overlay.rgba import over_checkerboard, to_rgba8
from ssa_nerfstudio.plugin.artifacts import Artifacts

LAYERS = ["composite", "artifact", "matte", "clean"]
"""Choices of "Show overlay": the composite, the artifact over a checkerboard, its matte, the clean scene."""
AUTOMATIC = "of the view"
"""Choice of camera: the group whose frame the view has."""
SECONDS_BETWEEN_SUMMARIES = 1.0
"""The summary waits for the device, so it is not updated with every frame."""


def is_viewer_frame() -> bool:
    """Whether this frame is drawn for a viewer, not for an evaluation, a render or a training step."""
    return isinstance(threading.current_thread(), RenderStateMachine)


class LazyOutputs(dict[str, Any]):
    """Outputs of a model, some of which are functions that are called on first access.

    The viewer lists the outputs by name and reads one of them.
    """

    def __getitem__(self, name: str) -> Any:
        value = super().__getitem__(name)
        if not isinstance(value, Tensor) and callable(value):
            value = value()
            self[name] = value
        return value


class ArtifactControls(nn.Module):
    """The elements, and the frames that they select. Holds no parameters."""

    def __init__(self, artifacts: Callable[[], Artifacts]) -> None:
        """Take a function that returns the overlays, which are assigned or loaded later."""
        super().__init__()
        self._artifacts = artifacts
        self._summarized = 0.0
        self.a_show = ViewerCheckbox("Show overlay", False, hint="Off: rgb is the clean scene")
        self.b_layer = ViewerDropdown("Layer", LAYERS[0], LAYERS, hint="What is shown where rgb was")
        self.c_strength = ViewerSlider("Strength", 1.0, 0.0, 1.0, 0.05, hint="Factor of the matte")
        self.d_camera = _CameraChoice(artifacts)
        self.e_summary = _Line()
        self.f_save = _SaveButton(self._picture)

    def outputs(self, drawn: dict[str, Any], camera: Cameras, width: int, height: int) -> dict[str, Any]:
        """Make a frame of the viewer.

        Args:
            drawn: outputs of the clean scene.
            camera, width, height: the viewport; the overlay is letterboxed into it, never stretched.

        Returns:
            The outputs with `rgb` as the elements select it, and composite, overlay_rgb and overlay_alpha on access.
        """
        show, layer, strength, group = self.a_show.value, self.b_layer.value, self.c_strength.value, self._group()
        clean = drawn["rgb"]

        @cache
        @torch.no_grad()
        def layers() -> tuple[Tensor, Tensor]:
            found = self._artifacts().layers_of_camera(camera, width, height, group)
            if found is None:  # a camera of a rig without an artifact
                return clean.new_ones(height, width, 1), clean.new_zeros(height, width, 3)
            transmittance, addition = found
            return 1.0 - strength * (1.0 - transmittance), strength * addition

        pictures: dict[str, Callable[[], Tensor]] = {
            "composite": lambda: composite(clean, *layers()).clamp(0.0, 1.0),
            "overlay_rgb": lambda: straight_color(*layers())[0],
            "overlay_alpha": lambda: straight_color(*layers())[1],
        }
        if show and layer == "composite":
            drawn["rgb"] = pictures["composite"]()
        elif show and layer == "artifact":
            drawn["rgb"] = over_checkerboard(*straight_color(*layers()))
        elif show and layer == "matte":
            drawn["rgb"] = straight_color(*layers())[1].expand_as(clean)
        if time.monotonic() - self._summarized > SECONDS_BETWEEN_SUMMARIES:
            self._summarized = time.monotonic()
            self.e_summary.write(self._artifacts().summary(group or 0))
        return LazyOutputs({**drawn, **pictures})

    def _group(self) -> int | None:
        chosen = self.d_camera.value
        return None if chosen == AUTOMATIC else int(chosen.rpartition(" ")[2])

    def _picture(self) -> tuple[str, bytes]:
        """Name and content of the file that the button saves."""
        import cv2  # here, so that the commands that never save do not wait for it

        group = self._group() or 0
        with torch.no_grad():
            transmittance, addition = self._artifacts()[group].layers()
        rgba = to_rgba8(transmittance, addition)
        encoded, png = cv2.imencode(".png", cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGRA))
        assert encoded
        return f"artifact-camera-{group}.png", png.tobytes()


class _CameraChoice(ViewerDropdown[str]):
    """Chooses the camera group, or the interval where the artifact changes; hidden where there is one overlay."""

    def __init__(self, artifacts: Callable[[], Artifacts]) -> None:
        super().__init__("Camera", AUTOMATIC, [AUTOMATIC], hint="Which camera's artifact is shown, counted from 0")
        self._artifacts = artifacts

    def _create_gui_handle(self, viser_server: viser.ViserServer) -> None:
        artifacts = self._artifacts()
        kind = "interval" if artifacts.changes else "camera"
        self.options = [AUTOMATIC, *(f"{kind} {group}" for group in range(len(artifacts)))]
        self.visible = len(artifacts) > 1
        super()._create_gui_handle(viser_server)


class _Line(ViewerElement[str]):
    """A line of text. Not an input, whose update would wait for the lock that the rendering thread holds."""

    def __init__(self) -> None:
        super().__init__("Summary")
        self._handle: viser.GuiMarkdownHandle | None = None

    def _create_gui_handle(self, viser_server: viser.ViserServer) -> None:
        self._handle = viser_server.gui.add_markdown("")

    def install(self, viser_server: viser.ViserServer) -> None:
        self._create_gui_handle(viser_server)

    def write(self, text: str) -> None:
        if self._handle is not None and self._handle.content != text:
            self._handle.content = text


class _SaveButton(ViewerElement[bool]):
    """Sends a file to the browser in which it was pressed."""

    def __init__(self, content: Callable[[], tuple[str, bytes]]) -> None:
        super().__init__("Save artifact")
        self._content = content

    def _create_gui_handle(self, viser_server: viser.ViserServer) -> None:
        self.gui_handle = viser_server.gui.add_button(self.name, icon=viser.Icon.DOWNLOAD)

    def install(self, viser_server: viser.ViserServer) -> None:
        self._create_gui_handle(viser_server)
        assert isinstance(self.gui_handle, viser.GuiButtonHandle)

        @self.gui_handle.on_click
        def _(event: viser.GuiEvent) -> None:
            if event.client is not None:
                event.client.send_file_download(*self._content())

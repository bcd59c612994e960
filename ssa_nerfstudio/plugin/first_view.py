"""Where the viewer opens: at a training photo. nerfstudio's own place is somewhere among the floaters."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import viser
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO, Viewer
from nerfstudio.viewer.viewer_elements import ViewerControl
from viser import transforms


class FirstView(ViewerControl):
    """Puts every browser that connects where the middle one of the training photos was taken.

    The viewer finds it as a public attribute of the pipeline, and gives it itself.
    """

    def __init__(self, cameras: Callable[[], Cameras]) -> None:
        """Take a function that returns the cameras of the training photos, at least one."""
        self._cameras = cameras

    def _setup(self, viewer: Viewer) -> None:
        super()._setup(viewer)
        viewer.viser_server.on_client_connect(self._place)

    def _place(self, client: viser.ClientHandle) -> None:
        cameras = self._cameras()
        camera = cameras[len(cameras) // 2]
        pose = camera.camera_to_worlds.cpu().numpy().astype(float)
        with client.atomic():
            client.camera.position = pose[:, 3] * VISER_NERFSTUDIO_SCALE_RATIO
            # From OpenGL's axes, which look along -z, to viser's, which look along z.
            client.camera.wxyz = transforms.SO3.from_matrix(pose[:, :3] * [1.0, -1.0, -1.0]).wxyz
            client.camera.fov = 2 * float(np.arctan(camera.height.item() / 2 / camera.fy.item()))

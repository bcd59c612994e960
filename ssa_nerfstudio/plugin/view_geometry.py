"""View matrices, intrinsics and frame sizes of nerfstudio's cameras, as rasterizers take them."""

from __future__ import annotations

from typing import Any

from nerfstudio.cameras.cameras import Cameras
from torch import Tensor


def metadata(camera: Cameras) -> dict[str, Any]:
    """What `prepare` stored with a camera, or an empty dictionary."""
    return camera.metadata or {}


def frame(camera: Cameras) -> tuple[int, int]:
    """Width and height of one camera; from the host where `prepare` stored them, because reading the device waits."""
    known = metadata(camera).get("frame")
    return known if known is not None else (int(camera.width.item()), int(camera.height.item()))


def intrinsics(camera: Cameras, reduction: int) -> Tensor:
    """Ks [1, 3, 3] in pixels of an image reduced by a whole factor."""
    prepared = metadata(camera).get("Ks")
    if prepared is not None and reduction in prepared:
        return prepared[reduction]
    Ks = camera.get_intrinsics_matrices().reshape(1, 3, 3).to(camera.device)
    Ks[:, :2] /= reduction
    return Ks


def view_matrix(camera_to_world: Tensor) -> Tensor:
    """World to camera [C, 4, 4] with OpenCV axes, of rigid camera to world [C, 3 or 4, 4] with OpenGL axes."""
    rotation = (camera_to_world[:, :3, :3] * camera_to_world.new_tensor([1.0, -1.0, -1.0])).transpose(1, 2)
    view = camera_to_world.new_zeros(len(camera_to_world), 4, 4)
    view[:, :3, :3] = rotation
    view[:, :3, 3:] = -rotation @ camera_to_world[:, :3, 3:4]
    view[:, 3, 3] = 1.0
    return view


def prepare(cameras: Cameras, reductions: tuple[int, ...]) -> list[Cameras]:
    """Split cameras into single ones whose metadata hold what a training step needs, on the device.

    Metadata: `cam_idx`, `frame` (width, height on the host), `viewmat` [1, 4, 4], `Ks` {reduction: [1, 3, 3]}.
    """
    widths, heights = cameras.width.flatten().tolist(), cameras.height.flatten().tolist()
    views = view_matrix(cameras.camera_to_worlds)
    prepared = []
    for index in range(len(widths)):
        camera = cameras[index : index + 1]
        Ks = {reduction: intrinsics(camera, reduction) for reduction in reductions}
        camera.metadata = {
            **metadata(camera),
            "cam_idx": index,
            "frame": (widths[index], heights[index]),
            "viewmat": views[index : index + 1],
            "Ks": Ks,
        }
        prepared.append(camera)
    return prepared


def extent(positions: Tensor) -> float:
    """Radius of cameras at positions [V, 3] around their center, times 1.1 (3DGS: `nerf_normalization`), not 0."""
    return max(1e-6, 1.1 * float((positions - positions.mean(dim=0)).norm(dim=1).max()))

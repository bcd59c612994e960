"""The artifacts of a capture inside the model: one overlay a camera group, and which camera shows which."""

from __future__ import annotations

from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor, nn

from ssa_nerfstudio.errors import refuse
from ssa_nerfstudio.overlay.layer import GivenOverlay, ScreenSpaceOverlay, fitted
from ssa_nerfstudio.plugin.camera_groups import LENS_VALUES, match_camera, nearest_aspect

Overlay = ScreenSpaceOverlay | GivenOverlay


class Artifacts(nn.Module):
    """Overlays by camera group. Empty until `put` is called or a checkpoint makes room for its own."""

    camera_keys: Tensor
    lenses: Tensor
    """[G, LENS_VALUES], the raw cameras of the groups; empty where a checkpoint was written before they were kept."""

    def __init__(self) -> None:
        super().__init__()
        self.overlays = nn.ModuleList()
        self.register_buffer("camera_keys", torch.zeros(0, 6, dtype=torch.float64))
        self.register_buffer("lenses", torch.zeros(0, LENS_VALUES, dtype=torch.float64))
        self._keys: list[list[float]] = []
        self._group_of_view: list[int] = []

    def __len__(self) -> int:
        return len(self.overlays)

    def __getitem__(self, group: int) -> Overlay:
        overlay = self.overlays[group]
        assert isinstance(overlay, ScreenSpaceOverlay | GivenOverlay)
        return overlay

    def put(
        self,
        overlays: list[ScreenSpaceOverlay] | list[GivenOverlay],
        keys: Tensor,
        groups: list[int],
        lenses: Tensor,
    ) -> None:
        """Put artifacts in front of the scene.

        Args:
            overlays: one a camera group.
            keys: [G, 6], what the groups' cameras are (`camera_groups.group_cameras`).
            groups: each training view's group.
            lenses: [G, LENS_VALUES], the groups' raw cameras (`camera_groups.describe_lenses`).
        """
        device = self.camera_keys.device
        self.overlays = nn.ModuleList(overlays).to(device)
        self.camera_keys, self.lenses = keys.to(device), lenses.to(device)
        self._keys, self._group_of_view = keys.tolist(), groups

    def learned(self) -> list[ScreenSpaceOverlay]:
        """The overlays that have parameters."""
        return [overlay for overlay in self.overlays if isinstance(overlay, ScreenSpaceOverlay)]

    def layers_of_view(self, view: int, reduction: int) -> tuple[Tensor, Tensor]:
        """Transmittance and added light in front of a training view, at 1 / reduction of its size."""
        return self[self._group_of_view[view]].layers(reduction)

    def layers_of_camera(
        self, camera: Cameras, width: int, height: int, group: int | None = None
    ) -> tuple[Tensor, Tensor]:
        """Transmittance and added light in front of any camera.

        A camera with the frame of a group shows that group's; a free viewpoint the one of its aspect, or the first;
        unless a group is named.
        """
        if group is None:
            group = match_camera(camera, self._keys)
        return fitted(self[nearest_aspect(camera, self._keys) if group is None else group], height, width)

    @torch.no_grad()
    def covered(self, group: int) -> tuple[Tensor, Tensor]:
        """Fraction of the frame with a matte above one half, and the mean matte, both on the device."""
        alpha = 1.0 - self[group].layers()[0].mean(dim=-1)
        return (alpha > 0.5).float().mean(), alpha.mean()

    def figures(self, group: int) -> str:
        """`covered` in words."""
        fraction, mean = (float(value) for value in self.covered(group))
        return f"{fraction:.1%} of the frame covered, mean matte {mean:.3f}"

    def make_room(self, state: dict[str, Any], prefix: str, wanted: bool) -> None:
        """Take the shapes of a checkpoint's overlays, or refuse one that does not fit those that are being trained.

        Args:
            state: the model's state dict.
            prefix: under which this module's entries stand in it.
            wanted: False where an artifact must not appear: the run was asked to train without one.
        """
        count = len(state.get(f"{prefix}camera_keys", ()))
        frames = [tuple(int(v) for v in state[f"{prefix}overlays.{g}.frame"]) for g in range(count)]
        given = f"{prefix}overlays.0.transmittance" in state
        if len(self):
            here = [tuple(self[g].frame.tolist()) for g in range(len(self))]
            if frames != here or given != isinstance(self[0], GivenOverlay):
                raise refuse(
                    f"the checkpoint's overlays are {'given' if given else 'learned'}, (height, width, downscale) "
                    f"{frames or 'absent'}, this run's are {here}; resume with the photos, camera-res-scale-factor and "
                    "overlay options it was trained with"
                )
            return
        if frames and not wanted:
            raise refuse("the checkpoint has an overlay and this run has none; resume with --pipeline.model.overlay on")
        device = self.camera_keys.device
        self.overlays = nn.ModuleList(
            GivenOverlay(torch.ones(h, w, 3), torch.zeros(h, w, 3)) if given else ScreenSpaceOverlay(h, w, resolution)
            for h, w, resolution in frames
        ).to(device)
        self.camera_keys = torch.zeros(count, 6, dtype=torch.float64, device=device)
        self.lenses = torch.zeros(
            len(state.get(f"{prefix}lenses", ())), LENS_VALUES, dtype=torch.float64, device=device
        )

    def _load_from_state_dict(self, state_dict, prefix, *args, **kwargs) -> None:
        state_dict.setdefault(f"{prefix}lenses", self.lenses)  # checkpoints of the first version have none
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)
        self._keys = self.camera_keys.tolist()

"""The overlays of a capture inside the model: one per camera group, and which camera shows which."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor, nn

from ssa_nerfstudio.cameras.intervals import BEGINNING, capture_order, interval_at
from ssa_nerfstudio.data.photos import MAX_PIXELS
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.overlay.layer import OPTIONAL_BUFFERS, OracleOverlay, ScreenSpaceOverlay, letterboxed_layers
from ssa_nerfstudio.overlay.resampling import straight_color
from ssa_nerfstudio.plugin.camera_matching import LENS_VALUES, find_frame, match_camera, nearest_aspect
from ssa_nerfstudio.plugin.checkpoint_groups import cameras_in, names_in
from ssa_nerfstudio.plugin.view_geometry import metadata

Overlay = ScreenSpaceOverlay | OracleOverlay


class Artifacts(nn.Module):
    """Overlays by camera group; empty until `assign` or `allocate` is called.

    A group without an artifact has no overlay, which checkpoints record, too. Where the artifact changes, each interval
    of a camera's photos is a group.
    """

    camera_keys: Tensor
    """[G, 6], cameras of the groups with an overlay: width, height, fx, fy, cx, cy."""
    lenses: Tensor
    """[G, LENS_VALUES], their raw cameras; empty in checkpoints of the first version."""
    bare_keys: Tensor
    """[B, 6], cameras of the groups without an artifact."""
    backdrop: Tensor
    """[N, 7], seeds of what no photo shows (`Seeds.table`), until the scene gets them at the end."""

    def __init__(self) -> None:
        super().__init__()
        self.overlays = nn.ModuleList()
        self.register_buffer("camera_keys", torch.zeros(0, 6, dtype=torch.float64))
        self.register_buffer("lenses", torch.zeros(0, LENS_VALUES, dtype=torch.float64))
        self.register_buffer("bare_keys", torch.zeros(0, 6, dtype=torch.float64))
        self.register_buffer("backdrop", torch.zeros(0, 7))
        self._keys: list[list[float]] = []
        self._bare: list[list[float]] = []
        self._group_of_view: list[int | None] = []
        self.photo_shares: list[float] = []
        """Share of the training views that show each overlay, in [0, 1]."""
        self.starts: list[str] = []
        """First photo of each group (`cameras.intervals`), of those with an overlay before the others."""
        self.cameras: list[str] = []
        """Name of each group's camera, in the same order."""

    def __len__(self) -> int:
        return len(self.overlays)

    def __getitem__(self, group: int) -> Overlay:
        overlay = self.overlays[group]
        assert isinstance(overlay, ScreenSpaceOverlay | OracleOverlay)
        return overlay

    def assign(
        self,
        overlays: Sequence[ScreenSpaceOverlay | OracleOverlay | None],
        keys: Tensor,
        groups: list[int],
        lenses: Tensor,
        starts: list[str] | None = None,
        cameras: list[str] | None = None,
    ) -> None:
        """Assign an overlay to each camera group.

        Args:
            overlays: one per camera group; None where there is no artifact.
            keys: [G, 6], the groups' cameras (`camera_matching.group_cameras`).
            groups: each training view's group.
            lenses: [G, LENS_VALUES], the groups' raw cameras (`camera_matching.describe_lenses`).
            starts: the groups' first photos, relative to the dataset; None where each camera is one group.
            cameras: names of the groups' cameras; None: camera_0, camera_1, ...
        """
        device = self.camera_keys.device
        covered = torch.tensor([overlay is not None for overlay in overlays], dtype=torch.bool)
        self.overlays = nn.ModuleList([overlay for overlay in overlays if overlay is not None]).to(device)
        self.camera_keys, self.lenses = keys[covered].to(device), lenses[covered].to(device)
        self.bare_keys = keys[~covered].to(device)
        self._remember_keys()
        starts = starts or [BEGINNING] * len(keys)
        cameras = cameras or [f"camera_{number}" for number in range(len(keys))]
        order = [group for there in (True, False) for group, c in enumerate(covered.tolist()) if c == there]
        self.starts, self.cameras = [starts[group] for group in order], [cameras[group] for group in order]
        place = torch.where(covered, covered.cumsum(0) - 1, -1).tolist()
        self._remember_views([place[group] if place[group] >= 0 else None for group in groups])

    @property
    def exceed_white(self) -> bool:
        """Whether a composite can exceed 1, where a photo clips."""
        return any(isinstance(overlay, OracleOverlay) or overlay.adds_light for overlay in self.overlays)

    def learned(self) -> list[ScreenSpaceOverlay]:
        """The overlays with parameters."""
        return [overlay for overlay in self.overlays if isinstance(overlay, ScreenSpaceOverlay)]

    def group_of_view(self, view: int) -> int | None:
        """The group of a training view; None where it has no overlay."""
        return self._group_of_view[view]

    def of_view(self, view: int) -> Overlay | None:
        """The overlay of a training view; None where it has none."""
        group = self.group_of_view(view)
        return None if group is None else self[group]

    def layers_of_camera(
        self, camera: Cameras, width: int, height: int, group: int | None = None
    ) -> tuple[Tensor, Tensor] | None:
        """Transmittance and addition of any camera, or None where it has no overlay.

        A camera with the frame of a group shows that group's overlay, and one whose photo is known (`photo` of its
        metadata) that of its interval; a free viewpoint the one of its aspect, or the first; `group` overrides all.
        """
        if group is None:
            group = match_camera(camera, self._keys + self._bare)
            if group is not None and "photo" in metadata(camera):
                group = self.at_photo(group, metadata(camera)["photo"])
        if group is None:
            group = nearest_aspect(camera, self._keys)
        return letterboxed_layers(self[group], height, width) if group < len(self) else None

    def at_photo(self, group: int, photo: str) -> int:
        """The group of a photo, given its path relative to the dataset and any group of its camera."""
        same = self._intervals(group)
        return same[interval_at(photo, [self.starts[other] for other in same])]

    def name(self, group: int) -> str:
        """front, or camera_0 of the only camera; front_interval_2 or interval_2 where its artifact changes."""
        same, camera = self._intervals(group), self.cameras[group]
        if len(same) == 1:
            return camera
        order = sorted(same, key=lambda other: capture_order(self.starts[other]))
        of = f"{camera}_" if len({*self.cameras}) > 1 else ""
        return f"{of}interval_{1 + order.index(group)}"

    @property
    def changes(self) -> bool:
        """Whether a camera has intervals."""
        return any(start != BEGINNING for start in self.starts)

    def _intervals(self, group: int) -> list[int]:
        """All groups of a group's camera, with an overlay and without."""
        keys = self._keys + self._bare
        return [other for other, key in enumerate(keys) if key == keys[group]] if self.changes else [group]

    def get_extra_state(self) -> dict[str, list[str]]:
        """What a checkpoint holds beside the tensors."""
        return {"starts": self.starts, "cameras": self.cameras}

    def set_extra_state(self, state: dict[str, list[str]]) -> None:
        """Take what a checkpoint holds."""
        self.starts, self.cameras = ([str(value) for value in state[name]] for name in ("starts", "cameras"))

    @torch.no_grad()
    def coverage(self, group: int) -> tuple[Tensor, Tensor]:
        """Fraction of the frame with a matte above one half, and the mean matte: scalars on the device."""
        _, alpha = straight_color(*self[group].layers())
        return (alpha > 0.5).float().mean(), alpha.mean()

    def summary(self, group: int) -> str:
        """`coverage` as a phrase."""
        fraction, mean = (float(value) for value in self.coverage(group))
        overlay = self[group]
        light = isinstance(overlay, ScreenSpaceOverlay) and overlay.adds_light
        covered = "hidden or lit" if light else "hidden"
        return f"{fraction:.1%} of the frame more than half {covered}, mean matte {mean:.3f}"

    def allocate(self, state: dict[str, Any], prefix: str, wanted: bool) -> None:
        """Allocate overlays of a checkpoint's shapes for its cameras, or check that they fit those being trained.

        Args:
            state: the model's state dict; entries that older versions lack are added, and others dropped.
            prefix: of this module's entries in it.
            wanted: False where the run is to train without an overlay.

        Raises:
            InputError: the checkpoint's overlays do not fit this run.
        """
        count = len(state.get(f"{prefix}camera_keys", ()))
        for overlay in (f"{prefix}overlays.{g}." for g in range(count)):
            if len(state[f"{overlay}frame"]) == 3:  # checkpoints from before additive light
                state[f"{overlay}frame"] = F.pad(state[f"{overlay}frame"], (0, 1))
            state.pop(f"{overlay}near", None)  # checkpoints from before the estimate from points
            for name in OPTIONAL_BUFFERS if f"{overlay}alpha_logits" in state else ():  # earlier checkpoints have none
                state.setdefault(overlay + name, torch.ones(1, 1, 1))
        frames = [tuple(int(v) for v in state[f"{prefix}overlays.{g}.frame"]) for g in range(count)]
        for height, width, *_ in frames:
            if not 0 < height * width <= MAX_PIXELS:
                raise InputError(f"the checkpoint has an overlay of {height} x {width} pixels", "take another")
        given = f"{prefix}overlays.0.transmittance" in state
        if len(self) or len(self.bare_keys):
            here = [tuple(self[g].frame.tolist()) for g in range(len(self))]
            if frames != here or (frames and given != isinstance(self[0], OracleOverlay)):
                raise InputError(
                    f"the checkpoint's overlays are {('given' if given else 'learned')}, (height, width, downscale, "
                    f"adds light) {frames or 'absent'}, this run's are {here or 'absent'}",
                    "resume with the photos, camera-res-scale-factor and overlay options it was trained with",
                )
            self._allocate_optional(state, prefix)
            return
        if frames and not wanted:
            raise InputError(
                "the checkpoint has an overlay and this run has none", "resume with --pipeline.model.overlay on"
            )
        device = self.camera_keys.device
        self.overlays = nn.ModuleList(
            OracleOverlay(torch.ones(h, w, 3), torch.zeros(h, w, 3))
            if given
            else ScreenSpaceOverlay(h, w, resolution, bool(light))
            for h, w, resolution, light in frames
        ).to(device)
        for name in ("camera_keys", "lenses", "bare_keys"):  # their values, too: a resumed run asks before it loads
            setattr(self, name, state.get(prefix + name, getattr(self, name)).to(self.camera_keys, copy=True))
        self._allocate_optional(state, prefix)

    def _allocate_optional(self, state: dict[str, Any], prefix: str) -> None:
        for g, overlay in enumerate(self.learned()):  # all of them, or none
            for name in OPTIONAL_BUFFERS:
                without = state[f"{prefix}overlays.{g}.{name}"].numel() == 1
                setattr(overlay, name, torch.ones_like(overlay.evidence[:1, :1] if without else overlay.evidence))

    def resume_from(
        self, state: dict[str, Any], prefix: str, keys: Tensor, groups: list[int], setting: str, photos: list[str]
    ) -> None:
        """Allocate the overlays of a checkpoint that is resumed, and assign them to this run's views.

        Args:
            state, prefix: as for `allocate`.
            keys, groups: of this run's training cameras, as for `assign`.
            setting: this run's overlay: auto, on or given.
            photos: paths of this run's photos, relative to the dataset.

        Raises:
            InputError: the checkpoint has no camera of one of this run's sizes, or was trained with another setting.
        """
        self.allocate(state, prefix, wanted=True)
        here = "given" if len(self) and isinstance(self[0], OracleOverlay) else "on" if len(self) else "off"
        if setting not in ("auto", here):
            raise InputError(
                f"the checkpoint was trained with overlay {here}, this run has {setting}",
                f"resume with --pipeline.model.overlay {('auto' if here == 'off' else here)}",
            )
        known = cameras_in(state, prefix)
        if not len(known):  # checkpoints from before groups without an overlay were recorded
            self._remember_views([None] * len(groups))
            return
        places: list[int] = []
        for key in keys:
            place = find_frame(key, known)
            if place is None:
                there = sorted({(int(width), int(height)) for width, height in known[:, :2].tolist()})
                raise InputError(
                    f"the checkpoint was trained on frames (width, height) of {there}, this run has "
                    f"{tuple(key[:2].int().tolist())}",
                    "resume with the photos and camera-res-scale-factor it was trained with",
                )
            places.append(place)
        self._remember_keys()
        self.set_extra_state(names_in(state, prefix))
        found = [self.at_photo(places[group], photo) for group, photo in zip(groups, photos, strict=True)]
        self._remember_views([place if place < len(self) else None for place in found])

    def _remember_views(self, group_of_view: list[int | None]) -> None:
        self._group_of_view = group_of_view
        views = max(1, len(group_of_view))  # of a checkpoint that is only exported there are none
        self.photo_shares = [group_of_view.count(group) / views for group in range(len(self))]

    def _remember_keys(self) -> None:
        self._keys, self._bare = self.camera_keys.tolist(), self.bare_keys.tolist()

    def _load_from_state_dict(self, state_dict, prefix, *args, **kwargs) -> None:
        for name in ("lenses", "bare_keys"):  # checkpoints of the first version have none
            state_dict.setdefault(prefix + name, getattr(self, name))
        if prefix + "camera_keys" in state_dict:  # nerfstudio also loads an empty state into the whole pipeline
            state_dict[f"{prefix}_extra_state"] = names_in(state_dict, prefix)
            backdrop = state_dict.setdefault(f"{prefix}backdrop", self.backdrop[:0])  # earlier ones have none
            self.backdrop = self.backdrop.new_zeros(backdrop.shape)
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)
        self._remember_keys()

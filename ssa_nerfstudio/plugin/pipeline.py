"""Validates the input and assigns overlays to the model before training; otherwise nerfstudio's pipeline."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from torch.cuda.amp.grad_scaler import GradScaler

from ssa_nerfstudio._system.counted_noun import counted
from ssa_nerfstudio.cameras.groups import same_intrinsics
from ssa_nerfstudio.cameras.panorama import Face
from ssa_nerfstudio.data.panorama_entry import read_panorama
from ssa_nerfstudio.data.training_requirements import check_seed_points, check_split_options, check_training
from ssa_nerfstudio.data.transforms import Transforms
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.evidence.point_samples import PointSamples
from ssa_nerfstudio.plugin.camera_matching import describe, describe_lenses, group_cameras, tell_of_fisheyes
from ssa_nerfstudio.plugin.datamanager import SSADatamanager, SSADatamanagerConfig
from ssa_nerfstudio.plugin.decisions import tell
from ssa_nerfstudio.plugin.exposure_setup import start_beside_artifact, start_from_points
from ssa_nerfstudio.plugin.extra_seeds import find_extra_seeds
from ssa_nerfstudio.plugin.face_overlaps import faces_of
from ssa_nerfstudio.plugin.first_view import FirstView
from ssa_nerfstudio.plugin.mask_check import check_masks
from ssa_nerfstudio.plugin.model import SSASplatfactoModel, SSASplatfactoModelConfig
from ssa_nerfstudio.plugin.overlay_setup import NamedPhoto, given_overlays, learned_overlays
from ssa_nerfstudio.plugin.photo_shading import shading_at_start
from ssa_nerfstudio.plugin.shared_sphere import EVERY, SharedSphere
from ssa_nerfstudio.plugin.training.checkpoints import load_pipeline_state
from ssa_nerfstudio.plugin.training.densification import gaussian_budget
from ssa_nerfstudio.plugin.training.seed_points import add_seeds, nearest_depth
from ssa_nerfstudio.plugin.triton_loading import load_triton_meanwhile
from ssa_nerfstudio.plugin.validation import check_device, check_first_resolution, check_settings, check_views
from ssa_nerfstudio.plugin.view_geometry import extent, view_matrix

_LOG = logging.getLogger(__name__)


@dataclass
class SSAPipelineConfig(VanillaPipelineConfig):
    """Configuration of `SSAPipeline`."""

    _target: type = field(default_factory=lambda: SSAPipeline)
    datamanager: SSADatamanagerConfig = field(default_factory=SSADatamanagerConfig)
    """The photos and cameras."""
    model: SSASplatfactoModelConfig = field(default_factory=SSASplatfactoModelConfig)
    """The scene and the artifact."""
    artifacts_of: Path | None = None
    """A checkpoint whose overlays, or lack of them, replace detection. The trainer sets it when it resumes."""


class SSAPipeline(VanillaPipeline):
    """`VanillaPipeline` whose model has its overlays before the optimizers are built."""

    config: SSAPipelineConfig
    datamanager: SSADatamanager
    model: SSASplatfactoModel

    def __init__(
        self,
        config: SSAPipelineConfig,
        device: str,
        test_mode: Literal["test", "val", "inference"] = "val",
        world_size: int = 1,
        local_rank: int = 0,
        grad_scaler: GradScaler | None = None,
    ) -> None:
        check_device(device)
        check_settings(config.model, device)
        check_data(config, test_mode)
        if test_mode == "val" and torch.device(device).type == "cuda":
            load_triton_meanwhile()
        super().__init__(config, device, test_mode, world_size, local_rank, grad_scaler)
        self.sphere: SharedSphere | None = None
        check_views(self.datamanager.train_dataparser_outputs, _source(config))
        self.first_view = FirstView(lambda: self.datamanager.train_dataset.cameras)
        if test_mode == "val":
            cameras = self.datamanager.train_dataset.cameras
            positions = cameras.camera_to_worlds[:, :3, 3]
            self.model.set_scene_extent(extent(positions))
            self.model.start_outside_cameras(positions)
            self._examine_photos()
            # After the photos are decoded: a size that they do not have is the dataset's fault.
            check_first_resolution(cameras, config.model.num_downscales)

    def train(self, mode: bool = True) -> SSAPipeline:
        """Set the mode of all modules; at once where they are in it, because upstream does so before every step."""
        return self if self.training == self._model.training == mode else super().train(mode)

    def _examine_photos(self) -> None:
        """All that reads the training photos before the first step."""
        dataset, checkpoint = self.datamanager.train_dataset, self.config.artifacts_of
        tell_of_fisheyes(dataset.raw_cameras)
        lenses = describe_lenses(dataset.raw_cameras)
        # Undistorts and crops the photos and rewrites the cameras: overlays and depths are of the undistorted frame.
        photos = self.datamanager.cached_train
        names = self.datamanager.photo_names(dataset)
        if checkpoint is None:
            check_masks(photos, group_cameras(dataset.cameras)[1], names)
        samples = self._start_exposure()
        self._set_overlays(photos, lenses)
        known = photos if self.model.exposure is None else None
        shading = self.config.model.shading
        self.model.shading = shading_at_start(shading, self.model.artifacts, names, known, checkpoint)
        self.sphere = self._shared_sphere()
        if self.model.exposure is not None and samples is not None and len(self.model.artifacts):
            by_photos = self.config.model.exposure_place == "auto"
            start_beside_artifact(self.model.exposure, self.model.artifacts, samples, by_photos)
        self._set_near_plane()
        self._add_extra_seeds(photos)
        self._set_budget()
        self.model.examine(self.datamanager)

    def _add_extra_seeds(self, photos: list[dict[str, Any]]) -> None:
        model, cameras = self.model, self.datamanager.train_dataset.cameras
        if self.config.artifacts_of:
            return  # a resumed run has its checkpoint's
        # start_outside_cameras has left out those beside cameras.
        points = None if self._points() is None else model.means.data
        found = find_extra_seeds(model.config, model.artifacts, photos, cameras, points, model.exposure)
        if found is None:
            return
        for seeds, text in found.described():
            add_seeds(seeds, model.gauss_params, model.config.sh_degree)
            tell(text)
        model.artifacts.backdrop = found.backdrop.table().to(model.device)

    def _set_budget(self) -> None:
        config, cameras = self.config.model, self.datamanager.train_dataset.cameras
        if config.strategy == "mcmc":
            pixels, seeds = int((cameras.width * cameras.height).sum()), self.model.num_points
            budget = config.cap_max or gaussian_budget(pixels, seeds)
            self.model.set_budget(budget)
            tell(
                f"Densification: MCMC with at most {max(budget, seeds):,} Gaussians. (--pipeline.model.cap-max states "
                "another number, --pipeline.model.strategy adc finds one, in less time.)"
            )

    def _set_near_plane(self) -> None:
        config, seeds, cameras = self.config.model, self.model.seed_points, self.datamanager.train_dataset.cameras
        if not config.clearance:
            self.model.set_near_plane(None)
        elif seeds is not None and len(seeds[0]):
            size = int(cameras.width.max()), int(cameras.height.max())
            poses, Ks = view_matrix(cameras.camera_to_worlds), cameras.get_intrinsics_matrices()
            self.model.set_near_plane(nearest_depth(seeds[0].to(self.model.device), poses, Ks, *size))

    def _start_exposure(self) -> list[PointSamples] | None:
        exposure, place, photos = self.model.exposure, self.config.model.exposure_place, self.datamanager.train_dataset
        if exposure is None:
            return None
        exposure.photos = self.datamanager.photo_names(photos)
        exposure.stated_place = None if place == "auto" else place
        exposure.place = exposure.stated_place or "photo"
        if self.config.artifacts_of:
            return None  # of a resumed run
        return start_from_points(exposure, self.datamanager.cached_train, photos.cameras, self._points())

    def _points(self) -> torch.Tensor | None:
        """Of the scene, [N, 3]."""
        seeds = self.model.seed_points
        return None if seeds is None else seeds[0]

    def get_train_loss_dict(self, step: int) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
        """Outputs, losses and metrics of a training step; metrics last, because recorded losses bring the pictures."""
        camera, batch = self.datamanager.next_train(step)
        outputs = self._model(camera)
        losses = self.model.get_loss_dict(outputs, batch)
        return outputs, losses, self.model.get_metrics_dict(outputs, batch)

    def get_average_eval_image_metrics(
        self, step: int | None = None, output_path: Path | None = None, get_std: bool = False
    ) -> dict[str, Any]:
        """Metrics over all test views, as upstream; with a warning where the test photos carry the artifact.

        Raises:
            InputError: no photo is left to test on.
        """
        if not len(self.datamanager.eval_dataset):
            raise InputError(
                f"{_source(self.config)}: all {counted(len(self.datamanager.train_dataset), 'photo')} were trained on, "
                "none is left to test on",
                "of ten or more, nerfstudio leaves one in ten; or state test_filenames in transforms.json",
            )
        metrics = super().get_average_eval_image_metrics(step, output_path, get_std)
        transforms = self._transforms() if len(self.model.artifacts) else None
        if transforms is not None and not transforms.test_photos_are_clean:
            _LOG.warning(
                "the test photos carry the artifact, so psnr, ssim and flip of the clean render say little; read "
                "composite_psnr, or state clean photos as test_filenames in transforms.json"
            )
        return metrics

    def _set_overlays(self, photos: list[dict[str, Any]], lenses: torch.Tensor) -> None:
        setting = self.config.model.overlay
        resumed = load_pipeline_state(self.config.artifacts_of) if self.config.artifacts_of else None
        if setting == "off" or (resumed is None and self.config.artifacts_of):
            return  # loading the checkpoint will say what is wrong with it
        keys, groups = group_cameras(self.datamanager.train_dataset.cameras)
        sizes = [(int(key[1]), int(key[0])) for key in keys]
        artifacts = self.model.artifacts
        starts, cameras, names = None, None, self.datamanager.photo_names(self.datamanager.train_dataset)
        if resumed is not None:
            artifacts.resume_from(resumed, "_model.artifacts.", keys, groups, setting, names)
            return
        if setting == "given":
            overlays = given_overlays(self.config.model.overlay_given, sizes)
        else:
            views, exposure = self.datamanager.train_dataset.cameras, self.model.exposure
            gains = None if exposure is None else exposure.gains()
            learned = learned_overlays(
                self.config.model, photos, names, views, self._points(), groups, sizes, gains,
                lambda group: self._withheld_photos(keys[group]), self._faces(keys),
            )  # fmt: skip
            overlays = [each.overlay for each in learned]
            starts, cameras = [each.start for each in learned], [each.camera for each in learned]
            keys = keys[[groups[each.members[0]] for each in learned]]
            group_of = {view: group for group, each in enumerate(learned) for view in each.members}
            groups = [group_of[view] for view in range(len(photos))]
        first = [groups.index(g) for g in range(len(keys))]
        artifacts.assign(overlays, keys, groups, lenses[first], starts, cameras)

    def _faces(self, keys: torch.Tensor) -> list[Face] | None:
        """The faces of a panorama that cameras [G, 6] are; None where they are none."""
        transforms = self._transforms()
        panorama = None if transforms is None else read_panorama(transforms)
        return None if panorama is None else faces_of(panorama, keys)

    def _shared_sphere(self) -> SharedSphere | None:
        """What the learned overlays share; None where no two of them are of faces of one panorama."""
        overlays = self.model.artifacts.learned()
        faces = self._faces(self.model.artifacts.camera_keys.cpu()) if len(overlays) > 1 else None
        return None if faces is None else SharedSphere(faces, overlays)

    def get_training_callbacks(self, training_callback_attributes: Any) -> list[TrainingCallback]:
        """Upstream's; and where overlays share a sphere, they do so every few steps."""
        callbacks, sphere = super().get_training_callbacks(training_callback_attributes), self.sphere
        if sphere is not None:

            def share(step: int) -> None:
                if (step + 1) % EVERY == 0:
                    sphere.share()

            callbacks.append(TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], share))
        return callbacks

    def _withheld_photos(self, key: torch.Tensor) -> list[NamedPhoto]:
        """Test photos of the camera with this key of `group_cameras` that have its artifact: stated ones are clean."""
        transforms = self._transforms()
        if transforms is None or transforms.stated_split("val"):  # without it, nerfstudio takes no stated one
            return []
        photos, dataset = self.datamanager.cached_eval, self.datamanager.eval_dataset
        trained_on = {*self.datamanager.photo_names(self.datamanager.train_dataset)}
        found = []
        for name, photo, own in zip(
            self.datamanager.photo_names(dataset), photos, describe(dataset.cameras), strict=True
        ):
            same = torch.equal(own[:2], key[:2]) and same_intrinsics(own.numpy(), key.numpy())
            if same and name not in trained_on:
                found.append((name, photo))
        return found

    def _transforms(self) -> Transforms | None:
        """The dataset's file; None where another parser than nerfstudio's reads it."""
        ours = isinstance(self.config.datamanager.dataparser, NerfstudioDataParserConfig)
        return Transforms.read(_source(self.config)) if ours else None


def check_data(config: SSAPipelineConfig, test_mode: Literal["test", "val", "inference"] = "val") -> None:
    """Check what a pipeline reads, without opening a photo; a training's is of mode val.

    Raises:
        InputError: it does not exist, or nerfstudio-data is to read it and cannot.
    """
    source = _source(config)
    if test_mode != "val" and not source.exists():
        raise InputError(
            f"{source}, which the run was trained on, does not exist",
            "put it there again" if source.is_absolute() else "call the command where the training was called",
        )
    if isinstance(config.datamanager.dataparser, NerfstudioDataParserConfig):
        transforms, parser = Transforms.read(source), config.datamanager.dataparser
        check_training(transforms, parser.downscale_factor, ("train", "val" if test_mode == "val" else "test"))
        check_split_options(transforms, parser.eval_mode, parser.train_split_fraction, parser.eval_interval)
        if test_mode == "val" and parser.load_3D_points:
            check_seed_points(transforms)


def _source(config: SSAPipelineConfig) -> Path:
    data = config.datamanager.data or config.datamanager.dataparser.data
    return Path(data)

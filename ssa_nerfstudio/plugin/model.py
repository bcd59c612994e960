"""splatfacto with an overlay: wires overlay, rasterizer, densification and losses."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.model_components.lib_bilagrid import total_variation_loss
from nerfstudio.models.splatfacto import SplatfactoModel
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn import Parameter

from ssa_nerfstudio.evidence.seeds import Seeds
from ssa_nerfstudio.overlay.compositing import clip_straight_through, composite
from ssa_nerfstudio.overlay.resampling import straight_color
from ssa_nerfstudio.plugin.artifacts import Artifacts
from ssa_nerfstudio.plugin.compat.nerfstudio_repairs import without_torchmetrics
from ssa_nerfstudio.plugin.datamanager import SSADatamanager
from ssa_nerfstudio.plugin.evaluation import step_metrics, view_images, view_metrics
from ssa_nerfstudio.plugin.exposure import BRIGHTEST, fit_checkpoint
from ssa_nerfstudio.plugin.photo_formation import clean_image
from ssa_nerfstudio.plugin.photo_losses import PhotoLosses
from ssa_nerfstudio.plugin.settings import ModelSettings
from ssa_nerfstudio.plugin.splat_rendering import SplatRenderer
from ssa_nerfstudio.plugin.training import nonfinite, seed_points
from ssa_nerfstudio.plugin.training.densification import AdaptiveDensityControl, MarkovChainMonteCarlo, make_strategy
from ssa_nerfstudio.plugin.training.regularizers import regularizers
from ssa_nerfstudio.plugin.training.scene_brightness import clear_the_clearest
from ssa_nerfstudio.plugin.view_geometry import frame, intrinsics, metadata, view_matrix
from ssa_nerfstudio.plugin.viewer import ArtifactControls, is_viewer_frame
from ssa_nerfstudio.rasterization.constants import NEAR_PLANE


@dataclass
class SSASplatfactoModelConfig(ModelSettings):
    """Configuration of `SSASplatfactoModel`."""

    _target: type = field(default_factory=lambda: SSASplatfactoModel)


class SSASplatfactoModel(PhotoLosses):
    """Gaussian splats and one overlay per camera group. `rgb` is the clean render everywhere.

    The overlays come from the pipeline (`artifacts.assign`) or from a checkpoint.
    """

    config: SSASplatfactoModelConfig
    strategy: AdaptiveDensityControl | MarkovChainMonteCarlo
    near_plane: Tensor
    """Depth (world units) below which cameras draw nothing."""
    by_mcmc: Tensor
    """bool: whether the densification is MCMC, for who resumes from the checkpoint."""

    def populate_modules(self) -> None:
        """Build splatfacto's Gaussians without CUDA and without downloads, then overlays and strategy."""
        points = self.seed_points = nonfinite.finite_points(self.seed_points)
        if points is not None:
            # Upstream moves seed colors to CUDA (splatfacto.py:261); without any it starts from random ones.
            self.seed_points = (points[0], points[1][:0])
        with without_torchmetrics():
            super().populate_modules()
        del self.psnr, self.lpips
        self.seed_points = points
        nonfinite.replace_nonfinite_scales(self.scales.data)
        if points is not None and not self.config.random_init and len(points[1]):
            self.gauss_params["features_dc"] = Parameter(seed_points.color_parameters(points[1], self.config.sh_degree))
        self.artifacts = Artifacts()
        self._draw = SplatRenderer(self.config.rasterizer)
        self._controls = ArtifactControls(lambda: self.artifacts)
        self.scene_scale = 1.0
        self.register_buffer("near_plane", torch.tensor(NEAR_PLANE))
        self.register_buffer("by_mcmc", torch.tensor(self.config.strategy == "mcmc"))
        self._near_plane, self._near_plane_is_set = NEAR_PLANE, False
        self.metrics_every = 10
        self.strategy = make_strategy(self.config, vars(self.strategy), self.gauss_params)
        self.strategy_state = self.strategy.initialize_state(scene_scale=self.scene_scale)
        if self.config.rasterizer in ("auto", "cpu") and not torch.cuda.is_available():
            from ssa_nerfstudio.rasterization.cpu import compile_kernels

            compile_kernels()

    @property
    def overlay(self) -> ArtifactControls | None:
        """The viewer's elements, under the name of their folder; None without an overlay."""
        return self._controls if len(self.artifacts) else None

    def set_scene_extent(self, extent: float) -> None:
        """Set the radius of the cameras' positions (world units), used by `scale_by_extent`."""
        if self.config.scale_by_extent:
            self.scene_scale = extent
            self.strategy_state = self.strategy.initialize_state(scene_scale=extent)

    def set_budget(self, gaussians: int) -> None:
        """Set MCMC's largest number of Gaussians; ADC has none."""
        if isinstance(self.strategy, MarkovChainMonteCarlo):
            self.strategy.cap_max = gaussians

    def k_nearest_sklearn(self, x: Tensor, k: int):
        """Distances to, and indices of, the k nearest neighbors of points [N, 3]; of fewer where N is too small.

        The same distances as upstream's by scikit-learn, whose import takes a second.
        """
        points = x.cpu().numpy()
        distances, indices = KDTree(points).query(points, range(1, min(k + 1, len(points)) + 1))  # pyright: ignore
        return distances[:, 1:].astype("float32"), indices[:, 1:].astype("float32")  # pyright: ignore

    def examine(self, datamanager: SSADatamanager) -> None:
        """Called with photos and cameras before the optimizers are built; for a subclass that needs them."""

    def set_near_plane(self, nearest: float | None) -> None:
        """Set what cameras do not draw by the depth of the nearest seed points (world units; None: unknown).

        A training that goes on from a checkpoint keeps what was set; whoever only renders takes the checkpoint's.
        """
        self._near_plane = max(NEAR_PLANE, self.config.clearance * (nearest or 0.0))
        self.near_plane.fill_(self._near_plane)
        self._near_plane_is_set = True

    def start_outside_cameras(self, positions: Tensor) -> None:
        """Drop seed points inside a camera at positions [V, 3]; call it before the optimizers are built."""
        outside = seed_points.outside_cameras(self.means.data, positions)
        if self.config.guards and not outside.all():
            for name, values in self.gauss_params.items():
                self.gauss_params[name] = Parameter(values.data[outside])

    def step_post_backward(self, step: int) -> None:
        """After the optimizers' step: clamp parameters, then densify."""
        if self.config.guards and step % nonfinite.CLAMP_EVERY == 0:
            nonfinite.clamp_scales(self.scales)
            for overlay in self.artifacts.learned():
                overlay.clamp_logits()
        self.project_photos()
        super().step_post_backward(step)

    def end_training(self, step: int) -> None:
        """After the last step: the scene gets the brightness of the photos' clearest pixels, and its backdrop.

        The former not where some photos have no overlay, which fix the brightness, nor where something else stands
        between the scene and a photo, as exposure or a bilateral grid does.
        """
        alone = self.exposure is None and not self.config.use_bilateral_grid
        learned = self.artifacts.learned()
        if self.config.overlay_film != "kept" and alone and learned and not len(self.artifacts.bare_keys):
            clear_the_clearest(learned, self.features_dc.data, self.features_rest.data)
        if len(self.artifacts.backdrop):
            backdrop = Seeds.of_table(self.artifacts.backdrop)
            opacity = seed_points.BACKDROP_OPACITY
            seed_points.add_seeds(backdrop, self.gauss_params, self.config.sh_degree, opacity, self.optimizers)
            self.artifacts.backdrop = self.artifacts.backdrop[:0]  # a training that goes on has them already

    def load_state_dict(self, dict: dict[str, Any], **kwargs):  # type: ignore[override]
        """Load a checkpoint of any number of Gaussians, and its overlays.

        Parameter objects are kept, because the optimizers hold them already. (splatfacto replaces them,
        splatfacto.py:392, and a resumed run then trains nothing.)
        """
        self.step = 30000
        n = dict["gauss_params.means"].shape[0]
        for parameter in self.gauss_params.values():
            parameter.data = parameter.data.new_zeros((n, *parameter.shape[1:]))
        self.artifacts.allocate(dict, "artifacts.", wanted=not self.training or self.config.overlay != "off")
        fit_checkpoint(self.exposure, dict, "exposure.")
        for name in [name for name in dict if self.shading is None and name.startswith("shading.")]:
            del dict[name]  # what is only rendered has the mean light
        if self.training and self._near_plane_is_set:  # a resumed run has its own clearance
            dict["near_plane"] = self.near_plane
        dict.setdefault("near_plane", torch.tensor(NEAR_PLANE))  # checkpoints from before it was stored
        dict["by_mcmc"] = self.by_mcmc
        loaded = super(SplatfactoModel, self).load_state_dict(dict, **kwargs)
        self._near_plane = float(self.near_plane)
        return loaded

    def get_param_groups(self) -> dict[str, list[Parameter]]:
        """splatfacto's groups, and `overlay`, `exposure` and `shading` where they are learned."""
        own = {"overlay": self.artifacts, "exposure": self.exposure, "shading": self.shading}
        parameters = {name: list(module.parameters()) for name, module in own.items() if module is not None}
        return super().get_param_groups() | {name: learned for name, learned in parameters.items() if learned}

    def get_outputs(self, camera: Cameras) -> dict[str, Tensor | None]:
        """Render one camera.

        Returns:
            rgb [H, W, 3]: the clean scene; accumulation [H, W, 1]; depth [H, W, 1] (not while training);
            background [3], outside training [H, W, 3]; and with an overlay: composite [H, W, 3], the prediction of the
            photo, overlay_rgb [H, W, 3] and overlay_alpha [H, W, 1].
        """
        reduction = self._get_downscale_factor()
        width, height = frame(camera)
        drawn = self._render(camera, width // reduction, height // reduction, reduction)
        if is_viewer_frame():
            return self._controls.outputs(drawn, camera, width, height) if len(self.artifacts) else drawn
        if self.training:
            view = metadata(camera).get("cam_idx")
            return {**drawn, "view": view} if "render" in drawn else self._with_photo(drawn, view)
        if len(self.artifacts):
            layers = self.artifacts.layers_of_camera(camera, width, height)
            if layers is None:  # one camera of several: a mean over all needs its composite, too
                return drawn | {"composite": drawn["rgb"]}
            shown = composite(drawn["rgb"], *layers)
            drawn["composite"] = clip_straight_through(shown) if self.artifacts.exceed_white else shown
            drawn["overlay_rgb"], drawn["overlay_alpha"] = straight_color(*layers)
        return drawn

    def _render(self, camera: Cameras, width: int, height: int, reduction: int) -> dict[str, Any]:
        """The clean scene at 1 / reduction of the camera's frame."""
        gaussians = dict(self.gauss_params)
        if self.crop_box is not None and not self.training:
            inside = self.crop_box.within(self.means).squeeze()
            if not inside.any():
                return self.get_empty_outputs(width, height, self.background_color.to(self.device))
            gaussians = {name: values[inside] for name, values in gaussians.items()}
        sh_degree = None
        if self.config.sh_degree > 0:
            sh_degree = min(self.step // self.config.sh_degree_interval, self.config.sh_degree)
        with_depth = self.config.output_depth_during_training or not self.training
        recorded = self._losses_are_recorded(with_depth)
        render = (self._draw.learned if recorded else self._draw)(
            gaussians,
            self._view_matrix(camera),
            intrinsics(camera, reduction),
            width,
            height,
            near_plane=self._near_plane,
            sh_degree=sh_degree,
            render_mode="RGB+ED" if with_depth else "RGB",
            absgrad=self.strategy.absgrad,
            rasterize_mode=self.config.rasterize_mode,
        )
        image, alpha, self.info = render[:3]
        if self.training:
            self.strategy.step_pre_backward(
                self.gauss_params, self.optimizers, self.strategy_state, self.step, self.info
            )
        background = self._get_background_color()
        if recorded:
            return {"render": render, "background": background}
        # squeeze, because the gradient of an index or a slice fills a frame with zeros first
        accumulation, color = alpha.squeeze(0), image.squeeze(0)
        if with_depth:
            color = color[..., :3]
        white = BRIGHTEST if self.training and self.exposure is not None else 1.0
        rgb = clean_image(color, accumulation, background, white)
        if self.config.use_bilateral_grid and self.training:
            rgb = self._apply_bilateral_grid(rgb[None], metadata(camera)["cam_idx"], height, width)[0]
        depth = None
        if with_depth:
            depth = torch.where(accumulation > 0, image[0, ..., 3:], image[..., 3].detach().max())
        return {
            "rgb": rgb,
            "depth": depth,
            "accumulation": accumulation,
            "background": background if self.training else background.expand(height, width, 3),
        }

    def _view_matrix(self, camera: Cameras) -> Tensor:
        """World to camera [1, 4, 4], with the camera optimizer's correction while training."""
        if not self.training:
            return view_matrix(camera.camera_to_worlds)
        prepared = metadata(camera).get("viewmat")
        if self.camera_optimizer.config.mode == "off" and prepared is not None:
            return prepared
        return view_matrix(self.camera_optimizer.apply_to_camera(camera))

    def get_loss_dict(self, outputs: dict, batch: dict, metrics_dict: dict | None = None) -> dict[str, Tensor]:
        """The paper's loss: photometric on the composite, sparsity of the matte, and the strategy's own terms."""
        recorded = "render" in outputs
        losses = self._recorded_losses(outputs, batch) if recorded else self._photo_losses(outputs, batch)
        if not self.training:
            return losses
        losses |= regularizers(self.config, self.scales, self.opacities, self.step, by_hand=recorded)
        self.camera_optimizer.get_loss_dict(losses)
        if self.config.use_bilateral_grid:
            losses["tv_loss"] = 10 * total_variation_loss(self.bil_grids.grids)
        return losses

    def get_metrics_dict(self, outputs: dict, batch: dict) -> dict[str, Any]:
        """PSNR of the clean render and of the composite against the photo, and the number of Gaussians.

        During training only at the steps that are logged.
        """
        if self.training and self.step % self.metrics_every:
            return {}
        target = self.target(outputs, batch)
        values = {"gaussian_count": self.num_points, **step_metrics(outputs, target, self.artifacts)}
        self.camera_optimizer.get_metrics_dict(values)
        return values

    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Tensor]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Compare the clean render with a test photo: psnr (dB), ssim ("valid" padding), flip, mean color deviation.

        `composite_psnr` is the composite's: read it where test photos carry the artifact. `cc_psnr`: `view_metrics`.
        """
        target = self.target(outputs, batch)
        return view_metrics(outputs, target), view_images(outputs, target)

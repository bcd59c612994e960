"""The losses of a training view that depend on its photo or on the overlays; one CUDA graph on CUDA."""

from __future__ import annotations

from typing import Any

import torch
from nerfstudio.models.splatfacto import SplatfactoModel
from torch import Tensor

from ssa_nerfstudio._system.cuda_graphs import CapturedPrograms, RecordedCalls, graphs_are_usable
from ssa_nerfstudio._system.parameter_replacement import parameters_replaced
from ssa_nerfstudio.overlay.layer import ScreenSpaceOverlay
from ssa_nerfstudio.overlay.photometric import photometric_loss
from ssa_nerfstudio.overlay.resampling import box_reduce
from ssa_nerfstudio.overlay.sparsity import sparsity_loss, sparsity_weight
from ssa_nerfstudio.plugin.artifacts import Artifacts
from ssa_nerfstudio.plugin.exposure import Exposure
from ssa_nerfstudio.plugin.photo_formation import clean_image, predicted_photo
from ssa_nerfstudio.plugin.photo_shading import Shading
from ssa_nerfstudio.plugin.settings import ModelSettings
from ssa_nerfstudio.plugin.splat_rendering import LearnedRender


class PhotoLosses(SplatfactoModel):
    """splatfacto with the prediction of a photo, and its comparison with the photo."""

    config: ModelSettings
    artifacts: Artifacts
    exposure: Exposure | None
    shading: Shading | None
    recordable: bool = True
    """Whether nothing but `_photo_losses` reads the pictures of a training step, so that they need not be there, and
    the sum of the losses is what is minimized, not a multiple of it."""

    def populate_modules(self) -> None:
        """Build splatfacto's modules and what belongs to single photos, and nothing that is recorded yet."""
        super().populate_modules()
        self.exposure = Exposure(self.num_train_data) if self.config.exposure == "affine" else None
        self.shading = None
        self._recorded = RecordedCalls(CapturedPrograms, of_sum=True)

    def project_photos(self) -> None:
        """Let the photos' exposures, and the light on each overlay, have the identity as their mean."""
        for own in (self.exposure, self.shading):
            if own is not None:
                own.project()

    def get_gt_img(self, image: Tensor) -> Tensor:
        """Convert a photo to [0, 1], in one pass over uint8 instead of two.

        Upstream's result, to the last bit where it is not reduced.
        """
        return super().get_gt_img(torch.div(image, 255.0) if image.dtype == torch.uint8 else image)

    def _downscale_if_required(self, image: Tensor) -> Tensor:
        """An image [H, W, C], averaged over blocks as upstream's: in full precision, and without loading cuDNN."""
        reduction = self._get_downscale_factor()
        return image if reduction == 1 else box_reduce(image.float(), reduction)

    def target(self, outputs: dict[str, Tensor], batch: dict[str, Tensor]) -> Tensor:
        """The photo [H, W, 3] in [0, 1], composited over the render's background where it is transparent."""
        return self.composite_with_background(self.get_gt_img(batch["image"]), outputs["background"])

    def _photo_losses(self, outputs: dict, batch: dict) -> dict[str, Tensor]:
        """The terms that depend on the photo or the overlays alone."""
        target = self.target(outputs, batch)
        shown = outputs.get("composite", outputs["rgb"]) if self.training else outputs["rgb"]
        mask = self.loss_mask(shown, target, batch)
        if mask is not None:
            target, shown = target * mask, shown * mask
        losses = {"main_loss": photometric_loss(shown, target, self.config.ssim_lambda)}
        if self._sparsity_counts():
            learned = self.artifacts.learned()  # all overlays, or none
            # Of all overlays at every step, each as often as its photos are shown.
            pairs = zip(learned, self.artifacts.photo_shares, strict=True)
            terms = [self._sparsity(overlay, share) for overlay, share in pairs]
            losses["sparsity"] = torch.stack(terms).sum() if terms[1:] else terms[0]
        return losses

    def _recorded_losses(self, drawn: dict[str, Any], batch: dict) -> dict[str, Tensor]:
        """`_photo_losses` of a view of which only the splats were drawn, as one CUDA graph; draws the rest, too.

        What is learned has its gradient from these losses afterwards, and they have no history.
        """
        render: LearnedRender = drawn.pop("render")
        photo = {name: batch[name].to(self.device) for name in ("image", "mask") if name in batch}
        view = drawn["view"] if len(self.artifacts) else None
        coefficients = None if view is None or self.shading is None else self.shading.of_view(view)
        own = [] if coefficients is None else [coefficients.detach().requires_grad_()]

        def compute(image: Tensor, alpha: Tensor, background: Tensor, *others: Tensor) -> tuple[Tensor, ...]:
            color, accumulation = image.squeeze(0), alpha.squeeze(0)
            rgb = clean_image(color, accumulation, background, 1.0)
            shown = {"rgb": rgb, "accumulation": accumulation, "background": background}
            with parameters_replaced(self.artifacts, others[len(photo) + len(own) :]):
                shown = self._with_photo(shown, drawn["view"], others[len(photo)] if own else None)
                losses = self._photo_losses(shown, dict(zip(photo, others)))  # noqa: B905
            pictures = (shown[name].detach() for name in ("rgb", "composite") if name in shown)
            return *losses.values(), *pictures

        kind = None if view is None else self.artifacts.group_of_view(view), tuple(photo)
        parameters, reduction = list(self.artifacts.parameters()), self._get_downscale_factor()
        given = [render.image, render.alpha, drawn["background"], *photo.values(), *own]
        evaluated = self._recorded(compute, given, parameters, kind, reduction)
        of_image, of_alpha, *_, last = evaluated.backpropagate()
        render.backpropagate(of_image, of_alpha)
        if self.shading is not None and view is not None and own and last is not None:
            self.shading.add_gradient(view, last)
        names = ["main_loss", *["sparsity"] * self._sparsity_counts(), "rgb", "composite"]
        found = dict(zip(names, evaluated.values))  # noqa: B905 - there may be no composite
        drawn.update({name: found.pop(name) for name in names[-2:] if name in found})
        return found

    def _sparsity(self, overlay: ScreenSpaceOverlay, share: float) -> Tensor:
        stated = self.config.sparsity_weight
        weight = sparsity_weight(overlay.noise.squeeze()) if stated is None else stated
        loss = weight * sparsity_loss(overlay.opacity(), overlay.evidence, self.config.sparsity)
        return loss if share == 1 else share * loss

    def _sparsity_counts(self) -> bool:
        return self.training and self.config.sparsity != "off" and bool(self.artifacts.learned())

    def loss_mask(self, shown: Tensor, target: Tensor, batch: dict) -> Tensor | None:
        """Weight [H, W, 1] of every pixel in the photometric loss: the dataset's mask, None where there is none."""
        return self._downscale_if_required(batch["mask"].float()).to(self.device) if "mask" in batch else None

    def _with_photo(
        self, drawn: dict[str, Any], view: int | None, coefficients: Tensor | None = None
    ) -> dict[str, Any]:
        """What is drawn for a training view, and `composite` where the photo is predicted as another image.

        Args:
            drawn: the model's outputs.
            view: the training view; None: the camera is none.
            coefficients: of the photo's shading, where it is learned; None: the model's.
        """
        reduction, light = self._get_downscale_factor(), None
        if self.shading is not None and view is not None:
            own, overlay = coefficients, self.artifacts.of_view(view)
            own = self.shading.of_view(view) if own is None else own
            if own is not None and isinstance(overlay, ScreenSpaceOverlay):
                light = self.shading.light(view, own, overlay, reduction)
        ignored = self.config.ignore_background
        photo = predicted_photo(drawn, self.artifacts, self.exposure, view, reduction, ignored, light)
        return drawn if photo is None else {**drawn, "composite": photo}

    def _losses_are_recorded(self, with_depth: bool) -> bool:
        """Whether this step computes from the render to the loss in one launch."""
        return self._can_be_recorded(with_depth) and self.device.type == "cuda" and graphs_are_usable()

    def _can_be_recorded(self, with_depth: bool) -> bool:
        """Whether the losses read no parameter of the view but their inputs, and nothing else the pictures."""
        of_views = self.config.use_bilateral_grid or self.exposure is not None
        return self.training and self.recordable and torch.is_grad_enabled() and not (with_depth or of_views)

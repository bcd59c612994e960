"""Settings of the model: what `--pipeline.model.` takes in addition to splatfacto's own."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from nerfstudio.models.splatfacto import SplatfactoModelConfig

from ssa_nerfstudio.overlay.sparsity import Sparsity
from ssa_nerfstudio.rasterization import RasterizerName


@dataclass
class ModelSettings(SplatfactoModelConfig):
    """splatfacto's settings and ours; `model.SSASplatfactoModelConfig` adds the class that they configure."""

    overlay: Literal["auto", "on", "off", "given"] = "auto"
    """auto: learn an overlay for each camera whose photos have a static artifact, and none otherwise; on: learn one for
    every camera; off: plain splatfacto; given: use the oracle overlay in overlay_given."""
    overlay_given: Path | None = None
    """For overlay "given": an .npz file with arrays T and B [H, W, 3] of I = clip(T C + B), in the undistorted frame
    (of a rig: T0, B0, T1, B1, ... in the order of its camera groups)."""
    overlay_start: Literal["detected", "statistics", "constant"] = "detected"
    """Initialization. statistics: W = mean of the photos, A = exp(-sigma / 0.05) (paper); detected: the same where
    the artifact is opaque, elsewhere the estimate from static edges; constant: W = 0.5, A = 0.1 (paper's ablation)."""
    overlay_light: Literal["auto", "on", "off"] = "auto"
    """Additive light (rain, glare), I = (1 - A) C + W: auto decides from the photos where overlay_start is detected;
    off is the paper's I = (1 - A) C + A W."""
    scene_head_start: int = 4_000
    """Steps in which only pixels near static edges of the overlay are learned, where overlay_start is detected."""
    overlay_downscale: Literal[1, 2, 4] = 1
    """Side of the block of photo pixels per overlay pixel: 1, 1/2 or 1/4 of the photos' resolution."""
    sparsity: Sparsity = "log"
    """Sparsity term of the matte: log (concave, weighted by evidence), l1 (the paper's), off."""
    sparsity_weight: float = 0.02
    """Weight of the sparsity term, lambda_sparse, not negative; the paper has 0.05, and 0.01 for mud."""
    ignore_background: bool = True
    """Take the matte's gradient as if the overlay's color were the background, so that hiding background that no
    splat covers (a sky without points) is not rewarded; False: plain compositing, as in the paper."""
    strategy: Literal["adc", "mcmc"] = "adc"
    """Densification: adc (adaptive density control, splatfacto's) or mcmc (fixed budget, cap_max)."""
    cap_max: int = 1_000_000
    """MCMC: the largest number of Gaussians."""
    mcmc_stop_at: int = 25_000
    """MCMC: step after which Gaussians are no longer added or relocated."""
    mcmc_opacity_start: float = 0.5
    """MCMC: opacity of the initial Gaussians, in (0, 1)."""
    mcmc_scale_start: float = 0.1
    """MCMC: scale of the initial Gaussians relative to the distance of their neighbors."""
    mcmc_opacity_regularizer: float = 0.01
    """MCMC: weight of the mean opacity in the loss, which frees Gaussians for relocation."""
    mcmc_scale_regularizer: float = 0.01
    """MCMC: weight of the mean scale (world units) in the loss."""
    scale_by_extent: bool = False
    """ADC: measure split and prune sizes, and the means' learning rate, in units of the cameras' extent (3DGS, the
    paper) instead of the normalized scene (splatfacto)."""
    pause_after_reset: int | None = None
    """ADC: steps without refinement after an opacity reset; None: one a photo and a refinement's (splatfacto)."""
    guards: bool = True
    """Skip steps whose loss or gradients are not finite, clamp scales of Gaussians to [1e-8, 1e4] world units and the
    learned matte to [6e-6, 0.999], revive a scene in which all Gaussians are dead, drop seed points inside a camera.
    (A checkpoint with values that are not finite is refused in any case.)"""
    max_skipped_steps: int = 100
    """Guards: number of skipped steps in a row that ends the training, checked every 100 steps."""
    rasterizer: RasterizerName = "auto"
    """auto: gsplat on CUDA, the numba splatter on a CPU; reference: plain torch, slow."""

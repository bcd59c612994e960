"""Settings of the model: what `--pipeline.model.` takes in addition to splatfacto's own."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

from nerfstudio.models.splatfacto import SplatfactoModelConfig

from ssa_nerfstudio.overlay.shading import ShadingSetting
from ssa_nerfstudio.overlay.sparsity import Sparsity
from ssa_nerfstudio.rasterization import RasterizerName


@dataclass
class ModelSettings(SplatfactoModelConfig):
    """splatfacto's settings and ours; `model.SSASplatfactoModelConfig` adds the class that they configure."""

    own_steps: ClassVar[tuple[str, ...]] = ()
    """Settings of a subclass that count steps of a full training, to be scaled with all other schedules."""
    overlay: Literal["auto", "on", "off", "given"] = "auto"
    """auto: learn an overlay for each camera whose photos have a static artifact, and none otherwise; on: learn one for
    every camera; off: plain splatfacto; given: use the oracle overlay in overlay_given."""
    overlay_given: Path | None = None
    """For overlay "given": an .npz file with arrays T and B [H, W, 3] of I = clip(T C + B), in the undistorted frame
    (of a rig: T0, B0, T1, B1, ... in the order of its camera groups)."""
    overlay_start: Literal["points", "statistics", "constant"] = "points"
    """Initialization. points: estimated from the scene's points, as seen in all photos; without points as statistics,
    but only within static edges; statistics: W = mean of the photos, A = exp(-sigma / 0.05) (paper); constant: W = 0.5,
    A = 0.1 (paper's ablation)."""
    overlay_light: Literal["auto", "on", "off"] = "auto"
    """Additive light (rain, glare), I = (1 - A) C + W: auto decides where overlay_start is points, and what hides most
    of the scene there starts with its matte (a dashboard in rain); off is the paper's I = (1 - A) C + A W."""
    overlay_intervals: Literal["auto", "off"] = "auto"
    """auto: where the artifact changes in the order of the photos, learn an overlay for each interval; off: one for all
    photos of a camera."""
    overlay_film: Literal["cleared", "kept"] = "cleared"
    """A film over all of the frame that the training has learned. cleared: after the last step it becomes a part of the
    scene, which so has the brightness of the photos' clearest pixels; kept: as it was learned, as in the paper."""
    overlay_downscale: Literal[1, 2, 4] = 1
    """Side of the block of photo pixels per overlay pixel: 1, 1/2 or 1/4 of the photos' resolution."""
    exposure: Literal["off", "affine"] = "off"
    """affine: learn a gain and an offset per color channel for each photo, whose mean over the photos is the identity:
    for captures whose exposure or white balance varies. off: all photos have one exposure."""
    exposure_place: Literal["auto", "scene", "photo"] = "auto"
    """What exposure acts on. photo: on scene and artifact together, for an artifact on or in front of the lens; scene:
    on the scene alone, for what software drew into the finished photo; auto: as the photos' samples of the scene's
    points say, and photo where they say nothing."""
    shading: ShadingSetting = "auto"
    """affine: learn the light on the artifact in each photo, a tint and a brightness whose logarithm changes linearly
    over it: for a finger, or a part of the camera's rig, that keeps its place in changing light. off: the artifact has
    the same light in all photos. auto: affine where the photos show that it changes, and no exposure is learned."""
    sparsity: Sparsity = "log"
    """Sparsity term of the matte: log (concave, weighted by the initial transmittance), l1 (the paper's), off."""
    sparsity_weight: float | None = None
    """Weight of the sparsity term, lambda_sparse, not negative; None: the photos' noise, at most 0.02; the paper has
    0.05, and 0.01 for mud."""
    ignore_background: bool = True
    """Take the matte's gradient as if the overlay's color were the background, so that hiding background that no
    splat covers (a sky without points) is not rewarded, unless the start says that an artifact hides the scene there:
    while the matte agrees, the scene learns nothing from such pixels. False: plain compositing, as in the paper."""
    ignore_changing: bool = True
    """Where the estimate from points finds an artifact that changes from photo to photo, such as a weapon that sways,
    or an occlusion where `shading` is not off and no exposure is learned, the photos teach the scene nothing; False:
    they do."""
    distant_seeds: bool = True
    """Where an overlay is trained with overlay_start "points", or given: start also from Gaussians far away in
    directions in which structure from motion has found no points, such as a sky, and the photos agree on a color.
    False: without these. Not with random_init."""
    gap_seeds: bool = True
    """Where an overlay is trained with overlay_start "points", or given: start also from Gaussians where photos show no
    points of structure from motion, such as plain walls and roads, at the depth of the points around them; and end with
    a backdrop behind what the artifact hides. False: without these. Not with random_init."""
    strategy: Literal["auto", "adc", "mcmc"] = "auto"
    """Densification. adc: adaptive density control, splatfacto's; mcmc: up to a fixed number of Gaussians, cap_max;
    auto: mcmc where at least 7,000 steps are trained, adc in shorter trainings, where it is mostly ahead; a resumed run
    keeps its own."""
    cap_max: int | None = None
    """MCMC: the largest number of Gaussians; None: one for 150 pixels of the training photos, at most a million;
    seed points are kept in any case."""
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
    clearance: float = 0.5
    """A camera does not draw Gaussians nearer than this share of the depth of the nearest seed points, in [0, 1):
    no surface is there, only floaters that fill the picture of a camera nearby. 0: gsplat's near plane of 0.01.
    A resumed run takes its own value, not the checkpoint's."""
    rasterizer: RasterizerName = "auto"
    """auto: gsplat on CUDA, the numba splatter on a CPU; reference: plain torch, slow."""

"""The constants of gsplat 1.4.0's rasterizer that any other body has to share to draw the same picture.

Source: `gsplat/cuda/csrc/rasterize_to_pixels_fwd.cu` and `gsplat/rendering.py` at version 1.4.0. Pixel centers lie at
+0.5.
"""

EPS2D = 0.3
"""Added to the diagonal of the projected covariance, in square pixels."""
NEAR_PLANE = 0.01
"""Gaussians whose center is nearer than this, in world units along the view axis, are not drawn."""
FAR_PLANE = 1e10
"""Gaussians whose center is farther than this are not drawn."""
TILE = 16
"""Side of a tile in pixels: a Gaussian is drawn in every tile that its three-sigma square touches, and nowhere else."""
ALPHA_MAX = 0.999
"""Largest alpha of one Gaussian at one pixel; its gradient is zero beyond."""
ALPHA_MIN = 1.0 / 255.0
"""A Gaussian with less alpha than this at a pixel is skipped there."""
TRANSMITTANCE_MIN = 1e-4
"""Blending at a pixel stops before the transmittance would fall to this."""

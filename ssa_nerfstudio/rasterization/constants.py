"""The constants of gsplat 1.4.0's rasterizer, which all implementations share to draw the same image.

Source: `gsplat/cuda/csrc/rasterize_to_pixels_fwd.cu` and `gsplat/rendering.py` at version 1.4.0. Pixel centers lie at
+0.5.
"""

EPS2D = 0.3
"""Added to the diagonal of the projected covariance, in square pixels."""
NEAR_PLANE = 0.01
"""Gaussians with centers nearer than this along the view axis, in world units, are not drawn."""
FAR_PLANE = 1e10
"""Gaussians with centers farther than this are not drawn."""
TILE = 16
"""Side of a tile in pixels: a Gaussian is drawn in the tiles that its three-sigma square touches."""
ALPHA_MAX = 0.999
"""Largest alpha of one Gaussian at one pixel; its gradient is zero above."""
ALPHA_MIN = 1.0 / 255.0
"""A Gaussian with less alpha than this at a pixel is skipped there."""
TRANSMITTANCE_MIN = 1e-4
"""Blending at a pixel stops before the transmittance would fall to this."""

"""SSA-Nerfstudio: Gaussian Splatting that learns the scene and the static artifact in front of it together."""

__version__ = "0.1.0"

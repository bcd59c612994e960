"""The differentiable screen-space overlay: parameters, compositing, losses, resampling."""

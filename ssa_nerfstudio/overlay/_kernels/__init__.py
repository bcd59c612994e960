"""The photometric loss with its gradient, for numba (CPU) and Triton (CUDA)."""

"""Lenses and the groups of cameras that share an artifact; plain numpy, no nerfstudio."""

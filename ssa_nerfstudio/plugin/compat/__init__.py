"""Repairs of nerfstudio 1.1.5 and gsplat 1.4.0, one function each."""

"""Image and matte metrics."""

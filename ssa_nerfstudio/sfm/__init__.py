"""Photos and videos to a nerfstudio dataset, robust to a static artifact."""

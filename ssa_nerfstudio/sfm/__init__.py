"""Photos and videos to a nerfstudio dataset, in spite of a static artifact."""

"""From photos or videos to a nerfstudio dataset, by structure from motion that a static artifact does not mislead."""

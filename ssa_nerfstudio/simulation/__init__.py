"""Artifacts put in front of the training photos of a nerfstudio dataset; knows files, but not nerfstudio itself."""

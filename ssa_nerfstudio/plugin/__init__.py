"""The method inside nerfstudio."""

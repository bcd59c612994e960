"""Simulated artifacts in front of a dataset's training photos, and the built-in scene."""

"""Datasets on disk: transforms.json, photos, videos, and files that appear only when they are complete."""

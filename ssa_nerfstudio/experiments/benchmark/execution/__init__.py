"""Executes the runs of a benchmark."""

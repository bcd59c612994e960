"""Simulated artifacts, the demonstration and the benchmark; needs the extra `experiments`."""

"""Locks, child processes and threads: independent of the method and of nerfstudio."""

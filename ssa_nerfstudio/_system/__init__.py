"""Locks, child processes and threads: what is neither the field nor the framework."""

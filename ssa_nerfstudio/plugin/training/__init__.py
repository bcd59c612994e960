"""Trainer, optimizers, densification, schedules and checkpoints."""

"""Other methods on our training path: one module each, to be read beside its paper (docs/baselines.md)."""

"""One module per simulated artifact, imported when a scene names it."""

"""The artifact simulator: one module an effect, loaded only when a scene names it."""

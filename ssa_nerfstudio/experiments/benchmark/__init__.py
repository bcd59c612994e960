"""`ssa bench`, `ssa report` and `ssa tradeoff`."""

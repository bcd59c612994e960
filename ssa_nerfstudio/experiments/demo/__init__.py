"""`ssa demo`: the same model with and without the overlay."""

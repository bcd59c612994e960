"""One training with its evaluation and timing."""

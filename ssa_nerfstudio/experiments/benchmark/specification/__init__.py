"""What a benchmark file states, and the runs that follow from it."""

"""What photos say about a static artifact: statistics, detection, initialization. Plain functions on arrays."""

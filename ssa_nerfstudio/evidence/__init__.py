"""Evidence of a static artifact in photos: statistics, detection, initialization of an overlay."""

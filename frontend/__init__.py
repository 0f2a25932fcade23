"""One robot's raw data to local maps: log readers, motion model, scan matching, particle filter."""

"""Whether the joint map believes false edges, and what share of the true ones it does."""

"""One robot: from scans to a topological map with local metric maps (M1 to M8)."""

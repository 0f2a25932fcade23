"""The joint map: what all edges together say about all vertices."""

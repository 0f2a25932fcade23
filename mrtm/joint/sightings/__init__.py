"""Which sightings between robots to believe, and how the robots' frames lie to each other (M11)."""

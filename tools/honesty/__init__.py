"""Do covariances mean what they say? Runs over simulated buildings, their errors against the truth, tables, figure."""

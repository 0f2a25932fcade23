"""Pairs of local maps whose true relative pose is known, and what aligning them came to."""

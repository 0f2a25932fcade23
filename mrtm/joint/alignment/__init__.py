"""Alignment of overlapping local maps, on line (M13)."""

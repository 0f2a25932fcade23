"""Laser scans as a log other programs read."""

from frontend.writers.carmen import write_carmen

__all__ = ["write_carmen"]

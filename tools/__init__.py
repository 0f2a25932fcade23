"""Tools for people working on the project; not installed."""

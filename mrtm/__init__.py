"""Joint 2D laser maps from a team of robots: topological/metric SLAM with iSAM2."""

__version__ = "0.1.0"

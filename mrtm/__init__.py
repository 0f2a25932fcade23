"""Joint 2D laser maps from a team of robots: topological/metric SLAM with iSAM2."""

__version__ = "0.1.0"

import os

# Open3D brings a TBB of its own into the process, too old for numba, which would complain before it takes OpenMP.
os.environ.setdefault("NUMBA_THREADING_LAYER_PRIORITY", "omp workqueue tbb")
# Threads that wait by spinning take, on a machine with other work, the time of those they wait for.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

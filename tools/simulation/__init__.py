"""A robot with a laser driving through a building: logs whose truth is known.

    plan = office(seed=1)
    log = simulate(plan, "tour", seed=1)
    write_carmen(log, Path("office.clf.gz"))
    write_tum(log.times, log.poses, Path("truth.tum"))

The same arguments give the same log, bit for bit. Units: metres, radians, seconds. A pose is ``x, y, theta``.
"""

from tools.simulation.buildings import BUILDINGS, cluttered, corridor, factory, hall, loop, office
from tools.simulation.driving import Driving
from tools.simulation.laser import LMS200, LMS200_HALF_DEGREE, LaserModel
from tools.simulation.log import SimulatedLog, simulate, stream
from tools.simulation.odometry import PERFECT, OdometryNoise
from tools.simulation.plan import FloorPlan, SimulationError, read_plan, write_plan
from tools.simulation.writers import write_carmen, write_tum

__all__ = [
    "BUILDINGS",
    "LMS200",
    "LMS200_HALF_DEGREE",
    "PERFECT",
    "Driving",
    "FloorPlan",
    "LaserModel",
    "OdometryNoise",
    "SimulatedLog",
    "SimulationError",
    "cluttered",
    "corridor",
    "factory",
    "hall",
    "loop",
    "office",
    "read_plan",
    "simulate",
    "stream",
    "write_carmen",
    "write_plan",
    "write_tum",
]

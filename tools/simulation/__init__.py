"""A robot with a laser driving through a building: logs whose truth is known.

    plan = office(seed=1)
    log = simulate(plan, "tour", seed=1)
    write_carmen(log, Path("office.clf.gz"))
    write_tum(log.times, log.poses, Path("truth.tum"))

and a team of them that see each other:

    team = simulate_team(wings(seed=1), ["red", "blue", "green"], seed=1)
    write_session(team, SightingModel(false_share=0.3), 1, Path("session"))

The same arguments give the same log, bit for bit. Units: metres, radians, seconds. A pose is ``x, y, theta``.
"""

from tools.simulation.buildings import BUILDINGS, cluttered, corridor, factory, hall, loop, office
from tools.simulation.driving import Driving
from tools.simulation.floors import FLOORS, blocks, wings
from tools.simulation.laser import LMS200, LMS200_HALF_DEGREE, LaserModel
from tools.simulation.log import SimulatedLog, simulate, stream
from tools.simulation.odometry import PERFECT, OdometryNoise
from tools.simulation.plan import FloorPlan, SimulationError, read_plan, write_plan
from tools.simulation.session import write_session
from tools.simulation.sightings import SightingModel, SimulatedSighting, false_sightings, true_sightings
from tools.simulation.team import SimulatedTeam, TeamRobot, divided, robot_names, simulate_team
from tools.simulation.writers import write_carmen, write_tum

__all__ = [
    "BUILDINGS",
    "FLOORS",
    "LMS200",
    "LMS200_HALF_DEGREE",
    "PERFECT",
    "Driving",
    "FloorPlan",
    "LaserModel",
    "OdometryNoise",
    "SightingModel",
    "SimulatedLog",
    "SimulatedSighting",
    "SimulatedTeam",
    "SimulationError",
    "TeamRobot",
    "blocks",
    "cluttered",
    "corridor",
    "divided",
    "factory",
    "false_sightings",
    "hall",
    "loop",
    "office",
    "read_plan",
    "robot_names",
    "simulate",
    "simulate_team",
    "stream",
    "true_sightings",
    "wings",
    "write_carmen",
    "write_plan",
    "write_session",
    "write_tum",
]

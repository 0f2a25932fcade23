"""Tiny valid files of every format the project reads: where bad input starts from."""

import bz2
import gzip
import json
import lzma
import math
import struct

from mrtm.config import PRESETS, load_config, to_yaml

BEAMS = 6


def _ranges(step: int) -> list[float]:
    return [2.0 + beam + 0.25 * step for beam in range(BEAMS)]


def _carmen_old() -> bytes:
    rows = [
        "# message_name [message contents] ipc_timestamp ipc_hostname logger_timestamp",
        "PARAM robot_front_laser_max 50 nohost 0",
    ]
    for step in range(8):
        time, pose = 100 + step, f"{0.2 * step:g} 0 {0.1 * step:g}"
        rows.append(f"ODOM {pose} 0.2 0 0 {time}.1 host {step}.1")
        rows.append(f"FLASER {BEAMS} {' '.join(map(str, _ranges(step)))} {pose} {pose} {time}.5 host {step}.5")
    rows.append("SYNC x 108 host 8")
    return "\n".join(rows).encode() + b"\n"


def _carmen_raw() -> bytes:
    rows = ["# CARMEN Logfile", "PARAM robot_frontlaser_offset 0.2 nohost 0"]
    for step in range(6):
        ranges = " ".join(map(str, _ranges(step)))
        rows.append(f"ODOM {0.2 * step:g} 0 0 0.2 0 0 {100 + step}.1 host {step}.1")
        rows.append(f"RAWLASER1 0 -1.5707 3.1415 0.5236 81.9 0.01 0 {BEAMS} {ranges} 0 {100 + step}.5 host {step}.5")
    return "\n".join(rows).encode() + b"\n"


def _carmen_robot() -> bytes:
    rows = ["# CARMEN Logfile"]
    for step in range(6):
        ranges, pose = " ".join(map(str, _ranges(step))), f"{0.2 * step:g} 0 {0.1 * step:g}"
        lit = " ".join(["7"] * BEAMS)
        rows.append(
            f"ROBOTLASER1 0 -1.5707 3.1415 0.5236 81.9 0.01 1 {BEAMS} {ranges} {BEAMS} {lit} {pose} {pose} "
            f"0.2 0 0.5 0.3 1e9 {100 + step}.5 host {step}.5"
        )
        rows.append(f"RLASER {BEAMS} {ranges} {pose} {pose} {100 + step}.5 host {step}.5")
    return "\n".join(rows).encode() + b"\n"


def _player() -> bytes:
    rows = []
    for step in range(8):
        time = f"1075329039.{step}44 robot0 7000"
        beams = " ".join(
            f"{distance:.3f} {-1.571 + 0.6284 * beam:.3f} {int(beam == 2 and step > 3)}"
            for beam, distance in enumerate(_ranges(step))
        )
        rows.append(f"{time} position 01 1075329039.{step}34 +00.{step}00 +00.000 -0.{step}00 +0.000 +0.000 +0.000")
        rows.append(f"{time} laser 00 1075329039.{step}38 {beams}")
        rows.append(f"{time} power 00 1075329039.{step}38 12.3")
    return "\n".join(rows).encode() + b"\n"


def _object(name: str, version: int, fields: bytes, *, closed: bool = True) -> bytes:
    """An object of MRPT's binary archive; a container is left open, its objects follow."""
    return bytes([len(name) | 0x80]) + name.encode() + bytes([version]) + fields + (b"\x88" if closed else b"")


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text)) + text.encode()


def _scan(step: int, time: int) -> bytes:
    pose = _object("CPose3D", 3, struct.pack("<12d", 0.1, 0, 0.3, 1, 0, 0, 0, 1, 0, 0, 0, 1))
    fields = struct.pack("<f?f", math.pi, True, 50.0) + pose
    fields += struct.pack(f"<I{BEAMS}f", BEAMS, *_ranges(step)) + b"\1" * BEAMS
    return _object(
        "CObservation2DRangeScan", 6, fields + struct.pack("<fQf", 0.01, time, 0.0) + _text("LASER") + bytes(8)
    )


def _time(step: int) -> int:
    return 116_444_736_000_000_000 + 10_000_000 * step


def _rawlog() -> bytes:
    """Observations only."""
    objects = []
    for step in range(6):
        pose = _object("CPose2D", 1, struct.pack("<3d", 0.2 * step, 0, 0.1 * step))
        fields = pose + _text("ODO") + struct.pack("<Q??", _time(2 * step + 1), False, False)
        objects.append(_object("CObservationOdometry", 2, fields))
        objects.append(_scan(step, _time(2 * step + 2)))
        objects.append(_object("CObservationComment", 0, _text("nothing")))
    return b"".join(objects)


def _rawlog_frames() -> bytes:
    """Actions and sensory frames."""
    parts = [_object("CRawlog", 1, struct.pack("<I", 8), closed=False)]
    for step in range(4):
        pose = _object("CPose2D", 1, struct.pack("<3d", 0.2, 0, 0.1))
        fields = struct.pack("<i", 0) + pose + bytes(56) + b"\0\0" + struct.pack("<Q", _time(step + 1))
        movement = _object("CActionRobotMovement2D", 7, fields)
        parts += [_object("CActionCollection", 0, struct.pack("<I", 1), closed=False), movement, b"\x88"]
        parts += [
            _object("CSensoryFrame", 2, struct.pack("<I", 1), closed=False),
            _scan(step, _time(step + 1)),
            b"\x88",
        ]
    return b"".join([*parts, b"\x88"])


LOGS: dict[str, list[bytes]] = {
    "CARMEN": [_carmen_old(), _carmen_raw(), _carmen_robot()],
    "Player": [_player()],
    "MRPT rawlog": [_rawlog(), _rawlog_frames()],
}
"""Logs by name of their format. A format without seeds is not fuzzed; a test sees to it that there is none."""

COMPRESSED = (gzip.compress, bz2.compress, lzma.compress)

CONFIGURATIONS = [
    to_yaml(load_config()).encode(),
    to_yaml(load_config(preset=next(iter(PRESETS)))).encode(),
    b"frontend: {particles: 60, motion: {xy_floor: 0.01}}\nseed: 7\n",
    b"topology:\n  projection: dijkstra\n  omega: 5e-1\nfrontend:\n  sigma: .03\n",
]
OPTIONS = [
    b"frontend.particles=60",
    b"seed=7",
    b"topology.projection=joint",
    b"frontend={sigma: 1e-2}",
    b"frontend.motion.xy_floor=.01",
]
SESSIONS = [
    b"# a team\nrobots:\n  red:  {log: input, from: 0, to: 900}\n  blue: {log: input, from: 900, start: 5.5}\n"
    b"sightings: seen.csv\nrelations: true.relations\ntruth: {red: red.tum}\n",
    b'robots:\n  "red":\n    log: ./input\n    to: 1e3\n',
]
SIGHTINGS = [
    b"time,observer,observed,range,bearing,heading,sigma_range,sigma_bearing,sigma_heading\n"
    b"94.0,red,blue,5.7,0.2,-2.1,0.05,0.02,0.05\n\n95.5,blue,red,5.2,-0.8,,.05,2e-2,\n",
    b"observed,observer,time,sigma_heading,sigma_bearing,sigma_range,heading,bearing,range\r\n"
    b' blue , red ,0,0.05,0.02,0.05,-3.1,6.2,"1"\r\n',
]
"""Of the robots red and blue."""

RELATIONS = [
    b"100.1 101.2 0.1 -0.2 0 0 0 1.5\n# comment\n101.2 102.3 1 2 0 0 0 -3.1\n",
    b"".join(b"%d %d 1.5 0.25 0.0 0.0 0.0 0.1\n" % (time, time + 1) for time in range(20)),
]
TRAJECTORIES = [
    b"".join(b"%d.5 0.1 %d 0 0 0 0.6 0.8\n" % (time, time) for time in range(20)),
    b"# t x y z\n1 2 3 0 0 0 0 1\n",
]
RUNS = [
    json.dumps(
        {
            "robots": {"robot": {"component": 0}},
            "components": [[["robot", 0], ["robot", 1]]],
            "vertices": [
                {
                    "id": ["robot", 0],
                    "pose": [0, 0, 0],
                    "covariance": None,
                    "first_scan": {"time": 1.5, "pose": [0, 0, 0]},
                },
                {
                    "id": ["robot", 1],
                    "pose": [1, 2, 0.5],
                    "covariance": [[0.01, 0, 0], [0, 0.01, 0], [0, 0, 0.001]],
                    "first_scan": {"time": 5.5, "pose": [0.1, 0, 0]},
                },
            ],
            "edges": [
                {
                    "tail": ["robot", 0],
                    "head": ["robot", 1],
                    "kind": "loop",
                    "fate": "accepted",
                    "measurement": [1, 2, 0.5],
                    "covariance": [[0.01, 0, 0], [0, 0.01, 0], [0, 0, 0.001]],
                }
            ],
            "team": {
                "first_meeting": 2.5,
                "common_frame": 3.0,
                "meetings": [
                    {
                        "time": 2.5,
                        "robots": ["robot", "other"],
                        "bytes": {"edge": 100, "map": 2000},
                        "verdict": "accepted",
                        "reason": "",
                    }
                ],
            },
        },
        indent=1,
    ).encode()
]
"""``run.json`` of a run whose robot drove the first of ``TRAJECTORIES``."""

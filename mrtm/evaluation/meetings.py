"""What a team's meetings cost and brought."""

from collections import Counter
from dataclasses import dataclass

import numpy as np

from mrtm.evaluation.run_file import TeamEntry
from mrtm.evaluation.statistics import Statistics


@dataclass(frozen=True, slots=True)
class Traffic:
    """Bytes sent, both ways: in all meetings together, and in one."""

    total: int
    per_meeting: Statistics


@dataclass(frozen=True, slots=True)
class Meetings:
    """The meetings of a run.

    Attributes:
        verdicts: number of meetings by verdict.
        first_meeting: team time, seconds; None if nobody met.
        to_common_frame: seconds of team time from the first meeting to a common frame; None if there never was one.
        traffic: of all kinds of records.
        traffic_by_kind: of each, the most first; a meeting in which none was sent counts as 0 bytes.
    """

    verdicts: dict[str, int]
    first_meeting: float | None
    to_common_frame: float | None
    traffic: Traffic
    traffic_by_kind: dict[str, Traffic]


def evaluate_meetings(team: TeamEntry) -> Meetings:
    """Sum up the meetings that a run recorded."""
    meetings, first, common = team["meetings"], team["first_meeting"], team["common_frame"]
    kinds = dict.fromkeys(kind for meeting in meetings for kind in meeting["bytes"])
    by_kind = {kind: _traffic([meeting["bytes"].get(kind, 0) for meeting in meetings]) for kind in kinds}
    return Meetings(
        verdicts=dict(Counter(meeting["verdict"] for meeting in meetings)),
        first_meeting=first,
        to_common_frame=None if first is None or common is None else common - first,
        traffic=_traffic([sum(meeting["bytes"].values()) for meeting in meetings]),
        traffic_by_kind=dict(sorted(by_kind.items(), key=lambda item: -item[1].total)),
    )


def _traffic(sent: list[int]) -> Traffic:
    return Traffic(sum(sent), Statistics.of(np.array(sent, np.float64)))

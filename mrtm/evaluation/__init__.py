"""How good a run is: relations, absolute trajectory error, honesty of covariances, cost of meetings."""

from mrtm.evaluation.ate import AbsoluteErrors, align, evaluate_ate
from mrtm.evaluation.errors import EvaluationError
from mrtm.evaluation.meetings import Meetings, Traffic, evaluate_meetings
from mrtm.evaluation.nees import nees
from mrtm.evaluation.output import Evaluation, Honesty, evaluate_output
from mrtm.evaluation.relations import (
    RelationErrors,
    Relations,
    evaluate_relations,
    read_relations,
    relation_errors,
)
from mrtm.evaluation.statistics import Statistics
from mrtm.evaluation.trajectory import TimedPoses, interpolate, read_tum

__all__ = [
    "AbsoluteErrors",
    "Evaluation",
    "EvaluationError",
    "Honesty",
    "Meetings",
    "RelationErrors",
    "Relations",
    "Statistics",
    "TimedPoses",
    "Traffic",
    "align",
    "evaluate_ate",
    "evaluate_meetings",
    "evaluate_output",
    "evaluate_relations",
    "interpolate",
    "nees",
    "read_relations",
    "read_tum",
    "relation_errors",
]

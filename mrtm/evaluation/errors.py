"""What can be wrong with the files an evaluation reads."""

from mrtm.errors import MrtmError


class EvaluationError(MrtmError):
    """A file that the evaluation needs is missing or malformed."""

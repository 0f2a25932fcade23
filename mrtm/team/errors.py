"""What can be wrong with a team session."""

from mrtm.errors import MrtmError


class SessionError(MrtmError):
    """A session, its sightings or a robot's window that cannot be played: file, place, value and mend, in one line."""

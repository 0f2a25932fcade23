"""The part of a log that a member of a team is played from."""

from collections.abc import Iterator

from frontend.readers import Log
from frontend.records import LaserScan
from mrtm.team.errors import SessionError
from mrtm.team.session_file import Member


def windowed(log: Log, member: Member) -> Iterator[tuple[float, LaserScan]]:
    """Yield (team time, scan) of the scans in the member's window, in the order of the log.

    The window counts from the log's first usable scan: messages without a scan have no time that every format tells.
    Each scan is judged by its own time, wherever it stands: a clock may step back, out of the window and into it, so
    the log is always read to its end. A window from 0 has no lower bound, and a scan in it may have a negative team
    time.

    Args:
        log: ``open_log(member.log)``.
        member: its ``begin`` and ``end``, seconds after the first scan; its ``start``, team time of ``begin``.

    Raises:
        LogError: the log cannot be read or holds no usable scan.
        SessionError: at the end, if no scan lies in the window.
    """
    first: float | None = None
    taken = False
    for scan in log.scans():
        first = scan.time if first is None else first
        since = scan.time - first
        if since < member.end and (since >= member.begin or member.begin == 0.0):
            taken = True
            yield member.start + since - member.begin, scan
    if not taken:
        window = f"from {member.begin:g} to {member.end:g} s"
        found = f"its scans last {log.report.duration:.1f} s"
        raise SessionError(f"{log.path}: no scan for {member.name} {window}: {found}; change from and to")

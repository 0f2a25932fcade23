"""For the server that the processes of a team are forked from, and for nobody else: what it says of those that fail.

A process that is half begun when the run ends finds its pipe closed or its semaphores gone. Nobody wants to know.
"""

import sys
from types import TracebackType

_GONE = EOFError, FileNotFoundError, ConnectionError


def _say(kind: type[BaseException], error: BaseException, where: TracebackType | None) -> None:
    if not issubclass(kind, _GONE):
        sys.__excepthook__(kind, error, where)


sys.excepthook = _say

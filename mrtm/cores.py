"""How many cores the kernels use."""

from collections.abc import Iterator
from contextlib import contextmanager

import numba


def use_cores(count: int) -> None:
    """Let the kernels that this thread calls use so many cores, if they may use as many now.

    By a call, not by ``NUMBA_NUM_THREADS``: numba looks at that again at every compilation and refuses a change.
    """
    numba.set_num_threads(min(count, numba.get_num_threads()))


@contextmanager
def limited_to(cores: int) -> Iterator[None]:
    """``use_cores`` for a while."""
    before = numba.get_num_threads()
    use_cores(cores)
    try:
        yield
    finally:
        numba.set_num_threads(before)

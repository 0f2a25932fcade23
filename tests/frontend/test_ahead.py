"""Reading ahead: the same items in the same order, not too many of them at once, and an end in every case."""

import threading
import time
from collections.abc import Iterator

import pytest

from frontend.ahead import BATCH, BATCHES, ahead


@pytest.mark.parametrize("count", [0, 1, BATCH - 1, BATCH, BATCH + 1, 10 * BATCH * BATCHES])
def test_the_same_in_the_same_order(count: int) -> None:
    assert list(ahead(iter(range(count)))) == list(range(count))
    assert not reading()


@pytest.mark.parametrize("good", [0, 1, BATCH, 3 * BATCH + 5])
def test_an_error_comes_after_what_came_before_it(good: int) -> None:
    def source() -> Iterator[int]:
        yield from range(good)
        raise ValueError("here")

    taken: list[int] = []
    with pytest.raises(ValueError, match="here"):
        taken.extend(ahead(source()))
    assert taken == list(range(good))
    assert not reading()


def test_no_farther_ahead_than_allowed_and_no_thread_left_behind() -> None:
    taken = 0

    def source() -> Iterator[int]:
        nonlocal taken
        while True:
            taken += 1
            yield taken

    items = ahead(source())
    assert next(items) == 1
    until = time.monotonic() + 30.0
    while taken < BATCH * BATCHES and time.monotonic() < until:
        time.sleep(0.001)
    time.sleep(0.02)
    assert taken == BATCH * BATCHES
    assert reading()
    items.close()  # type: ignore[attr-defined]
    assert not reading()


def reading() -> bool:
    return any(thread.name == "reading ahead" for thread in threading.enumerate())

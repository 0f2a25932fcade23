"""Doing the reading while the mapping goes on: decompression and the kernels let go of the interpreter's lock."""

from collections.abc import Iterator
from itertools import islice
from queue import SimpleQueue
from threading import Event, Semaphore, Thread
from typing import TypeVar

T = TypeVar("T")

BATCH = 64  # items handed over together
BATCHES = 4  # at most ahead


def ahead(source: Iterator[T]) -> Iterator[T]:
    """Yield what ``source`` yields, taken from it by a thread that is ``BATCH * BATCHES`` items ahead at most.

    An exception of the source is raised here, after all that came before it. The thread ends with this iterator.
    """
    batches: SimpleQueue[list[T]] = SimpleQueue()
    room, stopped = Semaphore(BATCHES), Event()
    failed: list[BaseException] = []

    def take() -> None:
        while room.acquire() and not stopped.is_set():
            batch: list[T] = []
            try:
                batch.extend(islice(source, BATCH))
            except BaseException as error:
                failed.append(error)
            batches.put(batch)
            if failed or len(batch) < BATCH:
                return

    thread = Thread(target=take, name="reading ahead", daemon=True)
    thread.start()
    try:
        while True:
            batch = batches.get()
            yield from batch
            if len(batch) < BATCH:
                break
            room.release()
        if failed:
            raise failed[0]
    finally:
        stopped.set()
        room.release()
        thread.join()

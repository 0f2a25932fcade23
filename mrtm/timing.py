"""Where the time of a run goes."""

import gc
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field


@dataclass(slots=True)
class Stages:
    """Seconds spent in each stage of a run, and the longest single call."""

    seconds: dict[str, float] = field(default_factory=dict)
    longest: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Count the time of the block as the stage's."""
        started = time.perf_counter()
        try:
            yield
        finally:
            spent = time.perf_counter() - started
            self.seconds[stage] = self.seconds.get(stage, 0.0) + spent
            self.longest[stage] = max(self.longest.get(stage, 0.0), spent)

    def since(self, before: dict[str, float]) -> dict[str, float]:
        """Seconds of each stage since ``seconds`` were as ``before``; stages that have not run are left out."""
        spent = {stage: seconds - before.get(stage, 0.0) for stage, seconds in self.seconds.items()}
        return {stage: seconds for stage, seconds in spent.items() if seconds > 0.0}


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Let Python's garbage collector wait until the block is done: among many records it takes a tenth of a second."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()

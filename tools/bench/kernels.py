"""Counts from outside what numba's kernels do: beam evaluations, endpoints times passes over them.

Python's profiler sees how long a call of a kernel takes, but not how much it did, and calls between kernels never come
back to Python. Here every call from Python into a kernel goes through an observer first.
"""

import inspect
import math
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FunctionType, SimpleNamespace
from typing import Any

import numpy as np
from numba import njit
from numba.core.registry import CPUDispatcher

from frontend import matching

Observer = Callable[[Any, tuple[Any, ...]], None]
_PARAMETERS = list(inspect.signature(matching.match.py_func).parameters)
_TIMES = 100  # a problem is solved in a row, so that calling from Python does not count
_HITS, _START = _PARAMETERS.index("hits"), _PARAMETERS.index("start")


@contextmanager
def observed(observer: Observer) -> Iterator[None]:
    """While the block runs, ``observer`` is shown the kernel and the arguments of every call from Python."""
    plain = super(CPUDispatcher, CPUDispatcher).__call__

    def instead(kernel: Any, *arguments: Any) -> Any:
        observer(kernel, arguments)
        return plain(kernel, *arguments)

    CPUDispatcher.__call__ = instead  # type: ignore[method-assign, assignment]
    try:
        yield
    finally:
        del CPUDispatcher.__call__


class Counter:
    """Observer that counts the beam evaluations of every match that a kernel makes.

    A kernel does not tell how many passes a match took. So every ``every``-th call of a kernel that matches is made
    a second time by its own source in plain Python, where ``match`` is replaced by its source with a count in its loop.

    Attributes:
        kernels: file, line and name of every kernel called, as a profiler tells them.
        matching: of these, those that match.
        problems: some arguments of ``match`` with the passes it took, to measure its speed with.
    """

    def __init__(self, every: int = 50, keep: int = 12) -> None:
        self.kernels: set[tuple[str, int, str]] = set()
        self.matching: set[tuple[str, int, str]] = set()
        self.problems: list[tuple[tuple[Any, ...], int]] = []
        self._calls: defaultdict[str, int] = defaultdict(int)
        self._sampled: defaultdict[str, list[int]] = defaultdict(list)
        self._every, self._keep = every, keep
        self._passes = self._evaluations = 0
        counted = SimpleNamespace(**{**vars(math), "cos": self._cos})
        self._match = _with(matching.match.py_func, math=counted)

    def __call__(self, kernel: Any, arguments: tuple[Any, ...]) -> None:
        code = kernel.py_func.__code__
        place = code.co_filename, code.co_firstlineno, code.co_name
        self.kernels.add(place)
        if kernel is not matching.match and "match" not in code.co_names:
            return
        self.matching.add(place)
        if self._calls[code.co_name] % self._every == 0:
            self._evaluations = 0
            with np.errstate(all="ignore"):
                self._repeat(kernel, arguments)
            self._sampled[code.co_name].append(self._evaluations)
        self._calls[code.co_name] += 1

    @property
    def evaluations(self) -> dict[str, float]:
        """Beam evaluations of each kernel that matches, estimated from the calls repeated."""
        return {name: self._calls[name] * float(np.mean(sample)) for name, sample in self._sampled.items()}

    def _repeat(self, kernel: Any, arguments: tuple[Any, ...]) -> None:
        if kernel is not matching.match:
            _with(kernel.py_func, match=self._counting_match, prange=range)(*_copies(arguments))
            return
        self._counting_match(*_copies(arguments))
        if len(self.problems) < self._keep:
            kept = tuple(a.copy() if isinstance(a, np.ndarray) else a for a in arguments)  # maps change later
            self.problems.append((kept, self._passes))

    def _counting_match(self, *arguments: Any) -> Any:
        self._passes = 0
        result = self._match(*arguments)
        self._evaluations += self._passes * len(arguments[_HITS])
        return result

    def _cos(self, angle: float) -> float:
        self._passes += 1  # match takes one cosine a pass
        return math.cos(angle)


def nanoseconds_per_evaluation(problems: list[tuple[tuple[Any, ...], int]], seconds: float = 1.0) -> float:
    """What one beam evaluation costs one core when nothing is in the way: the problems solved over and over."""
    for problem, _ in problems[:1]:
        _solve(1, problem[_START].copy(), problem[_START].copy(), *problem)  # compiles
    evaluations, spent = 0, 0.0
    while spent < seconds:
        for problem, passes in problems:
            arguments = list(problem)
            arguments[_START] = problem[_START].copy()
            began = time.thread_time()
            _solve(_TIMES, problem[_START], arguments[_START], *arguments)
            spent += time.thread_time() - began
            evaluations += _TIMES * passes * len(problem[_HITS])
    return 1e9 * spent / evaluations


def nanoseconds_per_lookup(problem: tuple[Any, ...], seconds: float = 0.5) -> float:
    """The same for the cheapest question one can ask of an endpoint: whether anything lies in its cell of the map.

    A correlative search around a match's start asks it, and nothing else, of every endpoint at every pose of a lattice.
    """
    log_odds, index, surfels, resolution, hits = problem[:_START]
    side, turns, step = 10, 10, 0.05
    lookups, spent = 0, 0.0
    while spent < seconds:
        peaks, scores = np.empty((8, 3)), np.empty(8)
        began = time.thread_time()
        matching.search(
            log_odds, index, surfels, resolution, hits, problem[_START], side * step, step, turns * step, step,
            np.eye(3), 1, peaks, scores,
        )  # fmt: skip
        spent += time.thread_time() - began
        lookups += (2 * side + 1) ** 2 * (2 * turns + 1) * len(hits)
    return 1e9 * spent / lookups


@njit
def _solve(times, origin, start, *arguments):  # type: ignore[no-untyped-def]
    """Match ``times`` times from ``origin``; ``start`` is the array among the arguments that a match overwrites."""
    for _ in range(times):
        start[:] = origin
        matching.match(*arguments)


def _with(function: Any, **replaced: Any) -> Any:
    """The plain Python function with some of its globals replaced."""
    return FunctionType(function.__code__, {**function.__globals__, **replaced}, function.__name__)


def _copies(arguments: tuple[Any, ...]) -> tuple[Any, ...]:
    """The arguments with copies of the small arrays, which a kernel writes to; maps are only read by a match."""
    return tuple(a.copy() if isinstance(a, np.ndarray) and a.nbytes < 1e6 else a for a in arguments)

"""Is a sample of NEES that of honest covariances, and which component of the error is not what its sigma says?"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from frontend.records import FloatArray
from tools.honesty.runs import Sample

CONFIDENCE = 0.95
BOOTSTRAPS = 2000
CERTAIN = float(chi2.ppf(CONFIDENCE, 3)) / 3.0
"""An honest NEES / 3 is beyond this once in twenty."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """NEES / 3 of a sample.

    Attributes:
        count: size of the sample.
        runs: how many runs it is from.
        mean: 1 if honest, above if over-confident.
        median: 0.79 if honest; unlike the mean it does not hang on a few.
        beyond: fraction beyond the honest 95 %.
        chi2: bounds within which the mean of that many honest and independent ones lies 95 times in a hundred.
        bootstrap: bounds of the mean at 95 %, by drawing whole runs: what is from one run is not independent.
    """

    count: int
    runs: int
    mean: float
    median: float
    beyond: float
    chi2: tuple[float, float]
    bootstrap: tuple[float, float]

    @property
    def is_honest(self) -> bool:
        """Whether the sample is what honest covariances give: 1 within the bounds of the mean."""
        low, high = min(self.bootstrap[0], self.chi2[0] * self.mean), max(self.bootstrap[1], self.chi2[1] * self.mean)
        return low <= 1.0 <= high


def verdict(samples: Sequence[Sample]) -> Verdict | None:
    """Judge a sample; None if it is empty."""
    if not samples:
        return None
    values = np.array([sample.nees for sample in samples])
    run_of = {run: i for i, run in enumerate(dict.fromkeys((s.plan, s.seed) for s in samples))}
    of = np.array([run_of[s.plan, s.seed] for s in samples])
    count = len(values)
    tail = 0.5 * (1.0 - CONFIDENCE)
    honest = honest_mean(count)
    low, high = _bootstrap(values, of, len(run_of), tail)
    return Verdict(
        count=count,
        runs=len(run_of),
        mean=float(values.mean()),
        median=float(np.median(values)),
        beyond=float(np.mean(values > CERTAIN)),
        chi2=honest,
        bootstrap=(low, high),
    )


def honest_mean(count: int) -> tuple[float, float]:
    """Bounds of the mean of ``count`` honest, independent NEES / 3."""
    low, high = chi2.ppf(np.array([1.0 - CONFIDENCE, 1.0 + CONFIDENCE]) / 2.0, 3 * count) / (3 * count)
    return float(low), float(high)


def _bootstrap(values: FloatArray, of: FloatArray, runs: int, tail: float) -> tuple[float, float]:
    random = np.random.default_rng(0)
    sums, sizes = np.bincount(of, values, runs), np.bincount(of, minlength=runs)
    drawn = random.integers(0, runs, size=(BOOTSTRAPS, runs))
    low, high = np.quantile(sums[drawn].sum(axis=1) / sizes[drawn].sum(axis=1), [tail, 1.0 - tail])
    return float(low), float(high)


@dataclass(frozen=True, slots=True)
class Component:
    """One direction of the error.

    Attributes:
        name: x, y, theta in the frame of the child; along, across the plan's x axis; weak, strong: where in the plane
            the covariance is greatest and least.
        error: rms of the error, metres or radians.
        sigma: rms of the standard deviation claimed.
        ratio: rms of error / sigma, each by its own: 1 if honest, above if over-confident.
        bias: mean error, metres or radians.
    """

    name: str
    error: float
    sigma: float
    ratio: float
    bias: float


def components(samples: Sequence[Sample], axis_aligned: bool) -> list[Component]:
    """The error by component.

    Args:
        samples: at least one.
        axis_aligned: the plan is a corridor along its x axis: also tell along and across.
    """
    errors = np.array([sample.error for sample in samples])
    covariances = np.array([sample.covariance for sample in samples])
    headings = np.array([sample.heading for sample in samples])
    eye = np.broadcast_to(np.eye(3), covariances.shape)
    directions = {name: eye[:, i] for i, name in enumerate(("x", "y", "theta"))}
    if axis_aligned:
        c, s, zero = np.cos(headings), np.sin(headings), np.zeros_like(headings)
        directions |= {"along": np.stack([c, -s, zero], axis=1), "across": np.stack([s, c, zero], axis=1)}
    _, vectors = np.linalg.eigh(covariances[:, :2, :2])
    for i, name in ((1, "weak"), (0, "strong")):
        directions[name] = np.column_stack([vectors[:, :, i], np.zeros(len(errors))])
    return [_component(name, d, errors, covariances) for name, d in directions.items()]


def _component(name: str, direction: FloatArray, errors: FloatArray, covariances: FloatArray) -> Component:
    e = np.einsum("ni,ni->n", direction, errors)
    variance = np.einsum("ni,nij,nj->n", direction, covariances, direction)
    return Component(
        name,
        error=float(np.sqrt(np.mean(e**2))),
        sigma=float(np.sqrt(np.mean(variance))),
        ratio=float(np.sqrt(np.mean(e**2 / variance))),
        bias=float(np.mean(e)),
    )

"""The few numbers that describe a sample of errors."""

from dataclasses import dataclass

import numpy as np

from frontend.records import FloatArray


@dataclass(frozen=True, slots=True)
class Statistics:
    """Mean, standard deviation (of the population), median, root mean square and maximum; NaN of an empty sample."""

    mean: float
    std: float
    median: float
    rmse: float
    max: float

    @classmethod
    def of(cls, sample: FloatArray) -> "Statistics":
        """The statistics of a sample (n,)."""
        if len(sample) == 0:
            return cls(*[float("nan")] * 5)
        return cls(
            mean=float(sample.mean()),
            std=float(sample.std()),
            median=float(np.median(sample)),
            rmse=float(np.sqrt((sample**2).mean())),
            max=float(sample.max()),
        )

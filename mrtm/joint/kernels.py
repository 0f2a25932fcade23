"""The robust kernels of a large graph: each is a weight, that of its residual at the estimate.

iSAM2 weighs a kernel where its ends were linearised, so that these would have to be linearised anew wherever a part of
the graph moves, though the factor between them is as linear as any other. In a large graph a factor comes without its
kernel, at a weight of its own (iteratively reweighted least squares: P. Holland, R. Welsch, "Robust regression using
iteratively reweighted least-squares", 1977), and is exchanged when that has changed. Nearly all keep their full weight
and never are.
"""

from collections.abc import Callable, Collection, Mapping
from itertools import chain, islice

import gtsam

from factors import EdgeId, has_kernel, weighed, weight

LOOKED = 32  # kernels whose weight an update looks at
CHANGED = 0.01  # of the full weight: a kernel's weight that is off by less is left


class Kernels:
    """The weights of all factors under a kernel, by edge id."""

    def __init__(self) -> None:
        self._weights: dict[EdgeId, float] = {}  # the next to be looked at first

    def weighed(
        self,
        factors: Mapping[EdgeId, gtsam.NoiseModelFactor],
        exchanged: Collection[EdgeId],
        values: Callable[[list[int]], gtsam.Values],
    ) -> dict[EdgeId, gtsam.NoiseModelFactor]:
        """Factors that come, as they are to be solved: at the weight of the estimate.

        Args:
            exchanged: those that come for others; their weight stays for now.
            values: gives the estimate of some keys.
        """
        found = {}
        for edge_id, factor in factors.items():
            if has_kernel(factor):
                before = self._weights.get(edge_id, 1.0) if edge_id in exchanged else None
                self._weights[edge_id] = weight(factor, values(factor.keys())) if before is None else before
                factor = weighed(factor, self._weights[edge_id])
            else:
                self._weights.pop(edge_id, None)
            found[edge_id] = factor
        return found

    def changed(
        self,
        factors: Mapping[EdgeId, gtsam.NoiseModelFactor],
        values: Callable[[list[int]], gtsam.Values],
    ) -> dict[EdgeId, gtsam.NoiseModelFactor]:
        """Of the next few kernels those whose weight has changed, as they are to be solved from now on.

        Args:
            factors: all, with their kernels.
        """
        looked = list(islice(self._weights, LOOKED))
        ends = [gtsam.KeyVector(factors[edge_id].keys()) for edge_id in looked]
        estimate, found = values(sorted({*chain.from_iterable(ends)})), {}
        for edge_id in looked:
            before, present = self._weights.pop(edge_id), weight(factors[edge_id], estimate)
            if abs(present - before) > CHANGED:
                found[edge_id] = weighed(factors[edge_id], present)
                before = present
            self._weights[edge_id] = before  # to the end of the queue
        return found

    def forget(self, edge_ids: Collection[EdgeId]) -> None:
        """Let factors go."""
        for edge_id in edge_ids:
            self._weights.pop(edge_id, None)

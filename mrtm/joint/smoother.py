"""The solver of the joint graph: iSAM2, always settled at the optimum. No other module touches ISAM2.

Gauss-Newton, not Dogleg: on the M3500 graph, edge by edge, it reaches the same optimum in a quarter of the
time; where it does not settle, Levenberg-Marquardt takes over. Cholesky, until it gives up ("indeterminate"): it does
where informations in a clique differ by more than about 1e7, as corridors can make them (the public Intel pose graph
is such a one). From then on QR, which solves those too and takes up to twice as long.
"""

from collections.abc import Callable, Collection, Mapping
from typing import NamedTuple, TypeVar

import gtsam
import numpy as np
import numpy.typing as npt

from factors import EdgeId, has_kernel
from mrtm.joint.relinearization import portion

FloatArray = npt.NDArray[np.float64]
T = TypeVar("T")


class _Tolerance(NamedTuple):
    """When a variable counts as settled, metres or radians.

    Attributes:
        relinearize: it has moved less than this since it was linearised.
        wildfire: it has moved less than this since those that depend on it were told.
    """

    relinearize: float
    wildfire: float


# The estimate is within about 2e-5 of the optimum.
_EXACT = _Tolerance(1e-4, 1e-5)

# Of a large graph as ``relinearization`` has it; this is for what is done at once, before a kernel weighs a loop.
_COARSE = _Tolerance(3e-3, 1e-3)
_LARGE = 1000  # variables
_PORTION = 100  # variables that one update of a large graph linearises anew, unless it has more new factors itself
_PATIENCE = 5  # updates before the next portion, of those that only add vertices; of others twice as many

_MAX_STEPS = 30
_NEVER = 2**31 - 1  # updates
_NONE = -1  # instead of a key

# Factors in all the eliminations that are kept for further questions, seen from one pose each: about 10 kB a factor.
_KEPT = 1_000

# Standard deviation that stands for "this pose is the reference": nothing against any measurement.
_REFERENCE_SIGMA = 1e-6


class Smoother:
    """Factors by edge id, variables by integer key, one prior.

    Args:
        prior: on the root.
        factors: everything else, by edge id.
        values: a pose for every key.

    Raises:
        RuntimeError: from here and from every method that solves, if GTSAM finds the system indeterminate.
    """

    def __init__(
        self,
        prior: gtsam.PriorFactorPose2,
        factors: Mapping[EdgeId, gtsam.NoiseModelFactor],
        values: gtsam.Values,
    ) -> None:
        self._prior = prior
        self._factors: dict[EdgeId, gtsam.NoiseModelFactor] = {}
        self._factorization = "CHOLESKY"
        self._values: gtsam.Values | None = None
        self._seen_from: dict[int, gtsam.ISAM2] = {}
        self._settled = False  # nothing has moved since all that had moved was linearised anew
        self._waited = 0  # updates since one that linearised a portion anew
        self._behind = False  # whether that left some for the next
        self._start(factors, values)

    def update(
        self,
        add: Mapping[EdgeId, gtsam.NoiseModelFactor],
        values: gtsam.Values,
        remove: Collection[EdgeId],
    ) -> None:
        """Take factors out, put others in, with ``values`` for the new keys, and settle at the optimum.

        The new keys start where the factors that connect them have them.

        An id may be in both: its factor is exchanged. A key that is left without a factor is gone.

        Of a graph of more than a thousand keys the estimate may stay a centimetre from the optimum, and further right
        after a large loop: to linearise anew what that has turned is the work of the next updates (``refine``).
        """
        still = len(add) == values.size() and not remove  # each new key is where its only factor has it
        patience = 0 if self._behind else _PATIENCE
        due = self._waited >= (patience if still else 2 * _PATIENCE)
        self._waited = 0 if due else self._waited + 1
        self._solve(lambda: self._insert(add, values, remove, _PORTION if due else 0))
        if self._tolerance is not _tolerance(self._size):
            self._start(self._factors, self.values())
        if not still and (self._tolerance is _EXACT or len(add) > _PORTION):
            self.settle()

    def settle(self) -> None:
        """Linearise anew until nothing is left to be; of a large graph once all that has moved by 3 mm or 3 mrad."""
        exact = self._tolerance is _EXACT
        for _ in range(_MAX_STEPS if exact else 1):
            if self._settled or self._solve(lambda: self._insert({}, gtsam.Values(), (), None)) == 0:
                self._settled = exact
                return
        if exact:
            self.refine()

    def refine(self) -> None:
        """Levenberg-Marquardt over everything from the present estimate, then iSAM2 anew from there."""
        params = gtsam.LevenbergMarquardtParams()
        params.setRelativeErrorTol(1e-12)
        params.setAbsoluteErrorTol(1e-12)
        params.setLinearSolverType("MULTIFRONTAL_QR")
        graph = self.graph()
        graph.push_back(self._prior)
        values = gtsam.LevenbergMarquardtOptimizer(graph, self.values(), params).optimize()
        self._start(self._factors, values)

    def graph(self) -> gtsam.NonlinearFactorGraph:
        """All factors but the prior."""
        graph = gtsam.NonlinearFactorGraph()
        for factor in self._factors.values():
            graph.push_back(factor)
        return graph

    def values(self) -> gtsam.Values:
        """The present estimate of every key."""
        if self._values is None:
            self._values = self._isam.calculateEstimate()
        return self._values

    def start(self) -> gtsam.Values:
        """A pose of every key near its estimate, to begin anew from; there even if a method has failed."""
        return gtsam.Values(self._isam.getLinearizationPoint())

    def pose(self, key: int) -> gtsam.Pose2:
        """The present estimate of one key."""
        if self._values is None:
            return self._isam.calculateEstimatePose2(key)
        return self._values.atPose2(key)

    def marginal(self, key: int) -> FloatArray:
        """(3, 3) covariance of the pose of ``key``, in its own frame."""
        return _symmetric(self._isam.marginalCovariance(key))

    def covariance_seen_from(self, reference: int, key: int) -> FloatArray:
        """(3, 3) covariance of reference_T_key, in the frame of ``key``, from the joint covariance of both.

        All factors but the prior are relative, so a covariance between two poses does not depend on which pose
        the prior holds. With the prior moved to ``reference`` it is the plain marginal of ``key``: one
        elimination serves all keys, with no difference of large numbers.
        """
        if reference not in self._seen_from:
            graph = self.graph()
            noise = gtsam.noiseModel.Isotropic.Sigma(3, _REFERENCE_SIGMA)
            graph.push_back(gtsam.PriorFactorPose2(reference, self.pose(reference), noise))
            self._seen_from[reference] = gtsam.ISAM2(_parameters(_EXACT, "QR"))
            self._seen_from[reference].update(graph, self.values())
            while len(self._seen_from) > 1 and len(self._seen_from) * len(self._factors) > _KEPT:
                del self._seen_from[next(iter(self._seen_from))]
        return _symmetric(self._seen_from[reference].marginalCovariance(key))

    def relative_covariance(self, reference: int, key: int) -> FloatArray:
        """As ``covariance_seen_from``, from iSAM2's own joint marginal: near the newest keys a hundred times faster.

        As far as iSAM2 has linearised anew, so good to a part in a thousand or so.
        """
        joint = self._isam.jointMarginalCovariance([reference, key])
        carry = -self.pose(key).between(self.pose(reference)).AdjointMap()
        cross = carry @ joint.at(reference, key)
        return _symmetric(carry @ joint.at(reference, reference) @ carry.T + cross + cross.T + joint.at(key, key))

    def _start(self, factors: Mapping[EdgeId, gtsam.NoiseModelFactor], values: gtsam.Values) -> None:
        try:
            self._build(factors, values)
        except RuntimeError:
            self._fall_back()
            self._build(factors, values)

    def _build(self, factors: Mapping[EdgeId, gtsam.NoiseModelFactor], values: gtsam.Values) -> None:
        self._tolerance = _tolerance(values.size())
        self._isam = gtsam.ISAM2(_parameters(self._tolerance, self._factorization))
        prior = gtsam.NonlinearFactorGraph()
        prior.push_back(self._prior)
        root = self._prior.keys()[0]
        first = gtsam.Values()
        first.insert(root, values.atPose2(root))
        self._isam.update(prior, first)
        rest = gtsam.Values(values)
        rest.erase(root)
        self._size = 1
        self._slots: dict[EdgeId, int] = {}
        self._kernels = np.full((64, 2), _NONE)  # the ends of the factors that have one, by slot
        self._insert(dict(factors), rest, (), 0)

    def _solve(self, step: Callable[[], T]) -> T:
        """What ``step`` returns; where Cholesky gives up in it, all is begun anew with QR and it is done again."""
        try:
            return step()
        except RuntimeError:
            self._fall_back()
            values = self.start()
            held = {key for factor in (self._prior, *self._factors.values()) for key in gtsam.KeyVector(factor.keys())}
            for key in {*values.keys()} - held:
                values.erase(key)
            self._build(self._factors, values)
            return step()

    def _fall_back(self) -> None:
        """From Cholesky to QR; if that is what has failed, on with its error."""
        if self._factorization == "QR":
            raise
        self._factorization = "QR"

    def _insert(
        self,
        add: Mapping[EdgeId, gtsam.NoiseModelFactor],
        values: gtsam.Values,
        remove: Collection[EdgeId],
        most: int | None,
    ) -> int:
        """One update of iSAM2; 0 if no variable had to be linearised anew, as at ``most`` of a large graph may be."""
        graph = gtsam.NonlinearFactorGraph()
        for factor in add.values():
            graph.push_back(factor)
        weighed = [factor.keys() for factor in add.values() if has_kernel(factor)]
        change = gtsam.ISAM2UpdateParams()
        change.removeFactorIndices = [self._slots[edge_id] for edge_id in remove]
        self._choose(change, weighed, most)
        if self._tolerance is _COARSE and len(add) == 1:  # at the top of the tree the newest end, and not the old one
            top = gtsam.KeyGroupMap()
            top.insert2(max(next(iter(add.values())).keys()), 1)
            change.constrainedKeys = top
        self._settled = False
        result = self._isam.update(graph, values, change)
        new = dict(zip(add, result.getNewFactorsIndices(), strict=True))
        if (most := max(new.values(), default=0)) >= len(self._kernels):  # doubled: a slot more costs nothing
            self._kernels = np.concatenate([self._kernels, np.full((most + 1, 2), _NONE)])
        for edge_id in remove:
            self._kernels[self._slots.pop(edge_id)] = _NONE
            del self._factors[edge_id]
        for edge_id, slot in new.items():
            self._kernels[slot] = add[edge_id].keys() if has_kernel(add[edge_id]) else _NONE
        self._factors.update(add)
        self._slots.update(new)
        self._size += values.size() - result.getUnusedKeys().size()
        self._values = None
        self._seen_from = {}
        return int(result.getVariablesRelinearized())

    def _choose(self, change: gtsam.ISAM2UpdateParams, weighed: list[list[int]], most: int | None) -> None:
        """Say which variables ``change`` linearises anew: all that have moved; of a large graph ``most`` of them.

        And there always the ends of the kernels that come with it, whose weight is to be that of the estimate.
        """
        change.force_relinearize = self._tolerance is _EXACT or most is None
        if change.force_relinearize or not (most or weighed):
            return
        point = self._isam.getLinearizationPoint()
        names = point.keys()
        keys, moved = np.array(names), self._isam.getDelta().vector(names).reshape(-1, 3)
        chosen = np.isin(keys, weighed)
        if most:
            kernels = np.searchsorted(keys, self._kernels[self._kernels[:, 0] != _NONE])
            rows = portion(lambda: gtsam.utilities.extractPose2(point), moved, kernels, most)
            chosen[rows] = True
            self._behind = len(rows) == most
        if chosen.any():
            change.force_relinearize = True
            left = gtsam.KeyList()
            for key in keys[~chosen & (np.abs(moved).max(axis=1) >= self._tolerance.relinearize)].tolist():
                left.push_back(key)
            change.noRelinKeys = left


def _tolerance(size: int) -> _Tolerance:
    return _COARSE if size > _LARGE else _EXACT


def _parameters(tolerance: _Tolerance, factorization: str) -> gtsam.ISAM2Params:
    gauss_newton = gtsam.ISAM2GaussNewtonParams()
    gauss_newton.setWildfireThreshold(tolerance.wildfire)
    params = gtsam.ISAM2Params()
    params.setOptimizationParams(gauss_newton)
    params.setRelinearizeThreshold(tolerance.relinearize)
    params.setFactorization(factorization)
    params.relinearizeSkip = _NEVER  # but where an update asks for it
    params.findUnusedFactorSlots = True
    return params


def _symmetric(matrix: FloatArray) -> FloatArray:
    return 0.5 * (matrix + matrix.T)

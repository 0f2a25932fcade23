"""The solver of the joint graph: iSAM2, settled at the optimum. No other module touches ISAM2.

Gauss-Newton, not Dogleg: on the M3500 graph, edge by edge, it reaches the same optimum in a quarter of the
time; where it does not settle, Levenberg-Marquardt takes over. Cholesky, until it gives up ("indeterminate"): it does
where informations in a clique differ by more than about 1e7, as corridors can make them (the public Intel pose graph
is such a one). From then on QR, which solves those too and takes up to twice as long.
"""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from typing import NamedTuple, TypeVar

import gtsam
import numpy as np
import numpy.typing as npt

from factors import EdgeId
from mrtm.joint.kernels import Kernels
from mrtm.joint.relinearization import TURN, portion

FloatArray = npt.NDArray[np.float64]
T = TypeVar("T")


class _Tolerance(NamedTuple):
    """When a variable counts as settled.

    Attributes:
        shift, turn: metres and radians; it has moved less than this since it was linearised.
        wildfire: metres or radians; it has moved less than this since those that depend on it were told.
    """

    shift: float
    turn: float
    wildfire: float


# The estimate is within about 2e-5 of the optimum.
_EXACT = _Tolerance(1e-4, 1e-4, 1e-5)

# Of a large graph: its factors are linear in positions, and their kernels do not depend on where they were linearised.
_COARSE = _Tolerance(math.inf, TURN, 3e-4)
_LARGE = 1000  # variables
_PORTION = 50  # variables that one update of a large graph linearises anew, unless it has more new factors itself
_PATIENCE = 3  # updates before the next portion, of those that only add vertices; of others twice as many

# Radians: where nothing has turned so far, lengths are right to 5e-5 of themselves, and one step leads to the optimum.
_FAR = 0.01

_ROUGHLY = 2e-3  # metres and radians: less than what decides about an edge

_MAX_STEPS = 10
_NEVER = 2**31 - 1  # updates

TOGETHER = 64  # pairs of poses whose covariance is found at once


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
        self._waited = 0  # updates since one that linearised a portion anew
        self._behind = False  # whether that left some for the next
        self._start(factors, values)

    def update(
        self,
        add: Mapping[EdgeId, gtsam.NoiseModelFactor],
        values: gtsam.Values,
        remove: Collection[EdgeId],
    ) -> None:
        """Take factors out, put others in, with ``values`` for the new keys, and go one step to the new optimum.

        The new keys start where the factors that connect them have them.

        An id may be in both: its factor is exchanged. A key that is left without a factor is gone.
        """
        still = len(add) == values.size() and not remove  # each new key is where its only factor has it
        due = self._behind or self._waited >= (_PATIENCE if still else 2 * _PATIENCE)
        self._waited = 0 if due else self._waited + 1
        self._solve(lambda: self._insert(add, values, remove, _PORTION if due else 0))
        if self._tolerance is not _tolerance(self._size):
            self._start(self._factors, self.values())
        if self._tolerance is _COARSE and not still and len(add) > _PORTION:
            self.settle()

    def come_to_rest(self) -> None:
        """Go all the way to the optimum.

        Of a graph of more than a thousand keys the estimate may stay a centimetre from it, and further right after a
        large loop: to linearise anew what that has turned is the work of the next updates (``refine``).
        """
        if self._tolerance is _EXACT:
            self.settle()

    def settle(self, roughly: bool = False) -> None:
        """Linearise anew until nothing is left to be; of a large graph once, and if it is needed to go on from here.

        Args:
            roughly: to _ROUGHLY from the optimum.
        """
        if self._tolerance is _COARSE:
            if self._turn().max() > _FAR:
                self._solve(lambda: self._insert({}, gtsam.Values(), (), None))
            return
        left = _ROUGHLY if roughly else self._tolerance.shift
        for _ in range(_MAX_STEPS):
            if np.abs(self._isam.getDelta().vector()).max() < left:
                return
            self._solve(lambda: self._insert({}, gtsam.Values(), (), None))
        self.refine(exactly=False)

    def refine(self, exactly: bool = True) -> None:
        """Levenberg-Marquardt over everything from the present estimate, then iSAM2 anew from there.

        Args:
            exactly: to the last digit; else to about 2e-5 from the optimum, in a third of the time or less.
        """
        tolerance = 1e-12 if exactly else 1e-9
        params = gtsam.LevenbergMarquardtParams()
        params.setRelativeErrorTol(tolerance)
        params.setAbsoluteErrorTol(tolerance)
        with_qr = exactly or self._factorization == "QR"
        params.setLinearSolverType("MULTIFRONTAL_QR" if with_qr else "MULTIFRONTAL_CHOLESKY")
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
        return self._solve(lambda: _symmetric(self._isam.marginalCovariance(key)))

    def relative_covariances(self, pairs: Sequence[tuple[int, int]]) -> list[FloatArray]:
        """(3, 3) covariance of reference_T_key, in the frame of ``key``, for every such pair, which may be the same.

        Of a single pair it comes from iSAM2's own joint marginal: near the newest keys that is a hundred times faster
        than to eliminate all, and good to a part in a thousand or so, as far as iSAM2 has linearised anew. Of several
        it comes from one elimination of the graph for all.
        """
        if len(pairs) == 1 and pairs[0][0] != pairs[0][1]:
            return [self._solve(partial(self._relative_covariance, *pairs[0]))]
        together = (pairs[first : first + TOGETHER] for first in range(0, len(pairs), TOGETHER))
        return [root @ root.T for some in together for root in self._solve(partial(self._roots, some))]

    def _relative_covariance(self, a: int, b: int) -> FloatArray:
        joint, carry = self._isam.jointMarginalCovariance([a, b]), self._carry(a, b)
        cross = carry @ joint.at(a, b)
        return _symmetric(carry @ joint.at(a, a) @ carry.T + cross + cross.T + joint.at(b, b))

    def joint_covariance(self, pairs: Sequence[tuple[int, int]]) -> FloatArray:
        """(3 n, 3 n) ``relative_covariances`` of n pairs, TOGETHER or fewer, with what lies between them."""
        if len(pairs) == 1:
            return self.relative_covariances(pairs)[0]
        roots = self._solve(partial(self._roots, pairs)).reshape(3 * len(pairs), -1)
        return np.asarray(roots @ roots.T)

    def _roots(self, pairs: Sequence[tuple[int, int]]) -> FloatArray:
        """(n, 3, k) A of n pairs: the covariance between the relative poses i and j is A_i A_j'."""
        linear = self._isam.getFactorsUnsafe().linearize(self.values())
        function = [gtsam.EliminateQR] if self._factorization == "QR" else []
        net = linear.marginalMultifrontalBayesNet(sorted({key for pair in pairs for key in pair}), *function)
        rows = {net.at(place).keys()[0]: slice(3 * place, 3 * place + 3) for place in range(net.size())}
        root = np.linalg.inv(net.matrix()[0])
        return np.array([root[rows[b]] + self._carry(a, b) @ root[rows[a]] for a, b in pairs])

    def _carry(self, reference: int, key: int) -> FloatArray:
        """(3, 3) what a step of ``reference`` does to reference_T_key."""
        return np.asarray(-self.pose(key).between(self.pose(reference)).AdjointMap())

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
        self._kernels = Kernels()
        self._insert(dict(factors), rest, (), 0)

    def _solve(self, step: Callable[[], T]) -> T:
        """Do a ``step``; where Cholesky gives up in it, all is begun anew with QR and it is done again."""
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
    ) -> None:
        """One update of iSAM2; all that has moved is linearised anew, of a large graph so many variables at most."""
        coarse = self._tolerance is _COARSE
        again: dict[EdgeId, gtsam.NoiseModelFactor] = {}
        solved = dict(add)
        if coarse:
            if not self._behind and not remove:  # weights are those of an estimate at rest
                again = self._kernels.changed(self._factors, self._isam.calculateEstimate)
            solved = self._kernels.weighed(add, remove, lambda keys: self._estimate_of(keys, values))
        solved = again | solved
        graph = gtsam.NonlinearFactorGraph()
        for factor in solved.values():
            graph.push_back(factor)
        change = gtsam.ISAM2UpdateParams()
        change.removeFactorIndices = [self._slots[edge_id] for edge_id in (*remove, *again)]
        if coarse and most is not None:
            if most:
                self._choose(change, most)
        else:
            change.force_relinearize = True
        if coarse and len(add) == 1:  # at the top of the tree the newest end, and not the old one
            top = gtsam.KeyGroupMap()
            top.insert2(max(next(iter(add.values())).keys()), 1)
            change.constrainedKeys = top
        result = self._isam.update(graph, values, change)
        for edge_id in remove:
            del self._slots[edge_id]
            del self._factors[edge_id]
        self._kernels.forget(set(remove) - add.keys())
        self._factors.update(add)
        self._slots.update(zip(solved, result.getNewFactorsIndices(), strict=True))
        self._size += values.size() - result.getUnusedKeys().size()
        self._values = None

    def _estimate_of(self, keys: list[int], new: gtsam.Values) -> gtsam.Values:
        """The estimate of some keys, or what is given of them if they are new."""
        estimate = self._isam.calculateEstimate([key for key in keys if not new.exists(key)])
        for key in keys:
            if new.exists(key):
                estimate.insert(key, new.atPose2(key))
        return estimate

    def _turn(self) -> FloatArray:
        """(n,) radians that each variable has turned since it was linearised, in the order of keys."""
        keys = self._isam.getLinearizationPoint().keys()
        return np.abs(self._isam.getDelta().vector(keys)[2::3])

    def _choose(self, change: gtsam.ISAM2UpdateParams, most: int) -> None:
        """Say which variables of a large graph ``change`` linearises anew, ``most`` of them."""
        point, turn = self._isam.getLinearizationPoint(), self._turn()
        rows = portion(lambda: gtsam.utilities.extractPose2(point), turn, most)
        change.force_relinearize = len(rows) > 0
        self._behind = len(rows) == most
        if self._behind:
            waiting = turn >= TURN
            waiting[rows] = False
            keys, left = point.keys(), gtsam.KeyList()
            for row in np.flatnonzero(waiting).tolist():
                left.push_back(keys[row])
            change.noRelinKeys = left


def _tolerance(size: int) -> _Tolerance:
    return _COARSE if size > _LARGE else _EXACT


def _parameters(tolerance: _Tolerance, factorization: str) -> gtsam.ISAM2Params:
    gauss_newton = gtsam.ISAM2GaussNewtonParams()
    gauss_newton.setWildfireThreshold(tolerance.wildfire)
    params = gtsam.ISAM2Params()
    params.setOptimizationParams(gauss_newton)
    thresholds = gtsam.ISAM2ThresholdMap()
    thresholds.insert(("\0", np.array([tolerance.shift, tolerance.shift, tolerance.turn])))  # of plain numbers as keys
    params.setRelinearizeThreshold(thresholds)
    params.setFactorization(factorization)
    params.relinearizeSkip = _NEVER  # but where an update asks for it
    params.findUnusedFactorSlots = True
    return params


def _symmetric(matrix: FloatArray) -> FloatArray:
    return 0.5 * (matrix + matrix.T)

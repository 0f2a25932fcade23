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

from factors import EdgeId

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

# To linearise a large graph anew at every loop makes the spikes that users feel. What is left here is of second order
# in what the poses have moved: see ``python -m tools.benchmark --backend``.
_COARSE = _Tolerance(0.03, 1e-3)
_LARGE = 1000  # variables

_MAX_STEPS = 30

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

        Of a graph of more than a thousand keys the estimate may stay a centimetre from the optimum (``refine``).
        """
        self._solve(lambda: self._insert(add, values, remove))
        if self._tolerance is not _tolerance(self._size):
            self._start(self._factors, self.values())
        if len(add) == values.size() and not remove:
            return  # each new key is where its only factor has it: nothing moves
        exact = self._tolerance is _EXACT
        for _ in range(_MAX_STEPS if exact else 1):  # where a second step is due, the next update begins with it
            if self._solve(self._step) == 0:
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
        self._insert(dict(factors), rest, ())

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

    def _step(self) -> int:
        """Linearise anew what has moved, and solve; the number of variables that had."""
        self._values = None
        return int(self._isam.update().getVariablesRelinearized())

    def _insert(
        self,
        add: Mapping[EdgeId, gtsam.NoiseModelFactor],
        values: gtsam.Values,
        remove: Collection[EdgeId],
    ) -> None:
        graph = gtsam.NonlinearFactorGraph()
        for factor in add.values():
            graph.push_back(factor)
        result = self._isam.update(graph, values, [self._slots[edge_id] for edge_id in remove])
        for edge_id in remove:
            del self._factors[edge_id], self._slots[edge_id]
        self._factors.update(add)
        self._slots.update(zip(add, result.getNewFactorsIndices(), strict=True))
        self._size += values.size() - result.getUnusedKeys().size()
        self._values = None
        self._seen_from = {}


def _tolerance(size: int) -> _Tolerance:
    return _COARSE if size > _LARGE else _EXACT


def _parameters(tolerance: _Tolerance, factorization: str) -> gtsam.ISAM2Params:
    gauss_newton = gtsam.ISAM2GaussNewtonParams()
    gauss_newton.setWildfireThreshold(tolerance.wildfire)
    params = gtsam.ISAM2Params()
    params.setOptimizationParams(gauss_newton)
    params.setRelinearizeThreshold(tolerance.relinearize)
    params.setFactorization(factorization)
    params.relinearizeSkip = 1
    params.enablePartialRelinearizationCheck = tolerance is _COARSE
    params.findUnusedFactorSlots = True
    return params


def _symmetric(matrix: FloatArray) -> FloatArray:
    return 0.5 * (matrix + matrix.T)

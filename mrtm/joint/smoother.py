"""The solver of the joint graph: iSAM2, always settled at the optimum. No other module touches ISAM2.

Gauss-Newton, not Dogleg: on the M3500 graph, edge by edge, it reaches the same optimum in a quarter of the
time; where it does not settle, Levenberg-Marquardt takes over. QR, not Cholesky: GTSAM's Cholesky gives up
("indeterminate") where informations in a clique differ by more than about 1e7, as corridors make them; the public
Intel pose graph is such a one. QR costs a third more.
"""

from collections.abc import Collection, Mapping

import gtsam
import numpy as np
import numpy.typing as npt

from factors import EdgeId

FloatArray = npt.NDArray[np.float64]

# Metres or radians below which a variable counts as settled: the estimate is within about 2e-5 of the optimum.
_RELINEARIZE_THRESHOLD = 1e-4
_WILDFIRE_THRESHOLD = 1e-5
_MAX_STEPS = 30

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
        self._values: gtsam.Values | None = None
        self._seen_from: dict[int, gtsam.ISAM2] = {}
        self._start(factors, values)

    @property
    def factors(self) -> Mapping[EdgeId, gtsam.NoiseModelFactor]:
        """The factors that are in."""
        return self._factors

    def update(
        self,
        add: Mapping[EdgeId, gtsam.NoiseModelFactor],
        values: gtsam.Values,
        remove: Collection[EdgeId],
    ) -> None:
        """Take factors out, put others in, with ``values`` for the new keys, and settle at the optimum.

        An id may be in both: its factor is exchanged. A key that is left without a factor is gone.
        """
        self._insert(add, values, remove)
        for _ in range(_MAX_STEPS):
            if self._isam.update().getVariablesRelinearized() == 0:
                return
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
            self._seen_from[reference] = gtsam.ISAM2(_parameters())
            self._seen_from[reference].update(graph, self.values())
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
        self._isam = gtsam.ISAM2(_parameters())
        prior = gtsam.NonlinearFactorGraph()
        prior.push_back(self._prior)
        root = self._prior.keys()[0]
        first = gtsam.Values()
        first.insert(root, values.atPose2(root))
        self._isam.update(prior, first)
        rest = gtsam.Values(values)
        rest.erase(root)
        self._slots: dict[EdgeId, int] = {}
        self._insert(dict(factors), rest, ())

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
        self._values = None
        self._seen_from = {}


def _parameters() -> gtsam.ISAM2Params:
    gauss_newton = gtsam.ISAM2GaussNewtonParams()
    gauss_newton.setWildfireThreshold(_WILDFIRE_THRESHOLD)
    params = gtsam.ISAM2Params()
    params.setOptimizationParams(gauss_newton)
    params.setRelinearizeThreshold(_RELINEARIZE_THRESHOLD)
    params.setFactorization("QR")
    params.relinearizeSkip = 1
    params.findUnusedFactorSlots = True
    return params


def _symmetric(matrix: FloatArray) -> FloatArray:
    return 0.5 * (matrix + matrix.T)

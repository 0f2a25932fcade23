"""The kernels of a large graph, as weights."""

import gtsam
import numpy as np
import pytest

from factors import FULL_WEIGHT, Edge, EdgeId, EdgeKind, VertexId, factor_of, weighed, weight, without_kernel
from mrtm.joint.kernels import LOOKED, Kernels

SIGMA = 0.1


def loop(number: int) -> tuple[EdgeId, gtsam.NoiseModelFactor]:
    """One that says its ends, the variables 0 and 1 + number, are where they are with ``estimate(0.0)``."""
    name = EdgeId("red", number)
    ends = VertexId("red", 0), VertexId("red", 1 + number)
    edge = Edge(name, 0, EdgeKind.LOOP, *ends, gtsam.Pose2(2.0, 0.0, 0.0), SIGMA**2 * np.eye(3))
    return name, factor_of(edge, 0, 1 + number)


def estimate(keys: list[int], off: dict[int, float]) -> gtsam.Values:
    """Standard deviations by which variables are off."""
    values = gtsam.Values()
    for key in keys:
        values.insert(key, gtsam.Pose2(2.0 * (key > 0), SIGMA * off.get(key, 0.0), 0.0))
    return values


@pytest.mark.parametrize("off", [0.0, 2.5, 4.0, 8.0])
def test_a_fixed_weight_pulls_as_the_kernel_does_there(off: float) -> None:
    _, factor = loop(0)
    values = estimate([0, 1], {1: off})
    share = weight(factor, values)
    assert (share == 1.0) == (off**2 <= FULL_WEIGHT[3])
    found, expected = weighed(factor, share).linearize(values), factor.linearize(values)
    np.testing.assert_allclose(found.augmentedInformation(), expected.augmentedInformation(), atol=1e-9)


def test_a_factor_comes_at_the_weight_of_the_estimate_and_keeps_it_when_it_is_exchanged() -> None:
    kernels, (name, factor) = Kernels(), loop(0)
    plain = EdgeId("red", 7)
    come = {name: factor, plain: without_kernel(factor)}
    found = kernels.weighed(come, (), lambda keys: estimate(keys, {1: 5.0}))
    assert found[plain] is come[plain]
    share = weight(factor, estimate([0, 1], {1: 5.0}))
    assert share < 0.5
    assert found[name].equals(weighed(factor, share), 1e-12)
    again = kernels.weighed({name: factor}, [name], lambda keys: estimate(keys, {}))
    assert again[name].equals(weighed(factor, share), 1e-12)
    kernels.forget([name])
    anew = kernels.weighed({name: factor}, [name], lambda keys: estimate(keys, {1: 5.0}))
    assert anew[name].equals(without_kernel(factor), 1e-12)  # it was in without its kernel


def test_kernels_take_turns_and_those_whose_weight_has_changed_are_exchanged() -> None:
    kernels, factors = Kernels(), dict(loop(number) for number in range(2 * LOOKED))
    kernels.weighed(factors, (), lambda keys: estimate(keys, {}))
    off = {1 + 3: 6.0, 1 + 4: 2.5, 1 + LOOKED: 6.0}  # that in the middle still has its full weight
    for changed in (3, LOOKED):
        found = kernels.changed(factors, lambda keys: estimate(keys, off))
        assert [name.number for name in found] == [changed]
        share = weight(factors[EdgeId("red", changed)], estimate([0, 1 + changed], off))
        assert found[EdgeId("red", changed)].equals(weighed(factors[EdgeId("red", changed)], share), 1e-12)
    for _ in range(2):
        assert not kernels.changed(factors, lambda keys: estimate(keys, off))
    assert [name.number for name in kernels.changed(factors, lambda keys: estimate(keys, {}))] == [3]

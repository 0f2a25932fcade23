"""Sparse equations in blocks, against dense ones."""

import numpy as np
import pytest

from mrtm.joint.sightings.block_cholesky import Blocks, factorise, inverse_of, pattern_of, substitute
from mrtm.joint.sightings.hypotheses import FloatArray, IntArray


def graph(n: int, rng: np.random.Generator) -> tuple[FloatArray, Blocks, tuple[IntArray, IntArray]]:
    """A positive definite matrix of a chain with loops, dense and in blocks, and blocks of it that are asked for."""
    i = np.concatenate([np.arange(n - 1), rng.integers(0, n, n // 2)])
    k = np.concatenate([np.arange(1, n), rng.integers(0, n, n // 2)])
    dense = 0.1 * np.eye(3 * n)
    for a, b in zip(i, k, strict=True):
        jacobian = np.zeros((3, 3 * n))
        jacobian[:, 3 * a : 3 * a + 3] = rng.normal(size=(3, 3))
        jacobian[:, 3 * b : 3 * b + 3] = rng.normal(size=(3, 3))
        dense += jacobian.T @ jacobian
    wanted = rng.integers(0, n, n), rng.integers(0, n, n)
    pattern = pattern_of(n, np.concatenate([i, wanted[0]]), np.concatenate([k, wanted[1]]))
    order = np.argsort(pattern.place)
    blocks = dense.reshape(n, 3, n, 3).transpose(0, 2, 1, 3)[np.ix_(order, order)]
    columns = np.repeat(np.arange(n), np.diff(pattern.starts))
    return dense, Blocks(pattern, blocks[np.arange(n), np.arange(n)], blocks[pattern.rows, columns]), wanted


@pytest.mark.parametrize("n", [1, 2, 7, 80])
def test_the_blocks_asked_for_are_those_of_the_inverse(n: int) -> None:
    dense, blocks, (rows, columns) = graph(n, np.random.default_rng(n))
    found = inverse_of(blocks)
    assert found is not None
    whole = np.linalg.inv(dense).reshape(n, 3, n, 3).transpose(0, 2, 1, 3)
    every = np.arange(n)
    for at in ((rows, columns), (columns, rows), (every, every)):
        np.testing.assert_allclose(found.at(*at), whole[at], rtol=0.0, atol=1e-9 * np.abs(whole).max())


def test_what_is_solved_is_the_matrix() -> None:
    rng = np.random.default_rng(3)
    dense, (pattern, diagonal, below), _ = graph(40, rng)
    right = rng.normal(size=(40, 3))
    vector = np.empty_like(right)
    vector[pattern.place] = right
    assert factorise(pattern.starts, pattern.rows, diagonal, below)
    substitute(pattern.starts, pattern.rows, diagonal, below, vector)
    np.testing.assert_allclose(dense @ vector[pattern.place].ravel(), right.ravel(), rtol=0.0, atol=1e-9)


def test_what_is_not_positive_definite_has_no_inverse() -> None:
    pattern = pattern_of(2, np.array([0]), np.array([1]))
    diagonal = np.array([np.eye(3), np.diag([1.0, -1.0, 1.0])])
    assert inverse_of(Blocks(pattern, diagonal, np.zeros((1, 3, 3)))) is None


def test_row_minus_one_is_nowhere() -> None:
    pattern = pattern_of(2, np.array([0, -1]), np.array([-1, 1]))
    assert len(pattern.rows) == 0
    blocks = Blocks(pattern, np.ones((2, 3, 3)), np.zeros((0, 3, 3)))
    assert not blocks.at(np.array([-1, 0, 0]), np.array([1, -1, 1])).any()

"""Blocks of an inverse, against the whole one."""

import numpy as np
import pytest
from scipy.sparse import coo_array, csc_array

from mrtm.joint.sightings.selected_inverse import selected_inverse


def graph_matrix(n: int, rng: np.random.Generator) -> csc_array:
    """(3n, 3n) positive definite, of a chain with loops; entries that occur twice are to be added."""
    i = np.concatenate([np.arange(n - 1), rng.integers(0, n, n // 2)])
    k = np.concatenate([np.arange(1, n), rng.integers(0, n, n // 2)])
    rows, columns, values = [], [], []
    for a, b in zip(i, k, strict=True):
        jacobian = rng.normal(size=(3, 6))
        at = np.concatenate([3 * a + np.arange(3), 3 * b + np.arange(3)])
        rows.append(np.repeat(at, 6))
        columns.append(np.tile(at, 6))
        values.append((jacobian.T @ jacobian).ravel())
    diagonal = np.arange(3 * n)
    ends = np.concatenate([*rows, diagonal]), np.concatenate([*columns, diagonal])
    return coo_array((np.concatenate([*values, np.full(3 * n, 0.1)]), ends), shape=(3 * n, 3 * n)).tocsc()


@pytest.mark.parametrize("n", [2, 7, 80])
def test_the_blocks_asked_for_are_those_of_the_inverse(n: int) -> None:
    rng = np.random.default_rng(n)
    matrix = graph_matrix(n, rng)
    rows, columns = rng.integers(0, n, n), rng.integers(0, n, n)
    found = selected_inverse(matrix, (rows, columns))
    whole = np.linalg.inv(matrix.toarray()).reshape(n, 3, n, 3).transpose(0, 2, 1, 3)
    every = np.arange(n)
    for at in ((rows, columns), (columns, rows), (every, every)):
        np.testing.assert_allclose(found[at], whole[at], rtol=0.0, atol=1e-9 * np.abs(whole).max())


def test_what_is_not_positive_definite_has_no_inverse() -> None:
    found = selected_inverse(csc_array(np.diag([1.0, 1.0, 1.0, 1.0, -1.0, 1.0])), (np.array([0]), np.array([1])))
    assert np.isnan(found).all()

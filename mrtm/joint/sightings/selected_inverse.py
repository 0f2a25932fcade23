"""Some blocks of the inverse of a large sparse matrix, without the rest (Takahashi, Fagan and Chen 1973).

Covariances of some hundred poses are wanted only for pairs of them that a sighting joins. The factors' own sparsity
pattern, with these pairs in it, is enough: the cost is about that of the factorisation, not the cube of the size.
"""

import numpy as np
from numba import njit
from scipy.sparse import coo_array, csc_array
from scipy.sparse.linalg import splu

from mrtm.joint.sightings.hypotheses import BoolArray, FloatArray, IntArray


def selected_inverse(matrix: csc_array, wanted: tuple[IntArray, IntArray]) -> FloatArray:
    """Blocks of the inverse of a symmetric positive definite ``matrix`` (3n, 3n).

    Returns:
        (n, n, 3, 3) right on the diagonal, where ``matrix`` has a block, and at the ``wanted`` rows and columns, both
        ways; elsewhere zero, or right. NaN if the matrix is not positive definite.
    """
    n = matrix.shape[0] // 3
    entries = matrix.tocoo()
    entries.sum_duplicates()
    rows = np.concatenate([entries.row // 3, *wanted, np.arange(n)])
    columns = np.concatenate([entries.col // 3, *wanted[::-1], np.arange(n)])
    place = _order(rows, columns, n)
    pattern = np.zeros((n, n), np.bool_)
    pattern[place[rows], place[columns]] = True
    work = np.zeros((n, n, 3, 3))
    work[place[entries.row // 3], place[entries.col // 3], entries.row % 3, entries.col % 3] = entries.data
    found = np.zeros((n, n, 3, 3))
    _invert(pattern, work, found)
    return np.asarray(found[np.ix_(place, place)])


def _order(rows: IntArray, columns: IntArray, n: int) -> IntArray:
    """(n,) the place of each row in an order of elimination that fills in little."""
    pattern = coo_array((np.ones(len(rows)), (rows, columns)), shape=(n, n)).tocsc()
    pattern.data[:] = -1.0
    pattern.setdiag(n + 1.0)
    options = {"SymmetricMode": True, "DiagPivotThresh": 0.0}
    return np.asarray(splu(pattern.tocsc(), permc_spec="MMD_AT_PLUS_A", options=options).perm_c, dtype=np.int64)


@njit(cache=True)
def _invert(pattern: BoolArray, work: FloatArray, found: FloatArray) -> None:
    n = len(pattern)
    below = np.empty(n, np.int64)
    identity = np.eye(3)
    for j in range(n):  # L D L' in place: below the diagonal L, on it the inverse of D
        count = 0
        for i in range(j + 1, n):
            if pattern[i, j]:
                below[count] = i
                count += 1
        a = work[j, j]
        det = (
            a[0, 0] * (a[1, 1] * a[2, 2] - a[1, 2] * a[2, 1])
            - a[0, 1] * (a[1, 0] * a[2, 2] - a[1, 2] * a[2, 0])
            + a[0, 2] * (a[1, 0] * a[2, 1] - a[1, 1] * a[2, 0])
        )
        if not (det > 0.0 and a[0, 0] > 0.0):
            found[:] = np.nan
            return
        inverse = np.linalg.solve(a, identity)
        work[j, j] = 0.5 * (inverse + inverse.T)
        for p in range(count):
            i = below[p]
            upper = work[i, j].copy()
            _multiply(upper, work[j, j], work[i, j])
            for q in range(p + 1):  # those before have been made L, times D they are what they were
                k = below[q]
                pattern[i, k] = True
                for r in range(3):
                    for c in range(3):
                        total = 0.0
                        for s in range(3):
                            total += upper[r, s] * work[k, j, c, s]
                        work[i, k, r, c] -= total
    for j in range(n - 1, -1, -1):
        count = 0
        for i in range(j + 1, n):
            if pattern[i, j]:
                below[count] = i
                count += 1
        for p in range(count):
            i = below[p]
            for q in range(count):
                k = below[q]
                for r in range(3):
                    for c in range(3):
                        total = 0.0
                        for s in range(3):
                            total += found[i, k, r, s] * work[k, j, s, c]
                        found[i, j, r, c] -= total
            found[j, i] = found[i, j].T
        found[j, j] = work[j, j]
        for p in range(count):
            k = below[p]
            for r in range(3):
                for c in range(3):
                    total = 0.0
                    for s in range(3):
                        total += work[k, j, s, r] * found[k, j, s, c]
                    found[j, j, r, c] -= total


@njit(cache=True)
def _multiply(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    for r in range(3):
        for c in range(3):
            out[r, c] = a[r, 0] * b[0, c] + a[r, 1] * b[1, c] + a[r, 2] * b[2, c]

"""Dense Cholesky of a matrix whose rows begin with zeros, as those of poses along a drive do."""

import math

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, fastmath=True)
def factorise(a):  # type: ignore[no-untyped-def]
    """Cholesky factor in place of the lower triangle; returns the first column of each row that is not zero.

    Not LAPACK's: it knows nothing of the zeros before a row's first entry, and its threads wait for each other.
    """
    n = len(a)
    first = np.empty(n, np.int64)
    for i in range(n):
        f = 0
        while a[i, f] == 0.0:
            f += 1
        first[i] = f
        for j in range(f, i):
            begin = max(f, first[j])
            total = a[i, j]
            for k in range(begin, j):
                total -= a[i, k] * a[j, k]
            a[i, j] = total / a[j, j]
        total = a[i, i]
        for k in range(f, i):
            total -= a[i, k] * a[i, k]
        a[i, i] = math.sqrt(total)
    return first


@njit(cache=True, nogil=True, fastmath=True)
def solve(a, first, right):  # type: ignore[no-untyped-def]
    """The solution of the factorised system, in ``right``."""
    for i in range(len(a)):
        for k in range(first[i], i):
            right[i] -= a[i, k] * right[k]
        right[i] /= a[i, i]
    for i in range(len(a) - 1, -1, -1):
        right[i] /= a[i, i]
        for k in range(first[i], i):
            right[k] -= a[i, k] * right[i]


@njit(cache=True, nogil=True, fastmath=True)
def marginals(a, first, headings):  # type: ignore[no-untyped-def]
    """(m, 3, 3) diagonal blocks of the inverse of the factorised system, each in the frame of its pose."""
    n = len(a)
    blocks = np.zeros((n // 3, 3, 3))
    inverse = np.zeros((n, n))
    for i in range(n):
        row = inverse[i]
        for k in range(first[i], i):
            for j in range(k + 1):
                row[j] -= a[i, k] * inverse[k, j]
        row[i] = 1.0
        for j in range(i + 1):
            row[j] /= a[i, i]
        for m in range(i // 3 + 1):
            for p in range(3):
                for q in range(3):
                    blocks[m, p, q] += row[3 * m + p] * row[3 * m + q]
    rotation = np.eye(3)
    for m in range(n // 3):
        c = math.cos(headings[m])
        s = math.sin(headings[m])
        rotation[0, 0] = rotation[1, 1] = c
        rotation[0, 1] = s
        rotation[1, 0] = -s
        blocks[m] = rotation @ blocks[m] @ rotation.T
    return blocks

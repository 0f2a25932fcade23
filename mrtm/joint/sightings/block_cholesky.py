"""Sparse symmetric equations in blocks of three: solved, and some blocks of the inverse (Takahashi, Fagan, Chen 1973).

Covariances of some hundred poses are wanted only for pairs of them that a sighting joins. The factors' own sparsity
pattern, with these pairs in it, is enough: the cost is about that of the factorisation, not the cube of the size.
A pattern keeps the order of elimination, which is that of least degree, and for every column in it the rows below its
diagonal that are not zero, ascending.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from mrtm.joint.sightings.hypotheses import BoolArray, FloatArray, IntArray


class Pattern(NamedTuple):
    """Where a matrix of (n, n) blocks, and its factors, may be other than zero.

    Attributes:
        place: (n,) of each row in the order of elimination.
        starts: (n + 1,) of each column's part of ``rows``.
        rows: (k,) below the diagonal, ascending within a column, both as places.
    """

    place: IntArray
    starts: IntArray
    rows: IntArray


class Blocks(NamedTuple):
    """A symmetric matrix with a pattern: ``diagonal`` (n, 3, 3) and ``below`` (k, 3, 3) it, by places."""

    pattern: Pattern
    diagonal: FloatArray
    below: FloatArray

    def at(self, rows: IntArray, columns: IntArray) -> FloatArray:
        """(p, 3, 3) the blocks in ``rows`` (p,) and ``columns`` (p,); zero outside the pattern, and for row -1."""
        found = np.zeros((len(rows), 3, 3))
        _look_up(*self.pattern, self.diagonal, self.below, rows, columns, found)
        return found


def pattern_of(n: int, rows: IntArray, columns: IntArray) -> Pattern:
    """The pattern of a symmetric matrix with blocks at ``rows`` and ``columns`` (p,), either way; those at -1 none."""
    joined = np.zeros((n, n), np.bool_)
    inside = (rows >= 0) & (columns >= 0)
    joined[rows[inside], columns[inside]] = joined[columns[inside], rows[inside]] = True
    return Pattern(*_eliminate(joined))


def inverse_of(blocks: Blocks) -> Blocks | None:
    """The inverse where ``blocks`` has its pattern; None if that is not positive definite."""
    diagonal, below = blocks.diagonal.copy(), blocks.below.copy()
    if not factorise(blocks.pattern.starts, blocks.pattern.rows, diagonal, below):
        return None
    return inverse_of_factors(Blocks(blocks.pattern, diagonal, below))


def inverse_of_factors(factors: Blocks) -> Blocks:
    """The inverse of a matrix that has been factorised."""
    diagonal, below = np.empty_like(factors.diagonal), np.empty_like(factors.below)
    _invert(factors.pattern.starts, factors.pattern.rows, factors.diagonal, factors.below, diagonal, below)
    return Blocks(factors.pattern, diagonal, below)


@njit(cache=True)
def _eliminate(joined: BoolArray) -> tuple[IntArray, IntArray, IntArray]:
    """Greedy, the first row of those of least degree; ``joined`` (n, n) is used up."""
    n = len(joined)
    place, order, starts = np.full(n, -1), np.empty(n, np.int64), np.zeros(n + 1, np.int64)
    degree = np.zeros(n, np.int64)
    for i in range(n):
        joined[i, i] = False
        for k in range(n):
            degree[i] += joined[i, k]
    around, kept = np.empty(n, np.int64), []
    for step in range(n):
        least = -1
        for i in range(n):
            if place[i] < 0 and (least < 0 or degree[i] < degree[least]):
                least = i
        place[least], order[step] = step, least
        count = 0
        for i in range(n):
            if place[i] < 0 and joined[least, i]:
                around[count] = i
                count += 1
        for p in range(count):
            i = around[p]
            kept.append(i)
            degree[i] -= 1
            for q in range(p):
                k = around[q]
                if not joined[i, k]:
                    joined[i, k] = joined[k, i] = True
                    degree[i] += 1
                    degree[k] += 1
        starts[step + 1] = starts[step] + count
    rows = np.empty(starts[n], np.int64)
    for j in range(n):
        for p in range(starts[j], starts[j + 1]):
            rows[p] = place[kept[p]]
        rows[starts[j] : starts[j + 1]].sort()
    return place, starts, rows


@njit(cache=True)
def slot(starts, rows, row, column):  # type: ignore[no-untyped-def]
    """Where the block at places ``row`` > ``column`` is kept; -1 if it is not."""
    low, high = starts[column], starts[column + 1]
    while low < high:
        middle = (low + high) // 2
        if rows[middle] < row:
            low = middle + 1
        else:
            high = middle
    return low if low < starts[column + 1] and rows[low] == row else -1


@njit(cache=True)
def factorise(starts, rows, diagonal, below):  # type: ignore[no-untyped-def]
    """L D L' in place: L below the diagonal, on it the inverse of D. False if the matrix is not positive definite."""
    n = len(diagonal)
    upper, inverse = np.empty((len(rows), 3, 3)), np.empty((3, 3))
    for j in range(n):
        if not _inverse(diagonal[j], inverse):
            return False
        diagonal[j] = inverse
        for p in range(starts[j], starts[j + 1]):
            upper[p] = below[p]
            multiply(upper[p], inverse, below[p])
        for q in range(starts[j], starts[j + 1]):
            k = rows[q]
            _subtract(upper[q], below[q], diagonal[k])
            at = starts[k]
            for p in range(q + 1, starts[j + 1]):
                while rows[at] != rows[p]:
                    at += 1
                _subtract(upper[p], below[q], below[at])
    return True


@njit(cache=True)
def substitute(starts, rows, diagonal, below, vector):  # type: ignore[no-untyped-def]
    """Solve with the factors: ``vector`` (n, 3), by places, becomes the solution."""
    n = len(diagonal)
    for j in range(n):
        for p in range(starts[j], starts[j + 1]):
            i = rows[p]
            for r in range(3):
                for s in range(3):
                    vector[i, r] -= below[p, r, s] * vector[j, s]
    right = np.empty(3)
    for j in range(n - 1, -1, -1):
        right[:] = vector[j]
        for r in range(3):
            total = 0.0
            for s in range(3):
                total += diagonal[j, r, s] * right[s]
            vector[j, r] = total
        for p in range(starts[j], starts[j + 1]):
            i = rows[p]
            for r in range(3):
                for s in range(3):
                    vector[j, r] -= below[p, s, r] * vector[i, s]


@njit(cache=True)
def _invert(starts, rows, diagonal, below, found_diagonal, found_below):  # type: ignore[no-untyped-def]
    n = len(diagonal)
    widest = 0
    for j in range(n):
        widest = max(widest, starts[j + 1] - starts[j])
    sums = np.empty((widest, 3, 3))
    for j in range(n - 1, -1, -1):
        first, end = starts[j], starts[j + 1]
        sums[: end - first] = 0.0
        for q in range(first, end):  # each block of the inverse between two of the rows counts for both
            k = rows[q]
            _add(found_diagonal[k], below[q], sums[q - first])
            at = starts[k]
            for p in range(q + 1, end):
                while rows[at] != rows[p]:
                    at += 1
                _add(found_below[at], below[q], sums[p - first])
                _add(found_below[at].T, below[p], sums[q - first])
        found_diagonal[j] = diagonal[j]
        for p in range(first, end):
            found_below[p] = -sums[p - first]
            for r in range(3):
                for c in range(3):
                    for s in range(3):
                        found_diagonal[j, r, c] -= below[p, s, r] * found_below[p, s, c]


@njit(cache=True)
def _look_up(place, starts, rows, diagonal, below, wanted_rows, wanted_columns, found):  # type: ignore[no-untyped-def]
    for p in range(len(wanted_rows)):
        if wanted_rows[p] < 0 or wanted_columns[p] < 0:
            continue
        i, k = place[wanted_rows[p]], place[wanted_columns[p]]
        if i == k:
            found[p] = diagonal[i]
            continue
        at = slot(starts, rows, max(i, k), min(i, k))
        if at >= 0:
            found[p] = below[at] if i > k else below[at].T


@njit(cache=True)
def _inverse(a, out):  # type: ignore[no-untyped-def]
    """By Cholesky; False if ``a`` (3, 3) is not positive definite."""
    if not a[0, 0] > 0.0:
        return False
    l00 = math.sqrt(a[0, 0])
    l10, l20 = a[1, 0] / l00, a[2, 0] / l00
    d1 = a[1, 1] - l10 * l10
    if not d1 > 0.0:
        return False
    l11 = math.sqrt(d1)
    l21 = (a[2, 1] - l20 * l10) / l11
    d2 = a[2, 2] - l20 * l20 - l21 * l21
    if not d2 > 0.0:
        return False
    m00, m11, m22 = 1.0 / l00, 1.0 / l11, 1.0 / math.sqrt(d2)
    m10 = -l10 * m00 * m11
    m21 = -l21 * m11 * m22
    m20 = -(l20 * m00 + l21 * m10) * m22
    out[0, 0], out[1, 1], out[2, 2] = m00 * m00 + m10 * m10 + m20 * m20, m11 * m11 + m21 * m21, m22 * m22
    out[0, 1] = out[1, 0] = m10 * m11 + m20 * m21
    out[0, 2] = out[2, 0] = m20 * m22
    out[1, 2] = out[2, 1] = m21 * m22
    return True


# Each loads its right factor first: as far as the compiler knows ``out`` may lie in it, and to load it again for every
# product takes five times as long.


@njit(cache=True)
def multiply(a, b, out):  # type: ignore[no-untyped-def]
    """``out`` = a b."""
    b00, b01, b02, b10, b11, b12, b20, b21, b22 = _entries(b)
    for r in range(3):
        x, y, z = a[r, 0], a[r, 1], a[r, 2]
        out[r, 0] = x * b00 + y * b10 + z * b20
        out[r, 1] = x * b01 + y * b11 + z * b21
        out[r, 2] = x * b02 + y * b12 + z * b22


@njit(cache=True)
def _subtract(a, b, out):  # type: ignore[no-untyped-def]
    """``out`` -= a b'."""
    b00, b01, b02, b10, b11, b12, b20, b21, b22 = _entries(b)
    for r in range(3):
        x, y, z = a[r, 0], a[r, 1], a[r, 2]
        out[r, 0] -= x * b00 + y * b01 + z * b02
        out[r, 1] -= x * b10 + y * b11 + z * b12
        out[r, 2] -= x * b20 + y * b21 + z * b22


@njit(cache=True)
def _add(a, b, out):  # type: ignore[no-untyped-def]
    """``out`` += a b."""
    b00, b01, b02, b10, b11, b12, b20, b21, b22 = _entries(b)
    for r in range(3):
        x, y, z = a[r, 0], a[r, 1], a[r, 2]
        out[r, 0] += x * b00 + y * b10 + z * b20
        out[r, 1] += x * b01 + y * b11 + z * b21
        out[r, 2] += x * b02 + y * b12 + z * b22


@njit(cache=True)
def _entries(a):  # type: ignore[no-untyped-def]
    return a[0, 0], a[0, 1], a[0, 2], a[1, 0], a[1, 1], a[1, 2], a[2, 0], a[2, 1], a[2, 2]

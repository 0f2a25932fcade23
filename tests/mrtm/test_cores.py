"""Cores are limited for a while, and without a change that numba would refuse."""

import os

import numba

from mrtm.cores import limited_to


def test_cores_are_limited_for_a_while_only() -> None:
    most, environment = numba.get_num_threads(), dict(os.environ)
    with limited_to(1):
        assert numba.get_num_threads() == 1
    with limited_to(1000 * most):
        assert numba.get_num_threads() == most
    assert numba.get_num_threads() == most
    assert dict(os.environ) == environment  # numba would refuse to compile another kernel

"""Compiled loops: what they are for NumPy and for their tests, and when Numba is loaded."""

import os
import subprocess
import sys

import numpy as np
import pytest

from turbrestore.runtime.jit import jit
from turbrestore.runtime.machine_code import keepable

with_kept_code = pytest.mark.skipif(not keepable(), reason="this LLVM writes another intermediate code")


@jit
def add_halves(values, total):
    """Add half of each value to a total."""
    for index in range(values.size):
        total[0] += np.float32(0.5) * values[index]


@jit
def fill_places(image, step, factor, shift, places):
    """Every argument and each dimension counts."""
    for row in range(image.shape[0]):
        for column in range(image.shape[1]):
            places[row, column, 0] = image[row, column] * factor + shift
            places[row, column, 1] = row * step + column


@jit
def reverse(values):
    """Need memory of Numba's own."""
    copied = np.empty(values.size, values.dtype)
    copied[:] = values
    for index in range(values.size):
        values[index] = copied[values.size - 1 - index]


def test_compiled_and_plain_loops_agree():
    values = np.random.default_rng(0).random(1000).astype(np.float32)
    fast, slow = np.zeros(1), np.zeros(1)
    add_halves(values, fast)
    add_halves.py_func(values, slow)
    np.testing.assert_allclose(fast, slow, rtol=1e-6)
    assert add_halves.__name__ == "add_halves" and add_halves.__doc__.startswith("Add half")


def test_arguments_of_every_kind_arrive():
    image = np.arange(6, dtype=np.int32).reshape(2, 3)
    # Numba alone takes another order of the axes, and numbers of other kinds.
    for given, step in ((image, 10), (image.T, np.int64(10)), (image, np.int32(10))):
        fast, slow = np.zeros((2, *given.shape, 2))
        fill_places(given, step, np.float32(0.5), 0.25, fast)
        fill_places.py_func(given, step, np.float32(0.5), 0.25, slow)
        np.testing.assert_array_equal(fast, slow)


def test_a_loop_that_needs_numba_has_it():
    reverse(values := np.arange(3))
    assert values.tolist() == [2, 1, 0]


RUN = """
import sys, numpy as np
from turbrestore.registration import confidence, tvl1, warp
from turbrestore.deconvolution import deconvolve
assert not {'numba', 'llvmlite'} & set(sys.modules)
print(warp.warp(np.eye(16), np.full((16, 16, 2), 0.3, np.float32)).sum(), 'numba' in sys.modules)
"""


@with_kept_code
def test_numba_is_loaded_only_to_compile(tmp_path):
    def run():
        given = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
        return subprocess.run([sys.executable, "-c", RUN], capture_output=True, text=True, check=True, env=given).stdout

    first, second = run(), run()
    assert first.endswith("True\n") and second == first.replace("True", "False")
    # What is damaged is not run.
    (kept,) = tmp_path.glob("*.o")
    kept.write_bytes(kept.read_bytes()[:-1] + b"?")
    assert (run(), run()) == (first, second)


def test_a_loop_that_cannot_be_kept_on_disk_is_compiled_all_the_same():
    # A function that has no file has no place beside it.
    space = {"np": np}
    exec("def double(values):\n    for index in range(values.size):\n        values[index] *= 2", space)
    jit(space["double"])(numbers := np.arange(3))
    assert numbers.tolist() == [0, 2, 4]

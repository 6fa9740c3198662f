"""Compiled loops: what they are for NumPy and for their tests, and when Numba is loaded."""

import subprocess
import sys

import numpy as np

from turbrestore.runtime.jit import jit


@jit
def add_halves(values, total):
    """Add half of each value to a total."""
    for index in range(values.size):
        total[0] += np.float32(0.5) * values[index]


def test_compiled_and_plain_loops_agree():
    values = np.random.default_rng(0).random(1000).astype(np.float32)
    fast, slow = np.zeros(1), np.zeros(1)
    add_halves(values, fast)
    add_halves.py_func(values, slow)
    np.testing.assert_allclose(fast, slow, rtol=1e-6)
    assert add_halves.__name__ == "add_halves" and add_halves.__doc__.startswith("Add half")


def test_numba_is_loaded_when_a_loop_is_first_called():
    code = (
        "import sys, numpy as np; from turbrestore.registration import warp, confidence\n"
        "from turbrestore.registration.flow_methods import tvl1\n"
        "from turbrestore.deconvolution import deconvolve\n"
        "assert 'numba' not in sys.modules\n"
        "warp.warp(np.ones((16, 16)), np.full((16, 16, 2), 0.3, np.float32))\n"
        "assert 'numba' in sys.modules\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_a_loop_that_cannot_be_kept_on_disk_is_compiled_all_the_same():
    # A function that has no file has no place beside it.
    space = {"np": np}
    exec("def double(values):\n    for index in range(values.size):\n        values[index] *= 2", space)
    jit(space["double"])(numbers := np.arange(3))
    assert numbers.tolist() == [0, 2, 4]

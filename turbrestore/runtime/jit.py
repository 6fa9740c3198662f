"""Loops over arrays, compiled by Numba.

A chain of NumPy operations passes through memory once for each of them, and threads wait for the interpreter lock
after each.  A compiled loop passes through memory once and without the lock.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable
from typing import Any, Generic, ParamSpec

Arguments = ParamSpec("Arguments")

# Sums may be added up in another order, and products added without rounding; values that are not finite stay what
# they are.
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": {"contract", "reassoc"}}
# What Numba and its compiler take in memory in a first run, as measured, bytes.
COMPILER_BYTES = 1.4e8


class Jit(Generic[Arguments]):
    """A loop over arrays that Numba compiles when it is first called; ``py_func`` is what it does, for tests."""

    def __init__(self, py_func: Callable[Arguments, None]) -> None:
        self.py_func = py_func
        functools.update_wrapper(self, py_func)

    @functools.cached_property
    def _compiled(self) -> Callable[Arguments, None]:
        numba: Any = importlib.import_module("numba")
        try:
            fast: Callable[Arguments, None] = numba.njit(cache=True, **_OPTIONS)(self.py_func)
        except RuntimeError:
            # There is no folder in which the compiled code could be kept.
            fast = numba.njit(**_OPTIONS)(self.py_func)
        return fast

    def __call__(self, *args: Arguments.args, **kwargs: Arguments.kwargs) -> None:
        """Run the compiled function."""
        self._compiled(*args, **kwargs)


def jit(py_func: Callable[Arguments, None]) -> Jit[Arguments]:
    """Compile a function over arrays at its first call; the machine code is kept on disk for later runs.

    Compiled code runs without the interpreter lock. Literals should be ``np.float32``, because others are computed in
    double precision. In an inner loop an index is best made ``np.uintp``, because a signed index may count from the
    end, which is checked at every access; but the sum of an unsigned and a signed integer is a float.
    """
    return Jit(py_func)

"""Loops over arrays, compiled by Numba where it is installed (extra ``fast``).

A chain of NumPy operations goes through memory once for each of them, and takes the interpreter lock again after each,
for which threads wait.  A compiled loop goes through memory once without the lock.  What is compiled stands beside the
operations of NumPy that do the same, and agrees with them to rounding.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any, Generic, ParamSpec, TypeVar

Arguments = ParamSpec("Arguments")
Loops = TypeVar("Loops", bound=Callable[..., None])

# Sums may be added up in another order, and products added without rounding; values that are not finite stay what
# they are.
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": {"contract", "reassoc"}}
# What Numba and its compiler take in memory, bytes.
COMPILER_BYTES = 1.4e8


@functools.cache
def can_compile() -> bool:
    """Whether Numba is installed, and works with this NumPy: it is loaded to find out.

    Returns
    -------
    bool

    Examples
    --------
    >>> isinstance(can_compile(), bool)
    True
    """
    if find_spec("numba") is None:
        return False
    try:
        importlib.import_module("numba")
    except ImportError:
        # It refuses a NumPy that is newer than it knows.
        return False
    return True


@functools.cache
def compiled(loops: Loops) -> Loops | None:
    """Compile a function at its first call, once for an installation: the result is kept on disk.

    Parameters
    ----------
    loops : callable
        Loops over arrays and numbers, without a result of their own.  Literals have to be ``np.float32``: others are
        computed with in double precision.  In an inner loop an index that is looked up is best made ``np.uintp``, for
        others may count from the end, which is asked at every access; but an unsigned and a signed integer add up to a
        float.

    Returns
    -------
    callable or None
        It works without the interpreter lock; None where Numba is not installed, or does not work with this NumPy.

    Examples
    --------
    >>> import numpy as np
    >>> def double(array):
    ...     for index in range(array.size):
    ...         array[index] *= 2
    >>> (compiled(double) or double)(numbers := np.arange(3))
    >>> numbers
    array([0, 2, 4])
    """
    if not can_compile():
        return None
    numba: Any = importlib.import_module("numba")
    try:
        fast: Loops = numba.njit(cache=True, **_OPTIONS)(loops)
    except RuntimeError:
        # There is no folder to keep it in.
        fast = numba.njit(**_OPTIONS)(loops)
    return fast


class Jit(Generic[Arguments]):
    """A loop over arrays that Numba compiles when it is first called.

    Attributes
    ----------
    py_func : callable
        The function as written: the oracle of its tests.
    """

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

    Compiled code runs without the interpreter lock.  Literals should be ``np.float32``, because others are computed
    in double precision.  In an inner loop an index is best made ``np.uintp``, because a signed index may count from
    the end, which is checked at every access; but the sum of an unsigned and a signed integer is a float.

    Parameters
    ----------
    py_func : callable
        Loops over arrays and numbers that write into arrays and return nothing.

    Returns
    -------
    Jit

    Examples
    --------
    >>> import numpy as np
    >>> @jit
    ... def double(array):
    ...     for index in range(array.size):
    ...         array[index] *= 2
    >>> double.py_func(numbers := np.arange(3))
    >>> numbers
    array([0, 2, 4])
    """
    return Jit(py_func)

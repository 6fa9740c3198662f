"""Loops over arrays, compiled by Numba.

A chain of NumPy operations passes through memory once for each of them, and threads wait for the interpreter lock
after each.  A compiled loop passes through memory once and without the lock.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from typing import Any, Generic, TypeVarTuple

import numpy as np

from .machine_code import IN_ORDER, Kept, Kind, keepable, kind_of, load, translate

Arguments = TypeVarTuple("Arguments")

# Sums may be added up in another order, and products added without rounding; values that are not finite stay what
# they are.
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": {"contract", "reassoc"}}
# What Numba and its compiler take in memory, bytes.
COMPILER_BYTES = 1.4e8


class Jit(Generic[*Arguments]):
    """A loop over arrays that is compiled when it is first called; ``py_func`` is what it does, for tests."""

    def __init__(self, py_func: Callable[[*Arguments], None]) -> None:
        self.py_func = py_func
        self._loops: dict[tuple[object, ...], Callable[..., None]] = {}
        self._lock = threading.Lock()
        functools.update_wrapper(self, py_func)

    def __call__(self, *args: *Arguments) -> None:
        """Run the compiled function."""
        # Quicker than the kinds of the arguments, and as good to tell them apart.
        key = tuple([(a.dtype, a.ndim, a.flags.num & IN_ORDER) if isinstance(a, np.ndarray) else type(a) for a in args])
        loop = self._loops.get(key)
        if loop is None:
            with self._lock:
                loop = self._loops[key] = self._loops.get(key) or self._loop(list(map(kind_of, args)))
        loop(*args)

    def _loop(self, kinds: list[Kind | None]) -> Callable[..., None]:
        """Load the loop for arguments of these kinds, or compile it."""
        known = [kind for kind in kinds if kind is not None]
        if len(known) < len(kinds) or not keepable():
            return self._numba
        kept = Kept(self.py_func, sorted(_OPTIONS), known)
        try:
            code = kept.read()
            if code is None:
                code = translate(_intermediate_code(self.py_func, known), known)
                kept.write(code)
            return load(code, kept.name, known)
        except (ValueError, RuntimeError):
            return self._numba

    @functools.cached_property
    def _numba(self) -> Callable[..., None]:
        """The same loop with all that Numba itself can take, and what Numba keeps of it."""
        import numba

        try:
            fast: Callable[..., None] = numba.njit(cache=True, **_OPTIONS)(self.py_func)
        except RuntimeError:
            # There is no folder in which the compiled code could be kept.
            fast = numba.njit(**_OPTIONS)(self.py_func)
        return fast


def _intermediate_code(py_func: Callable[..., None], kinds: list[Kind]) -> str:
    """Compile a function for arguments of these kinds, down to what LLVM makes machine code of."""
    import numba

    number = {"int64": numba.int64, "float32": numba.float32, "float64": numba.float64}
    signature = tuple(
        number[kind.type]
        if kind.dimensions is None
        else numba.types.Array(numba.from_dtype(np.dtype(kind.type)), kind.dimensions, "C")
        for kind in kinds
    )
    dispatcher = numba.njit(**_OPTIONS)(py_func)
    dispatcher.compile(signature)
    return str(dispatcher.inspect_llvm(signature))


def jit(py_func: Callable[[*Arguments], None]) -> Jit[*Arguments]:
    """Compile a function over arrays at its first call; the machine code is kept on disk for later runs.

    Compiled code runs without the interpreter lock. It allocates no memory, so that it needs nothing but itself.
    Literals should be ``np.float32``, because others are computed in double precision. In an inner loop an index is
    best made ``np.uintp``, because a signed index may count from the end, which is checked at every access; but the sum
    of an unsigned and a signed integer is a float.
    """
    return Jit(py_func)

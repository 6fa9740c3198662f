"""What the arrays and numbers of every kind of stage file are: shape and range, checked when one is read.

The types of numbers, flags and texts are those of the record that the file becomes.  A number that is not listed lies
between 0 and a billion.  Infinite values are allowed where a bound is infinite.

Shapes name their axes; one name is one length within a stage file:

======  =========================================================
H, W    height and width, pixels
P       2 H W, components of a flow; an earlier field has H and W
T       flows
n       states
τ       flows that the dynamics were fitted to, from n
N       frames
i       iterations of the centroid
k       values of a record, such as one an iteration
======  =========================================================
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import DataError
from ..dynamics.flow_model import FlowDynamics
from ..runtime.scratch import iter_parts

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

# Far beyond what pixels and intensities are, and small enough to be squared.
_MOST = 1e9
_INFINITE = math.inf
_SMALLEST = {"n": 0, "k": 0, "τ": 2}
# Rounding that a covariance may show, relative to its largest eigenvalue, chosen.
_ROUNDING = 1e-6


@dataclass(frozen=True)
class ArraySpec:
    """An array of a stage file."""

    dtype: str  # as NumPy abbreviates it
    shape: str  # names and lengths of the axes; shapes that are possible too follow after ``|``
    low: float = -_MOST
    high: float = _MOST
    gaps: bool = False  # whether NaN is allowed


@dataclass(frozen=True)
class NumberSpec:
    """A number of a stage file."""

    low: float = 0
    high: float = _MOST


_IMAGE = ArraySpec("f4", "H W|H W 3")
FIELDS: dict[str, dict[str, ArraySpec | NumberSpec]] = {
    "centroid": {"image": _IMAGE, "flows": ArraySpec("f4", "T H W 2"), "mean_flow_sizes": ArraySpec("f8", "i", low=0)},
    "dynamics": {
        "mean_flow": ArraySpec("f4", "H W 2"),
        "A": ArraySpec("f8", "n n"),
        "C": ArraySpec("f4", "P n"),
        "Q": ArraySpec("f8", "n n"),
        "residual_variance": ArraySpec("f4", "H W", low=0),
        "states": ArraySpec("f8", "n τ"),
        "singular_values": ArraySpec("f8", "τ", low=0),
        "energy_share": NumberSpec(high=1 + _ROUNDING),
    },
    "filtered": {
        "image": _IMAGE,
        "variance": ArraySpec("f4", "H W", low=0),
        "flow_states": ArraySpec("f8", "N n"),
        "gains": ArraySpec("f8", "N", low=0),
        "innovations": ArraySpec("f8", "N", low=0, gaps=True),
        "sharpness": ArraySpec("f8", "N", gaps=True),
        "shares": ArraySpec("f8", "N", low=0, high=1 + _ROUNDING),
        "mean_flow": ArraySpec("f4", "H W 2"),
    },
    "deconvolution": {
        "image": _IMAGE,
        "fidelity": NumberSpec(high=_INFINITE),
        "recorded": ArraySpec("i8", "k", low=0),
        "objective": ArraySpec("f8", "k", low=-_INFINITE, high=_INFINITE, gaps=True),
        "changes": ArraySpec("f8", "k", low=0, high=_INFINITE, gaps=True),
    },
    "blur": {
        "uncertainty": NumberSpec(high=_INFINITE),
        "reduction": NumberSpec(low=1),
        "evidence": NumberSpec(low=-_INFINITE, high=_INFINITE),
        "widths": ArraySpec("f8", "k", low=0),
        "costs": ArraySpec("f8", "k", low=-_INFINITE, high=_INFINITE),
    },
    "noise": dict.fromkeys(("power", "error", "relative"), ArraySpec("f8", "k", low=0)),
    "posterior": {
        "width": ArraySpec("f8", "3", low=0),
        **dict.fromkeys(
            ("by_displacement", "by_variation", "by_image", "by_tones"), ArraySpec("f8", "3", low=0, gaps=True)
        ),
        "air": NumberSpec(high=1 + _ROUNDING),
    },
}


def check_fields(kind: str, result: DataclassInstance, name: str) -> None:
    """Refuse a result that a stage cannot have made."""
    sizes: dict[str, int] = {}
    numbers = [field for field, value in vars(result).items() if isinstance(value, int | float)]
    for field, wanted in {**dict.fromkeys(numbers, NumberSpec()), **FIELDS[kind]}.items():
        value = getattr(result, field)
        if isinstance(wanted, ArraySpec):
            complaint = _array_complaint(value, wanted, sizes)
        else:
            complaint = "" if wanted.low <= value <= wanted.high else _range(wanted, value)
        if complaint:
            raise DataError(f"{name}: expected {field} {complaint}; the file is damaged")
    if isinstance(result, FlowDynamics):
        _check_dynamics(result, name)


def _array_complaint(value: NDArray[Any], wanted: ArraySpec, sizes: dict[str, int]) -> str:
    """Say what is expected of an array and what it is instead; nothing where it is right."""
    if value.dtype != np.dtype(wanted.dtype):
        return f"to be of {np.dtype(wanted.dtype)}, found {value.dtype}"
    if not any(_fits(value.shape, shape.split(), sizes) for shape in wanted.shape.split("|")):
        known = ", ".join(f"{axis} = {size}" for axis, size in sizes.items())
        shape = wanted.shape.replace(" ", ", ").replace("|", ") or (")
        return f"of shape ({shape}){f' with {known}' if known else ''}, found {value.shape}"
    if value.size == 0:
        return ""
    # A large array may lie in a mapped file.
    for part in iter_parts(value):
        low, high = (
            (np.fmin.reduce(part, None), np.fmax.reduce(part, None)) if wanted.gaps else (part.min(), part.max())
        )
        if wanted.gaps and math.isnan(low):
            continue
        if not wanted.low <= low <= high <= wanted.high:
            return _range(wanted, low if not wanted.low <= low else high)
    return ""


def _range(wanted: ArraySpec | NumberSpec, found: float) -> str:
    return f"from {wanted.low:g} to {wanted.high:g}, found {found!s:.40}"


def _fits(shape: tuple[int, ...], axes: list[str], sizes: dict[str, int]) -> bool:
    """Whether a shape has these axes; lengths of new axes are then recorded in `sizes`."""
    if len(shape) != len(axes):
        return False
    found = dict(sizes)
    for length, axis in zip(shape, axes, strict=True):
        if axis == "P":
            known = 2 * found["H"] * found["W"]
        else:
            known = int(axis) if axis.isdecimal() else found.setdefault(axis, max(length, _SMALLEST.get(axis, 1)))
        if length != known:
            return False
    sizes.update(found)
    return True


def _check_dynamics(dynamics: FlowDynamics, name: str) -> None:
    """Refuse a covariance with a negative eigenvalue, and more states than there are flows."""
    Q, count = dynamics.Q, dynamics.states.shape[1]
    if len(Q) > count:
        raise DataError(f"{name}: expected up to {count} states, one a flow, found {len(Q)}; the file is damaged")
    largest = np.abs(Q).max(initial=0.0)
    if np.abs(Q - Q.T).max(initial=0.0) > _ROUNDING * largest:
        raise DataError(f"{name}: expected Q to be symmetric, found {Q.shape} that is not; the file is damaged")
    least = np.linalg.eigvalsh(Q).min(initial=0.0)
    if least < -_ROUNDING * largest:
        raise DataError(f"{name}: expected Q without negative eigenvalues, found {least:.3g}; the file is damaged")

"""Warping images by flows: backward warp, its adjoint, inversion and composition of flows.

Symbols
-------
W : flow, ``w = id + W``.  ``warp(I, W) = I ∘ w`` (paper 3, eqs. 6 and 15).

Sampling is by cubic B-splines that interpolate, or bilinear; outside the image the nearest pixel is repeated.  The
usual cubic convolution (OpenCV's has a = −0.75) does not reproduce a ramp and so moves edges by up to 0.04 px; the
spline reproduces cubics.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse

from ..core.arrays import FloatArray, check_flow, check_image
from ..core.errors import ConfigurationError, DataError
from ..runtime.device import PROCESSOR, find_device, memory_of
from ..runtime.image_stacks import PREFILTER, StackOps, torch_ops, warp_stack
from ..runtime.jit import compiled

# Pixels of a strip.  A dozen arrays of a smaller one would stay in the cache of a core, but where two threads run, the
# interpreter lock that every operation on them gives away and takes again costs more than the cache saves.
_STRIP = 1 << 16
# Coefficients that a spline reaches before the image and beyond it.
_BEFORE, _BEYOND = 1, 2


def warp(image: ArrayLike, flow: ArrayLike, interpolation: str = "cubic", device: str = PROCESSOR) -> FloatArray:
    """Backward warp: ``result(x, y) = image(x + dx, y + dy)``.

    With ``flow = estimate_flow(reference, frame)`` the result lies on the reference (``I ∘ w``; paper 3, eq. 15).

    Parameters
    ----------
    image : array_like, shape (H, W) or (H, W, 3)
        Intensities.
    flow : array_like, shape (H, W, 2)
        Displacements (dx, dy) in pixels.
    interpolation : {"cubic", "linear"}
        Cubic B-splines keep detail; linear never leaves the range of the image and has an exact adjoint.
    device : str
        Where the cubic warp is computed, see :mod:`turbrestore.runtime.device`.

    Returns
    -------
    ndarray, float32, shape of ``image``

    Raises
    ------
    DataError
        Shapes do not agree, or values are not finite.
    ConfigurationError
        Unknown interpolation, or the device is not there or has not enough memory.

    Examples
    --------
    >>> import numpy as np
    >>> ramp = np.tile(np.arange(5, dtype=np.float32), (3, 1))
    >>> shift = np.zeros((3, 5, 2), np.float32); shift[..., 0] = 0.25
    >>> warp(ramp, shift, interpolation="linear")[0]
    array([0.25, 1.25, 2.25, 3.25, 4.  ], dtype=float32)
    """
    image, flow = check_image(image), check_flow(flow)
    if interpolation not in INTERPOLATIONS:
        raise ConfigurationError(f"interpolation: expected one of {', '.join(INTERPOLATIONS)}, found {interpolation!r}")
    if flow.ndim != 3 or image.shape[:2] != flow.shape[:2]:
        raise DataError(f"flow: expected shape {(*image.shape[:2], 2)}, found {flow.shape}")
    found = find_device(device)
    if interpolation == "cubic" and found != PROCESSOR:
        with memory_of(found, "take a smaller --roi"):
            return _on_device(image, flow, torch_ops(found))
    return INTERPOLATIONS[interpolation](image, flow)


def warp_adjoint(image: ArrayLike, flow: ArrayLike) -> FloatArray:
    """Adjoint of the bilinear warp: each pixel is spread to the four pixels it was sampled from.

    ``⟨warp(a, W, "linear"), b⟩ = ⟨a, warp_adjoint(b, W)⟩`` for all images a and b.

    Parameters
    ----------
    image : array_like, shape (H, W) or (H, W, 3)
        Intensities on the grid of the warped image.
    flow : array_like, shape (H, W, 2)
        Displacements (dx, dy) in pixels, as given to :func:`warp`.

    Returns
    -------
    ndarray, float32, shape of ``image``

    Raises
    ------
    DataError
        Shapes do not agree, or values are not finite.

    Examples
    --------
    >>> import numpy as np
    >>> point = np.zeros((3, 5), np.float32); point[1, 1] = 1
    >>> shift = np.zeros((3, 5, 2), np.float32); shift[..., 0] = 0.25
    >>> warp_adjoint(point, shift)[1]
    array([0.  , 0.75, 0.25, 0.  , 0.  ], dtype=float32)
    """
    image, flow = check_image(image), check_flow(flow)
    if flow.ndim != 3 or image.shape[:2] != flow.shape[:2]:
        raise DataError(f"flow: expected shape {(*image.shape[:2], 2)}, found {flow.shape}")
    operator = _bilinear_matrix(flow)
    flat = image.reshape(flow.shape[0] * flow.shape[1], -1).astype(np.float64)
    return (operator.T @ flat).reshape(image.shape).astype(np.float32)


def invert_flow(flow: ArrayLike, iterations: int = 20, tolerance: float = 1e-3) -> FloatArray:
    """Flow of the inverse map: ``(id + V) ∘ (id + W) = id``.

    Fixed-point iteration ``V ← −W ∘ (id + V)``; it converges where the flow stretches by less than a factor of
    two (Lipschitz constant of W below 1), which holds for atmospheric flows.

    Parameters
    ----------
    flow : array_like, shape (H, W, 2)
        Displacements W (dx, dy) in pixels.
    iterations : int
        Largest number of fixed-point steps.
    tolerance : float
        Steps end when no displacement changes by more than this many pixels; in a large flow, for some rows at a time.

    Returns
    -------
    ndarray, float32, shape (H, W, 2)
        V, in pixels.

    Raises
    ------
    DataError
        Wrong shape, or values are not finite.

    Examples
    --------
    >>> import numpy as np
    >>> shift = np.full((4, 4, 2), 0.5, np.float32)
    >>> invert_flow(shift)[0, 0]
    array([-0.5, -0.5], dtype=float32)
    """
    flow = check_flow(flow)
    if flow.ndim != 3:
        raise DataError(f"flow: expected shape (H, W, 2), found {flow.shape}")
    inverse, planes = -flow, cv2.split(flow)
    for rows in strips(flow.shape):
        for _ in range(iterations):
            update = _sample_planes(planes, inverse[rows], rows)
            np.negative(update, out=update)
            change = cv2.norm(update, inverse[rows], cv2.NORM_INF)
            inverse[rows] = update
            if change <= tolerance:
                break
    return inverse


def compose_flows(outer: ArrayLike, inner: ArrayLike) -> FloatArray:
    """Flow of ``(id + outer) ∘ (id + inner)``: follow ``inner`` first, then ``outer`` from where it leads.

    ``warp(warp(I, outer), inner) ≈ warp(I, compose_flows(outer, inner))``, without the second interpolation.

    Parameters
    ----------
    outer, inner : array_like, shape (H, W, 2)
        Displacements (dx, dy) in pixels.

    Returns
    -------
    ndarray, float32, shape (H, W, 2)

    Raises
    ------
    DataError
        Shapes do not agree, or values are not finite.

    Examples
    --------
    >>> import numpy as np
    >>> a, b = np.full((4, 4, 2), 0.5, np.float32), np.full((4, 4, 2), -0.2, np.float32)
    >>> compose_flows(a, b)[1, 1]
    array([0.3, 0.3], dtype=float32)
    """
    outer, inner = check_flow(outer, "outer"), check_flow(inner, "inner")
    if outer.ndim != 3 or outer.shape != inner.shape:
        raise DataError(f"inner: expected shape (H, W, 2) as outer has, found {outer.shape} and {inner.shape}")
    return inner + _linear(outer, inner)


def inside(flow: ArrayLike) -> FloatArray:
    """How far a warp samples the image and not the repetition of its border.

    Parameters
    ----------
    flow : array_like, shape (H, W, 2)
        Displacements (dx, dy) in pixels.

    Returns
    -------
    ndarray, float32, shape (H, W)
        1 where the sample lies within the image, falling to 0 over one pixel beyond the centres of its border pixels.

    Raises
    ------
    DataError
        Wrong shape, or values are not finite.

    Examples
    --------
    >>> import numpy as np
    >>> shift = np.zeros((3, 5, 2), np.float32); shift[..., 0] = 1.25
    >>> inside(shift)[0]
    array([1.  , 1.  , 1.  , 0.75, 0.  ], dtype=float32)
    """
    flow = check_flow(flow)
    if flow.ndim != 3:
        raise DataError(f"flow: expected shape (H, W, 2), found {flow.shape}")
    seen = np.ones(flow.shape[:2], np.float32)
    # Only samples within reach of a border can lie beyond it.
    reach = math.ceil(cv2.norm(flow, cv2.NORM_INF))
    _fade(seen.T, flow[..., 0].T, reach)
    _fade(seen, flow[..., 1], reach)
    return seen


def strips(shape: tuple[int, ...]) -> Iterator[slice]:
    """Rows of an image in pieces that are worked on one after the other, so that intermediate results stay in cache.

    Parameters
    ----------
    shape : tuple of int
        (H, W) and what follows.

    Yields
    ------
    slice

    Examples
    --------
    >>> list(strips((400, 400)))
    [slice(0, 163, None), slice(163, 326, None), slice(326, 400, None)]
    """
    rows = max(_STRIP // shape[1], 1)
    return (slice(start, min(start + rows, shape[0])) for start in range(0, shape[0], rows))


def _fade(seen: FloatArray, flow: FloatArray, reach: int) -> None:
    """Multiply ``seen`` by how far samples along the first axis lie within the image; none moves by more than reach."""
    length = len(flow)
    position = np.arange(length, dtype=np.float32)[:, None]
    before = min(reach, length)
    for part in (slice(0, before), slice(max(length - reach, before), length)):
        sample = position[part] + flow[part]
        seen[part] *= np.clip(1 - np.maximum(-sample, sample - (length - 1)), 0, 1)


@functools.lru_cache(maxsize=4)
def _pixel_grid(height: int, width: int) -> tuple[FloatArray, FloatArray]:
    y, x = np.mgrid[:height, :width].astype(np.float32)
    x.flags.writeable = y.flags.writeable = False
    return x, y


def _linear(image: FloatArray, flow: FloatArray) -> FloatArray:
    # For one and three channels OpenCV 5 is exact; for the two of a flow it still rounds positions to 1/32 px.
    return _sample_planes(cv2.split(image) if image.shape[2:] == (2,) else (image,), flow)


def _sample_planes(planes: Sequence[FloatArray], flow: FloatArray, rows: slice = slice(None)) -> FloatArray:
    """Planes at where the flow of some rows leads, put together."""
    x, y = (axis[rows] for axis in _pixel_grid(*planes[0].shape[:2]))
    to = x + flow[..., 0], y + flow[..., 1]
    sampled = [cv2.remap(plane, *to, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for plane in planes]
    return cv2.merge(sampled) if len(planes) > 1 else sampled[0]


def _cubic(image: FloatArray, flow: FloatArray) -> FloatArray:
    coefficients = cv2.sepFilter2D(image, -1, PREFILTER, PREFILTER, borderType=cv2.BORDER_REFLECT_101)
    sample = compiled(sample_spline)
    if sample is None:
        return _sample_strips(coefficients, flow)
    coefficients, result = mirror(coefficients, _BEFORE, _BEYOND), np.empty(image.shape, np.float32)
    if image.ndim == 2:
        sample(coefficients, flow, result)
        return result
    for channel, plane in enumerate(cv2.split(coefficients)):
        sample(plane, flow, result[..., channel])
    return result


def mirror(image: FloatArray, before: int, beyond: int) -> FloatArray:
    """Continue an image beyond its border pixels, mirrored at them.

    Parameters
    ----------
    image : ndarray, float32, shape (H, W) or (H, W, C)
    before, beyond : int
        Pixels at the top and at the left, at the bottom and at the right.

    Returns
    -------
    ndarray, float32, shape (H + before + beyond, W + before + beyond) or with C

    Examples
    --------
    >>> mirror(np.array([[1, 2, 3]], np.float32), 1, 2)[0]
    array([2., 1., 2., 3., 2., 1.], dtype=float32)
    """
    return cv2.copyMakeBorder(image, before, beyond, before, beyond, cv2.BORDER_REFLECT_101)


def sample_spline(coefficients: FloatArray, flow: FloatArray, result: FloatArray) -> None:
    """Sum of 4×4 B-spline coefficients at each position of a map, to be compiled.

    Parameters
    ----------
    coefficients : ndarray, float32, shape (H + 3, W + 3)
        With a pixel before and two beyond the image.
    flow : ndarray, float32, shape (H, W, 2)
        Displacements (dx, dy) in pixels.
    result : ndarray, float32, shape (H, W)
        Filled.

    Examples
    --------
    >>> shifted = np.empty((2, 3), np.float32)
    >>> sample_spline(np.ones((5, 6), np.float32), np.full((2, 3, 2), 0.5, np.float32), shifted)
    >>> shifted.round(6).tolist()
    [[1.0, 1.0, 1.0], [1.0, 1.0, 1.0]]
    """
    zero, one, sixth = np.float32(0), np.float32(1), np.float32(1 / 6)
    three, four, six = np.float32(3), np.float32(4), np.float32(6)
    bottom, right = np.float32(result.shape[0] - 1), np.float32(result.shape[1] - 1)
    for row in range(result.shape[0]):
        for column in range(result.shape[1]):
            x = min(max(np.float32(column) + flow[row, column, 0], zero), right)
            y = min(max(np.float32(row) + flow[row, column, 1], zero), bottom)
            # Without a sign they need no look whether they count from the end.
            j, i = np.uint32(x), np.uint32(y)
            t, u = x - np.float32(j), y - np.float32(i)
            left, upper = (one - t) * (one - t) * (one - t) * sixth, (one - u) * (one - u) * (one - u) * sixth
            centre, middle = (four - (six - three * t) * t * t) * sixth, (four - (six - three * u) * u * u) * sixth
            far, lower = t * t * t * sixth, u * u * u * sixth
            beside, below = one - left - centre - far, one - upper - middle - lower
            rows = coefficients[i], coefficients[i + 1], coefficients[i + 2], coefficients[i + 3]
            a = rows[0][j] * left + rows[0][j + 1] * centre + rows[0][j + 2] * beside + rows[0][j + 3] * far
            b = rows[1][j] * left + rows[1][j + 1] * centre + rows[1][j + 2] * beside + rows[1][j + 3] * far
            c = rows[2][j] * left + rows[2][j + 1] * centre + rows[2][j + 2] * beside + rows[2][j + 3] * far
            d = rows[3][j] * left + rows[3][j + 1] * centre + rows[3][j + 2] * beside + rows[3][j + 3] * far
            result[row, column] = a * upper + b * middle + c * below + d * lower


def _sample_strips(coefficients: FloatArray, flow: FloatArray) -> FloatArray:
    """Sum of 4×4 B-spline coefficients as a blend of four bilinear samples (Sigg and Hadwiger 2005)."""
    grid = _pixel_grid(*flow.shape[:2])
    result = np.empty_like(coefficients)
    for rows in strips(flow.shape):
        position = np.empty((2, *flow[rows].shape[:2]), np.float32)
        for index, axis in enumerate(grid):
            np.add(axis[rows], flow[rows, :, index], out=position[index])
            np.clip(position[index], 0, flow.shape[1 - index] - 1, out=position[index])
        result[rows] = _sample(coefficients, position)
    return result


def _sample(coefficients: FloatArray, position: FloatArray) -> FloatArray:
    """Spline with these coefficients at the positions (x, y), which are overwritten."""
    (left, upper), (right, lower), (to_right, to_lower) = _spline_pair(position)
    if coefficients.ndim == 3:
        to_right, to_lower = (cv2.merge([blend] * coefficients.shape[2]) for blend in (to_right, to_lower))
    first, second = np.empty((2, 2, *to_right.shape), np.float32)
    for column, samples in ((left, first), (right, second)):
        for row, sample in zip((upper, lower), samples, strict=True):
            cv2.remap(coefficients, column, row, cv2.INTER_LINEAR, dst=sample, borderMode=cv2.BORDER_REFLECT_101)
    above, below = _blend(first, second, to_right)
    return _blend(above, below, to_lower)


def _blend(first: FloatArray, second: FloatArray, share: FloatArray) -> FloatArray:
    """``first + share (second − first)``, in the memory of ``second``."""
    second -= first
    second *= share
    second += first
    return second


def _spline_pair(position: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Two positions and a blend whose bilinear samples weigh four neighbours as the cubic B-spline does.

    With weights w0 to w3 the blend is w2 + w3.  ``position`` is overwritten.
    """
    whole = np.floor(position)
    t = np.subtract(position, whole, out=position)
    square = t * t
    first = t * np.float32(0.5)
    first -= 1
    first *= square
    first += np.float32(2 / 3)
    second = np.multiply(square, t, out=square)
    second /= 6
    rest = np.subtract(1, t, out=t)
    before = rest * rest
    before *= rest
    before /= 6
    before += first
    share = np.subtract(1, before, out=rest)
    first /= before
    first += whole
    first -= 1
    second /= share
    second += whole
    second += 1
    return first, second, share


def _on_device(image: FloatArray, flow: FloatArray, ops: StackOps) -> FloatArray:
    planes = image[None] if image.ndim == 2 else np.moveaxis(image, -1, 0)
    warped = ops.store(warp_stack(ops.load(planes), ops.load(flow), ops))
    return warped[0] if image.ndim == 2 else np.ascontiguousarray(np.moveaxis(warped, 0, -1))


INTERPOLATIONS = {"linear": _linear, "cubic": _cubic}


def _bilinear_matrix(flow: FloatArray) -> sparse.csr_array:
    """Sparse matrix of the bilinear warp: one row a pixel of the result, four weights a row."""
    height, width = flow.shape[:2]
    x, y = _pixel_grid(height, width)
    # Clamping the position is what repeating the nearest pixel means.
    u = np.clip(x.astype(np.float64) + flow[..., 0], 0, width - 1).ravel()
    v = np.clip(y.astype(np.float64) + flow[..., 1], 0, height - 1).ravel()
    left = np.minimum(u.astype(np.intp), max(width - 2, 0))
    top = np.minimum(v.astype(np.intp), max(height - 2, 0))
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    fx, fy = u - left, v - top
    rows = np.tile(np.arange(u.size), 4)
    upper, lower = top * width, bottom * width
    columns = np.concatenate([upper + left, upper + right, lower + left, lower + right])
    weights = np.concatenate([(1 - fy) * (1 - fx), (1 - fy) * fx, fy * (1 - fx), fy * fx])
    return sparse.csr_array((weights, (rows, columns)), shape=(u.size, u.size))

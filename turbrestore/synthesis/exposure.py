"""Exposures that last: a frame is the mean of what is seen while the scene moves.

Symbols
-------
Y : image of an integrative sensor, ``Y = (1/T_e) ∫ ρ ∘ w_t⁻¹ dt`` over the exposure T_e (papers 1 and 2), here a mean
over sub-frames in the middle of equal parts of it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import FloatArray, check_image
from ..core.errors import DataError, require
from ..registration.flow_algebra import invert_flow
from ..registration.warp import warp


def exposed_frame(
    scene: ArrayLike,
    sub_flows: Iterable[FloatArray],
    blur: Callable[[FloatArray, int], FloatArray] | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Mean of a scene displaced by the flow of each sub-frame.

    Parameters
    ----------
    scene : array_like, shape (H, W) or (H, W, 3)
        ρ.
    sub_flows : iterable of ndarray, float32, shape (H, W, 2)
        From the scene to each sub-frame, pixels; at least one.
    blur : callable, optional
        ``blur(image, index)`` is what a displaced sub-frame becomes; it may crop.

    Returns
    -------
    image : ndarray, float32
        Y, before noise.
    flow : ndarray, float32, shape (H, W, 2)
        Mean of the flows, pixels.

    Raises
    ------
    DataError
        No flow, or shapes do not agree.

    Examples
    --------
    >>> import numpy as np
    >>> dot = np.zeros((16, 16), np.float32); dot[8, 8] = 1
    >>> flows = np.zeros((2, 16, 16, 2), np.float32); flows[1, ..., 0] = 2
    >>> image, flow = exposed_frame(dot, flows)
    >>> image[8, 8:11:2].round(3), flow[8, 8]
    (array([0.5, 0.5], dtype=float32), array([1., 0.], dtype=float32))
    """
    truth = check_image(scene, "scene")
    total, displacement, count = None, None, 0
    for index, flow in enumerate(sub_flows):
        seen = warp(truth, invert_flow(flow))
        seen = seen if blur is None else blur(seen, index)
        total = seen if total is None else total + seen
        displacement = flow if displacement is None else displacement + flow
        count += 1
    if total is None or displacement is None:
        raise DataError("sub_flows: expected at least one flow, found none")
    return total / np.float32(count), displacement / np.float32(count)


def flows_between(flows: Iterable[FloatArray], shares: Sequence[float]) -> Iterator[list[FloatArray]]:
    """Sub-frame flows of each frame, linear in time between its flow and the next one.

    Parameters
    ----------
    flows : iterable of ndarray, float32, shape (H, W, 2)
        At the start of each frame, one at a time; the last only ends the frame before it.
    shares : sequence of float
        Instants as shares of the frame time, 0 to 1.

    Yields
    ------
    list of ndarray, float32, shape (H, W, 2)
        One flow a share; as many lists as flows less one.

    Raises
    ------
    ConfigurationError
        No share, or one outside 0 to 1.

    Examples
    --------
    >>> import numpy as np
    >>> flows = (np.full((1, 1, 2), k, np.float32) for k in range(3))
    >>> [[float(flow[0, 0, 0]) for flow in frame] for frame in flows_between(flows, (0.0, 0.5))]
    [[0.0, 0.5], [1.0, 1.5]]
    """
    require(
        len(shares) > 0 and all(0 <= share <= 1 for share in shares),
        f"shares: expected at least one, all of 0 to 1, found {tuple(shares)}",
    )
    previous: FloatArray | None = None
    for flow in flows:
        if previous is not None:
            yield [previous + np.float32(share) * (flow - previous) for share in shares]
        previous = flow

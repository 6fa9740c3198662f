"""Frames sorted by quality, and what keeping a share of them costs and gains, as people who stack know it.

Symbols
-------
q_k : quality of frame k, :func:`turbrestore.footage.frame_selection.frame_quality`, without what noise adds to it
a_k : √q_k, amplitude of its fine detail over its brightness; ā(n) mean of the n largest
z : noise of a frame over the mean brightness; f : 0.002 over that brightness, what models are wrong by
n : frames that are kept, of T

The mean of n registered frames has the mean amplitude of their detail and the noise ``z / √n``.  So sharpness gains
``ā(n) / ā(T)`` and noise costs ``√(T / n)``.  What a share is worth is ``ā(n) / √(z² / n + f²)`` over that of all
frames: by how much more detail exceeds noise and error.  The share that is worth most is suggested, if it is worth more
than all frames beyond the scatter of such figures.  Frames that barely differ are all worth keeping, and a few
that the air has spared are worth more than the rest only where noise is low.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray, luminance
from ..core.noise import estimate_noise
from ..footage.frame_selection import DARK, best_frames, frame_quality
from ..results import FEW

# Shares that are listed, chosen.
SHARES = (0.1, 0.25, 0.5)
# Error of the models of blur and registration, intensity, as in Wiener deconvolution.
_ERROR = 0.002
# What a share has to be worth, chosen; at least as many frames are suggested as whose halves tell what they agree on.
_WORTHWHILE = 1.05
# Best frames, and worst ones, that are listed, chosen.
_LISTED = 10
# Side of the image that the filter of the quality is tried on, pixels: any that holds the filter does.
_SIDE = 64


@dataclass(frozen=True)
class KeptShare:
    """What keeping the best frames means."""

    share: float  # of the frames, 0 to 1
    frames: int
    noise: float  # of their mean over that of the mean of all frames
    sharpness: float  # fine detail of their mean over that of all frames, if both are registered
    worth: float  # by how much more detail exceeds noise and error than with all frames, as a ratio

    @property
    def percent(self) -> int:
        """The share in whole percent: the nearest that keeps no fewer frames."""
        nearest = round(100 * self.share)
        # A share of a frame counts as a frame.
        keeps = math.ceil(round(nearest / 100 * self.frames / self.share, 9))
        return nearest if keeps >= self.frames else nearest + 1


@dataclass(frozen=True, eq=False)
class QualityList:
    """Quality of the frames of a clip."""

    quality: NDArray[np.float64]  # (T,): q_k, in the order of the frames
    kept: tuple[KeptShare, ...]  # for 10, 25 and 50 % of the frames
    suggested: KeptShare | None  # None where all frames are better

    @property
    def order(self) -> NDArray[np.int64]:
        """Places of the frames, the best first."""
        return np.argsort(-self.quality, kind="stable")


def measure_quality(frames: Iterable[FloatArray]) -> NDArray[np.float64]:
    """Quality, noise and mean brightness of every frame, (T, 3)."""
    greys = map(luminance, frames)
    return np.array([(frame_quality([grey])[0], estimate_noise(grey), max(grey.mean(), DARK)) for grey in greys])


def sort_by_quality(measured: NDArray[np.float64]) -> QualityList:
    """Sort frames that were measured."""
    raw, noise, level = measured.T
    quality = np.maximum(raw - _noise_energy() * (noise / level) ** 2, 0.0)
    z, f = float(np.median(noise / level)), _ERROR / float(np.median(level))
    sizes = np.arange(1, len(quality) + 1)
    means = np.cumsum(np.sort(np.sqrt(quality))[::-1]) / sizes
    worth = means / np.sqrt(z**2 / sizes + f**2)
    least = min(FEW, len(sizes)) - 1
    best = least + int(np.argmax(worth[least:]))

    def keeping(count: int) -> KeptShare:
        gain = means[count - 1] / means[-1] if means[-1] > 0 else 1.0
        times = worth[count - 1] / worth[-1] if worth[-1] > 0 else 1.0
        return KeptShare(count / len(quality), count, float(np.sqrt(len(quality) / count)), float(gain), float(times))

    kept = tuple(keeping(int(best_frames(quality, share).sum())) for share in SHARES)
    found = keeping(best + 1)
    return QualityList(quality, kept, found if found.worth > _WORTHWHILE else None)


def quality_table(found: QualityList, numbers: Iterable[int]) -> str:
    """Write the list for a terminal: what shares cost and gain, and the best and the worst frames."""
    names = list(numbers)
    lines = ["share kept   frames   noise   sharpness   worth"]
    rows = [(f"{one.percent}%", one) for one in found.kept]
    if found.suggested is not None:
        rows.append((f"{found.suggested.percent}% *", found.suggested))
    lines += [
        f"{name:<10} {one.frames:>8} {one.noise:>6.2f}× {one.sharpness:>10.2f}× {one.worth:>6.2f}×"
        for name, one in rows
    ]
    all_better = "no share is suggested, as none is clearly worth more than all frames"
    lines += [f"worth: detail over noise and error; {all_better if found.suggested is None else '* suggested'}"]
    lines += ["restore weighs frames by itself", ""]
    top = float(found.quality.max()) or 1.0
    order = found.order
    places: list[int | None] = list(range(len(order)))
    if len(order) > 2 * _LISTED:
        places[_LISTED:-_LISTED] = [None]
    lines.append("rank    frame   quality")
    for place in places:
        if place is None:
            lines.append("   …")
            continue
        share = found.quality[order[place]] / top
        lines.append(f"{place + 1:>4} {names[order[place]]:>8}   {share:>6.1%} {'▇' * round(30 * share)}")
    return "\n".join(lines)


def _noise_energy() -> float:
    """Energy of the filter of the quality: its response to one bright pixel, squared and summed."""
    impulse = np.zeros((_SIDE, _SIDE), np.float32)
    impulse[_SIDE // 2, _SIDE // 2] = 1
    # The quality of an image is its energy a pixel over its squared mean.
    return float(frame_quality([impulse])[0]) * max(float(impulse.mean()), DARK) ** 2 * impulse.size

"""The blur of what has two tones: letters, charts, signs, and all else with flat parts and sharp edges.

In a small tile of such a scene every pixel has one of two levels, but for those that an edge crosses.  A blur spreads
the levels between the two.  Without it they part again; and where too wide a blur is removed, rings spread them anew.
So the right width is the one without which the tiles have two tones most clearly.  The air, the lens and the frames
need not be known, and where a scene is like that, no other witness is as exact.

Symbols
-------
f, u : image, and the image without a blur of width σ by a Wiener filter
a, b : the two levels of a tile of u
v(σ) : spread about the two levels of a tile relative to their distance, the mean of
    ``min((u − a)², (u − b)²) / (b − a)²`` over its pixels and over the tiles, weighted by their variances in f
d : depth of the least v, ``ln v(σ) − ln v`` from the narrowest σ that is tried, at which u is nearly f

Scenes that only resemble one of two tones do not tell the width this way, but the likelihood of their gradients does
(:mod:`turbrestore.blur.learnt`).

The filter passes ``H / (H² + N / S)`` with the spectrum N of the noise; the power S of the scene falls as ν^−2, as that
of photographs does (Field 1987), and its mean is the variance of f.

In white noise v is 1/7, and on a ramp, whose levels are all alike, 1/12.  Noise on a ramp thus has its least v where
the noise has been smoothed, though the ramp has no two tones; so v also has to be below half that of a ramp.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import ROUNDING, FloatArray
from ...core.noise_spectrum import NoiseSpectrum
from ...core.thresholds import threshold
from ..psf import Float64Array, blur_otf

# Widths that are tried, pixels, chosen.  The networks read at these too, so that others ask for networks that are
# trained anew on clips that are made anew.
GRID: Float64Array = np.geomspace(0.3, 9.0, 14)


@dataclass(frozen=True)
class _Thresholds:
    """What tells a scene of two tones from others.

    Measured on 1,731 training clips of ``benchmarks/blur_training.py``, of which about 27 have two tones.  Gains are
    over the width that networks choose which were not trained on the clip; ``benchmarks/decisions/blur.md`` has those
    over the networks of today.
    """

    # Side of a tile: a letter or some bars.
    tile: int = threshold(16, "pixels", "measured: gains 0.8 dB; 24 pixels gain 0.4 dB, and 36 lose 0.3")
    # Least depth d of a scene of two tones, and its largest v.
    depth: float = threshold(0.45, "1", "measured: gains 0.8 dB on the 27 clips above; loses 0.5 dB from 0.40 to 0.45")
    spread: float = threshold(1 / 24, "1", "theory: half of the v of a ramp")
    # d from which a scene resembles one of two tones, and the width of a blur beyond which tiles do not show whether it
    # does.
    resembling: float = threshold(
        0.1, "1", "measured: 1,579 clips gain 1.20 dB, 396 others 0.56; 1.20 and 0.56 at 0.05, 1.19 and 0.57 at 0.15"
    )
    unseen: float = threshold(
        3.0, "pixels", "theory: the width at half maximum is half of a tile at 3.4 pixels; less, to be safe"
    )
    # The width that is told over that of the least v, and the deviation of its logarithm.
    width: float = threshold(0.95, "1", "measured: 0.90 and 0.95 gain 0.8 dB, 1.00 gains 0.5")
    deviation: float = threshold(0.12, "1", "measured: scatter of the minimum over the true width on these clips")
    # Least noise of an image: less would regain nothing but what registration has left.
    noise: float = threshold(1 / (255 * 12**0.5), "intensity", "bits: deviation of the rounding to 8 bits")
    # Steps to the two levels of a tile.
    steps: int = threshold(6, "steps", "cost: twenty tell the same width within 1 %")


LIMITS = _Thresholds()


class TwoTones(NamedTuple):
    """What the two tones of an image tell of its blur."""

    width: float  # pixels
    depth: float  # d; 0 where the least v is that of the widest or the narrowest blur
    spread: float  # least v

    @property
    def clear(self) -> bool:
        """Whether the scene has two tones, so that the width is known."""
        return self.depth >= LIMITS.depth and self.spread <= LIMITS.spread

    def may_be(self, width: float) -> bool:
        """Whether the scene resembles one of two tones, or whether a blur of this width, pixels, hides what it is."""
        return self.depth > LIMITS.resembling or width > LIMITS.unseen

    @property
    def quantiles(self) -> Float64Array:
        """16 %, 50 % and 84 % quantiles of the width (3,), pixels."""
        return self.width * np.exp(LIMITS.deviation * np.array([-1.0, 0.0, 1.0]))


def two_tones(image: FloatArray, noise: NoiseSpectrum, exponent: float) -> TwoTones | None:
    """Find the width, for a shape of the blur, without which an image (H, W) has two tones most clearly.

    None where the image is too small or flat.
    """
    if min(image.shape) < 2 * LIMITS.tile:
        return None
    weights = _tiles(image).var(axis=1)
    # The flatter half of the tiles holds no edge, or only part of one.
    chosen = weights >= np.median(weights)
    if weights.max() <= ROUNDING:
        return None
    spreads = [_spread(_tiles(one)[chosen], weights[chosen]) for one in _without_blur(image, noise, exponent)]
    curve = np.log(spreads)
    least = int(curve.argmin())
    if not 0 < least < len(curve) - 1:
        return TwoTones(LIMITS.width * float(GRID[least]), 0.0, float(spreads[least]))
    before, here, after = curve[least - 1 : least + 2]
    step = (before - after) / (2 * (before - 2 * here + after))
    width = LIMITS.width * float(GRID[least] * (GRID[1] / GRID[0]) ** step)
    return TwoTones(width, float(curve[0] - here), float(spreads[least]))


def _without_blur(image: FloatArray, noise: NoiseSpectrum, exponent: float) -> list[FloatArray]:
    """Images, less their mean, without a blur of every width."""
    padded = np.pad(image - image.mean(), LIMITS.tile, mode="reflect")
    spectrum = np.fft.rfft2(padded)
    nu = np.hypot(np.fft.fftfreq(padded.shape[0])[:, None], np.fft.rfftfreq(padded.shape[1]))
    power = np.maximum(nu, 1 / max(padded.shape)) ** -2
    ratio = np.maximum(noise.at(nu), LIMITS.noise**2) * power.mean() / (power * image.var())
    inside = slice(LIMITS.tile, -LIMITS.tile), slice(LIMITS.tile, -LIMITS.tile)
    results = []
    for width in GRID:
        otf = blur_otf(padded.shape, float(width), exponent)
        results.append(np.fft.irfft2(spectrum * otf / (otf**2 + ratio), padded.shape)[inside].astype(np.float32))
    return results


def _tiles(image: FloatArray) -> FloatArray:
    """Tiles of an image (H, W) as (n, pixels), without what is left over at its end."""
    rows, columns = (size // LIMITS.tile for size in image.shape)
    cut = image[: rows * LIMITS.tile, : columns * LIMITS.tile].reshape(rows, LIMITS.tile, columns, LIMITS.tile)
    return cut.swapaxes(1, 2).reshape(rows * columns, -1)


def _spread(tiles: FloatArray, weights: NDArray[np.floating]) -> float:
    """Return v of tiles (n, pixels), whose two levels are found by 2-means from the least and the largest value."""
    low, high, total = tiles.min(axis=1), tiles.max(axis=1), tiles.sum(axis=1)
    for _ in range(LIMITS.steps):
        above = tiles > ((low + high) / 2)[:, None]
        count = above.sum(axis=1)
        bright = (tiles * above).sum(axis=1)
        high, low = bright / np.maximum(count, 1), (total - bright) / np.maximum(tiles.shape[1] - count, 1)
    nearest = np.minimum(np.square(tiles - low[:, None]), np.square(tiles - high[:, None]))
    return float((nearest.mean(axis=1) / np.maximum(np.square(high - low), ROUNDING**2)) @ weights / weights.sum())

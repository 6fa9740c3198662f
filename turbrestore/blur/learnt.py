"""The blur to remove, learnt from simulated clips whose scene is known.

Symbols
-------
x : what the witnesses say, standardised: widths by every witness and by their posterior, s and s_4, the spectrum of the
    image, that of its noise, the ratio to that of the mean of the frames, costs of the image, and the distribution of
    its levels and gradients
σ, p : width and exponent of the transfer function of the image; see :func:`turbrestore.blur.psf.blur_otf`
σ_16 : width that, by the posterior, is exceeded with a probability of 84 %
G : gain, decibels, by which the visible error ``e² + e_0²`` falls where a blur of some width is removed, whose exponent
    is that of the posterior; e² is the mean squared error, and e_0² that of 38 dB, below which no error is seen

A few small networks, trained alike from different starts, map x to ln σ with its deviation, and to G on a grid of
widths; widths are relative to that of the posterior, which is about right at every scale.  Their mean counts, and their
scatter adds to the deviation.  Of the widths whose G is as good as the largest, but for a difference that is not seen,
the widest is chosen that is no wider than σ or than the best.

What is removed is the narrower of two widths, this one and its geometric mean with σ_16.  Where the scene may have two
tones, or the blur is too wide to tell (:mod:`.witnesses.two_tones`), it is the median of these and of the width that
the image alone tells, which so chooses between the two; that is 0 where the image shows no blur.  Where G expects a
loss from the median, the narrower of the two is removed; where G expects one from that too, nothing is.
The networks know more simulators than the theory of the posterior, and are wrong where a clip is like none of them; the
posterior errs elsewhere, most of all where it has two peaks.  The image alone is right about text, charts and signs,
and takes textures and soft scenes for blurred ones.
``benchmarks/decisions/blur.md`` compares them.

``python benchmarks/blur_training.py`` makes the clips, trains and judges the networks, and with ``--weights`` writes
``learnt_blur.npz``.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.arrays import ROUNDING, FloatArray
from ..core.noise_spectrum import NoiseSpectrum
from .psf import Float64Array
from .witnesses.image_evidence import ImageEvidence
from .witnesses.spectral_variation import RINGS, SIDE, SpectralVariation, window_power, window_weights
from .witnesses.two_tones import GRID, TwoTones

# Grid of G: widths relative to that of the posterior, the first of which is no blur; chosen.
FACTORS: Float64Array = np.array([0, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.15, 1.35, 1.6, 2.0, 2.6])
# Rings whose values are read, chosen.
_PICKED = np.array([1, 2, 3, 4, 5, 6, 8, 10, 12, 14, 17, 20, 24, 28])
# Costs of a gradient above this are all the same, and so many gradients make a unit (κ_m); both chosen.
_DEAREST, GRADIENTS = 20.0, 40.0
# Decibels by which a wider blur may gain less (benchmarks/decisions/blur.md), and number of factors that are tried.
_ALIKE, _TRIED = 0.2, 200
# Least and largest logarithm of the deviation that a network is trained to say: 5 % and a factor of e; chosen.
LOG_SPREADS = (-3.0, 1.0)
# Standardised values beyond this were hardly seen in training; chosen.
FARTHEST = 4.0
# Reductions at which gradients are read, octaves; the shortest side that they leave has as many pixels as the largest.
_SCALES = (1, 2, 4, 8)


@dataclass(frozen=True, eq=False)
class LearntBlur:
    """What the networks say about the blur of an image, and what follows from them, the posterior and the image."""

    width: Float64Array  # (3,): 16 %, 50 % and 84 % quantiles of the width, pixels
    median: float  # width of the blur to remove if the image alone has a say, pixels; 0 if a loss is expected
    cautious: float  # the narrower of the two widths that the image alone chooses between, pixels; 0 likewise

    def chosen(self, tones: TwoTones | None) -> float:
        """Width of the blur to remove, pixels: the image alone has a say if the scene may have two tones."""
        votes = tones is not None and tones.may_be(float(self.width[1]))
        return self.median if votes else self.cautious


def blur_features(
    image: FloatArray,
    widths: NDArray[np.floating],
    variation: SpectralVariation | None,
    ratio: Float64Array | None,
    evidence: ImageEvidence,
    noise: NoiseSpectrum,
    facts: tuple[float, float, float, float],
) -> Float64Array:
    """Return what the networks read, NaN where it is not known.

    ``image`` (H, W); ``widths`` are the quantiles by the witnesses and by their posterior, pixels; ``ratio`` is that of
    the spectrum of the image to that of the mean of the frames; ``noise`` is that of the image; ``facts`` are the
    probability of air, the exponent of the posterior, the variance of the displacement and the number of independent
    frames.
    """
    air, exponent, displacement, frames = facts
    unknown = np.full(len(_PICKED), np.nan)
    of_noise = noise.at(RINGS) * float(np.square(window_weights()).sum())
    power = _spectrum(image)
    rows = [
        _log(np.ravel(widths), 0.05),
        [air, exponent, *_log([displacement], 1e-3), *_log([frames], 1.0)],
        _log(power / power[1:4].mean(), 1e-8)[_PICKED],
        np.clip(_log(power / of_noise, 1e-2), -1, 9)[_PICKED],
        _log([noise.deviation], 1e-5),
        _log([float(image.std())], 1e-4),
        _log([of_noise[4] / of_noise[20]], 1e-3),
    ]
    if variation is None or ratio is None:
        rows += [[np.nan, np.nan], unknown, unknown, unknown, unknown]
    else:
        rows += [
            [np.log(variation.reduction), *_log([variation.stretch], 1e-3)],
            _log(variation.amplitude, 1e-4)[_PICKED],
            _log(variation.power, 1e-4)[_PICKED],
            np.clip(_log(variation.signal, 1e-2), -3, 9)[_PICKED],
            _log(ratio, 0.05)[_PICKED],
        ]
    costs, estimate = evidence.costs - evidence.costs.min(), evidence.estimate
    for curve in costs:
        read = GRADIENTS * np.interp(np.log(GRID), np.log(evidence.widths), curve)
        rows += [[np.log(evidence.widths[curve.argmin()]), min(GRADIENTS * curve.min(), _DEAREST)]]
        rows += [np.minimum(read, _DEAREST)]
    rows += [_log([estimate.sigma], 0.05), [np.log(estimate.reduction)], _log([estimate.noise], 1e-5)]
    rows += [_distribution(image)]
    return np.concatenate([np.asarray(row, np.float64) for row in rows])


def learnt_blur(
    features: Float64Array,
    widths: Float64Array,
    alone: float,
    weights: Mapping[str, NDArray[np.floating]] | None = None,
) -> LearntBlur:
    """Evaluate the networks of the package, or others.

    ``widths`` (3,) are the quantiles of the posterior, and ``alone`` is the width by the image alone, pixels; 0 where
    it finds no blur.
    """
    weights = _weights() if weights is None else weights
    # What is not known is taken for usual.
    x = np.clip(np.nan_to_num((features - weights["middle"]) / weights["scale"]), -FARTHEST, FARTHEST)
    x = np.broadcast_to(x, (len(weights["w1"]), len(x)))
    for layer in "12":
        x = np.einsum("nij,nj->ni", weights[f"w{layer}"], x) + weights[f"b{layer}"]
        x = x / (1 + np.exp(-x))
    out = np.einsum("nij,nj->ni", weights["w3"], x) + weights["b3"]
    spread = float(np.sqrt(np.mean(np.exp(2 * np.clip(out[:, 1], *LOG_SPREADS))) + out[:, 0].var()))
    low, usual = float(widths[0]), float(widths[1])
    quantiles = usual * np.exp(out[:, 0].mean() + spread * np.array([-1.0, 0.0, 1.0]))
    gains = out[:, 2:].mean(axis=0)
    gains = gains - gains[0]
    bold = usual * _widest(gains, float(quantiles[1]) / usual)
    middling = (bold * low) ** 0.5
    candidates = sorted((bold, middling, alone))[1], min(bold, middling)
    safe = [width if np.interp(width / usual, FACTORS, gains) >= 0 else 0.0 for width in candidates]
    return LearntBlur(quantiles, safe[0] or safe[1], safe[1])


def _widest(gains: Float64Array, most: float) -> float:
    """Widest factor whose gain falls little short of the best and of none, at most the given or the best; or 0."""
    tried = np.linspace(FACTORS[1], FACTORS[-1], _TRIED)
    found = np.interp(tried, FACTORS, gains)
    most = max(most, float(tried[found.argmax()]))
    good = tried[(found >= max(float(found.max()), 0.0) - _ALIKE) & (tried <= most)]
    return float(good.max()) if good.size else 0.0


def _spectrum(image: FloatArray) -> Float64Array:
    """Power spectrum of an image by ring; NaN if it is too small for a window."""
    return window_power(image) if min(image.shape) >= SIDE * 3 // 2 else np.full(len(RINGS), np.nan)


def _distribution(image: FloatArray) -> list[float]:
    """Skewness and kurtosis of the levels, and sparsity of the gradients at some scales: text looks like no photograph.

    The latter is the mean size of a difference over the root of its mean square, as a logarithm.
    """
    level = (image - image.mean()) / max(float(image.std()), ROUNDING)
    found = [float(np.mean(level**3)), float(np.log(max(np.mean(level**4), 1.0)))]
    for scale in _SCALES:
        size = image.shape[1] // scale, image.shape[0] // scale
        if min(size) < _SCALES[-1]:
            found.append(np.nan)
            continue
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        steps = np.concatenate([np.diff(small, axis=0).ravel(), np.diff(small, axis=1).ravel()])
        found.append(float(np.log(max(np.abs(steps).mean(), ROUNDING) / max(float(steps.std()), ROUNDING))))
    return found


def _log(values: object, least: float) -> Float64Array:
    """Logarithm of values of at least ``least``; NaN stays."""
    return np.log(np.maximum(np.asarray(values, np.float64), least))


@functools.cache
def _weights() -> dict[str, Float64Array]:
    """Layers of the networks (n, outputs, inputs), and middle and scale of the features."""
    path = files("turbrestore.blur").joinpath("learnt_blur.npz")
    with path.open("rb") as stream, np.load(stream, allow_pickle=False) as held:
        # Beside the weights the file says from which revision, command and clips it is, and how well they do.
        return {name: held[name].astype(np.float64) for name in held.files if name != "about"}

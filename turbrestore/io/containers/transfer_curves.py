"""HDR video as SDR: light of HLG and PQ codes, with what is brighter than white rolled off.

Symbols
-------
E : code, 0 to 1; L : display light of a channel, in units of reference white, 203 cd/m² (ITU-R BT.2408)
v : largest channel of a pixel in BT.709; P : peak of a display of 1000 cd/m², in the same units

HLG is shown as on a display of 1000 cd/m² with system gamma 1.2, PQ as it says (ITU-R BT.2100).  After the change from
the primaries of BT.2020 to those of BT.709, a pixel is multiplied by f(v) / v: f(v) = v up to ``_KNEE``, and above
``f = _KNEE + (1 - _KNEE) u (1 + u / w²) / (1 + u)`` with u = (v - _KNEE) / (1 - _KNEE) and w = u(P) (Reinhard et al.
2002, equation 4), so that hue stays and P becomes white.  The SDR code is L^(1/2.2).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from functools import cache

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import ROUNDING
from ..pixels import PixelArray

# Numbers of transfer characteristics and primaries in ITU-T H.273.
BT709, UNKNOWN, BT2020 = 1, 2, 9
PQ, HLG = 16, 18
_LOG = {9: "logarithmic codes", 10: "logarithmic codes"}
# See the docstring; the knee was chosen, and the gamma is about that of sRGB.
_WHITE, _PEAK, _KNEE = 203.0, 1000.0 / 203.0, 0.75
_GAMMA = 2.2
# Luminance of BT.2020, and the change to the primaries of BT.709; both follow from the primaries and the white.
_LUMINANCE_2020 = np.array([0.2627, 0.6780, 0.0593], np.float32)
_TO_BT709 = np.array([[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]], np.float32)
# Curves that cameras record for grading, as metadata name them.
_LOG_NAMES = re.compile(r"\b([sv]-?log\s?\d?|c-?log\s?\d?|[nfdl]-?log\s?\d?|apple ?log\s?\d?|logc\d?)\b", re.IGNORECASE)
CURVES = {PQ: "PQ", HLG: "HLG"}


def sdr_of(transfer: int) -> Callable[[PixelArray], PixelArray]:
    """Return the function that turns HDR codes, RGB of 16 bits, into SDR codes of 16 bits."""
    table = _light_of_codes(transfer)

    def converted(codes: PixelArray) -> PixelArray:
        light = table[codes]
        if transfer == HLG:
            # The system gamma acts on luminance; white of the scene is that of the display.
            luminance = np.maximum(light @ _LUMINANCE_2020, ROUNDING)
            light *= (_PEAK * luminance**0.2)[..., None]
        light = np.maximum(light @ _TO_BT709.T, 0)
        brightest = np.maximum(light.max(axis=-1, keepdims=True), ROUNDING)
        light *= _rolled_off(brightest) / brightest
        return np.rint(65535 * np.minimum(light, 1) ** np.float32(1 / _GAMMA)).astype(np.uint16)

    return converted


def remark_on_curve(transfer: int, metadata: Mapping[str, str], kept: bool) -> tuple[str, ...]:
    """Say how HDR is read, or that values are codes of a curve for grading."""
    if transfer in CURVES:
        name = CURVES[transfer]
        if kept:
            return (f"HDR ({name}) is kept: images hold its codes, which viewers show too flat",)
        return (f"HDR ({name}) is read as the SDR picture, with highlights rolled off; --hdr keep keeps its codes",)
    found = next((match[1] for text in metadata.values() if (match := _LOG_NAMES.search(str(text)))), None)
    curve = _LOG.get(transfer) or found
    if curve is None:
        return ()
    return (f"values are {curve}, which looks flat; convert the video, or grade the result as you would grade it",)


@cache
def _light_of_codes(transfer: int) -> NDArray[np.float32]:
    """Light of every code of 16 bits: of the display for PQ, in units of white; of the scene for HLG, 0 to 1."""
    code = np.arange(65536) / 65535
    if transfer == PQ:
        power = code ** (1 / 78.84375)
        light = np.maximum(power - 0.8359375, 0) / (18.8515625 - 18.6875 * power)
        return np.asarray(10000 / _WHITE * light ** (1 / 0.1593017578125), np.float32)
    high = (np.exp((code - 0.55991073) / 0.17883277) + 0.28466892) / 12
    return np.where(code <= 0.5, code**2 / 3, high).astype(np.float32)


def _rolled_off(light: NDArray[np.float32]) -> NDArray[np.float32]:
    above, widest = (np.maximum(light - _KNEE, 0) / (1 - _KNEE)), (_PEAK - _KNEE) / (1 - _KNEE)
    rolled = _KNEE + (1 - _KNEE) * above * (1 + above / widest**2) / (1 + above)
    return np.where(light > _KNEE, rolled, light).astype(np.float32)

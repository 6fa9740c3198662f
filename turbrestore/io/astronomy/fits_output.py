"""FITS images out: the header of the input goes with them, and what was done is their history."""

from __future__ import annotations

import os
import re
import unicodedata
import warnings
from collections.abc import Iterable, Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.arrays import FloatArray, check_image, from_unit_to_type
from ..output import atomic_output, check_output, check_space, frames_of_one_size
from ..pixels import PixelArray, at_levels, check_depth
from .fits_header import astropy_fits

if TYPE_CHECKING:
    from astropy.io.fits import Header

FITS_OUTPUT_SUFFIX = ".fits"
# What describes the numbers and the further axes of the input, beside what Astropy takes for structure.
_ABOUT_NUMBERS = re.compile(
    r"EXTNAME|EXTVER|BLANK|BUNIT|DATAMIN|DATAMAX|CHECKSUM|DATASUM|BAYERPAT|[XY]BAYROFF|WCSAXES|"
    r"(CTYPE|CRVAL|CRPIX|CDELT|CUNIT|CROTA|CNAME)[3-9]|(CD|PC)(\d_[3-9]|[3-9]_\d)"
)


def write_fits(
    path: str | os.PathLike[str],
    image: ArrayLike,
    bit_depth: int | None = None,
    overwrite: bool = False,
    *,
    header: Sequence[str] = (),
    history: Iterable[str] = (),
    origin: tuple[int, int] = (0, 0),
    uncertainty: FloatArray | None = None,
    levels: tuple[float, float] | None = None,
    flows: FloatArray | None = None,
) -> None:
    """Write an image as FITS; the same image and header give the same bytes.

    ``image`` (H, W) or (H, W, 3); ``uncertainty`` (H, W); ``flows`` (T, H, W, 2).
    """
    path = Path(path)
    check_output(path, overwrite=overwrite, suffixes=(FITS_OUTPUT_SUFFIX,))
    fits = astropy_fits()
    pixels = from_unit_to_type(check_image(image, "image"), check_depth(32 if bit_depth is None else bit_depth))
    pixels = at_levels(pixels, levels)
    if levels is not None and uncertainty is not None and pixels.dtype.kind == "f":
        uncertainty = uncertainty * np.float32(levels[1] - levels[0])
    check_space(path, pixels.nbytes + sum(array.nbytes for array in (uncertainty, flows) if array is not None))
    with warnings.catch_warnings():
        # Cards of the input that break rules are written as they are, or repaired.
        warnings.simplefilter("ignore")
        images = [fits.PrimaryHDU(_planes_first(pixels), _kept(header, origin, fits))]
        for line in history:
            images[0].header.add_history(_ascii(line))
        if uncertainty is not None:
            images.append(fits.ImageHDU(uncertainty.astype(np.float32), name="UNCERT"))
        if flows is not None:
            images.append(fits.ImageHDU(np.moveaxis(flows, -1, 1).astype(np.float32), name="FLOW"))
            images[-1].header["BUNIT"] = "pixel"
        with atomic_output(path, overwrite) as temporary, temporary.open("wb") as file:
            fits.HDUList(images).writeto(file, output_verify="silentfix+ignore")


def write_fits_cube(
    path: str | os.PathLike[str],
    frames: Iterable[FloatArray],
    count: int,
    bit_depth: int,
    overwrite: bool = False,
    *,
    history: Iterable[str] = (),
    levels: tuple[float, float] | None = None,
) -> None:
    """Write a known number of frames, taken one at a time, as a cube (T, H, W), or (T, 3, H, W) in colour.

    ``frames`` (H, W) or (H, W, 3) each.
    """
    fits, stream = astropy_fits(), frames_of_one_size(frames, path)
    depth, first = check_depth(bit_depth), next(stream)
    images = (_planes_first(at_levels(from_unit_to_type(frame, depth), levels)) for frame in chain([first], stream))
    with warnings.catch_warnings(), atomic_output(path, overwrite) as temporary:
        warnings.simplefilter("ignore")
        pixels = _planes_first(from_unit_to_type(first, depth))[None]
        check_space(path, count * pixels.nbytes)
        header = fits.PrimaryHDU(pixels).header
        header[f"NAXIS{pixels.ndim}"] = count
        for line in history:
            header.add_history(_ascii(line))
        # FITS has no unsigned numbers of 16 bits: zero is written as the least signed one.
        middle = header.get("BZERO", 0)
        with fits.StreamingHDU(str(temporary), header) as cube:
            for pixels in images:
                cube.write((pixels.astype(np.int32) - int(middle)).astype(np.int16) if middle else pixels)


def _kept(cards: Sequence[str], origin: tuple[int, int], fits: Any) -> Header:
    """Cards of the input that are still true of the image."""
    if not cards:
        # The rows of other formats begin at the top, those of a FITS file where its writer has begun.
        return fits.Header({"ROWORDER": "TOP-DOWN"})
    header, before = fits.Header(), fits.Header.fromstring("".join(cards).encode("ascii", "replace"))
    before.strip()
    for card in before.cards:
        if card.keyword and not _ABOUT_NUMBERS.fullmatch(card.keyword):
            # A card that cannot be read has nothing to keep.
            with suppress(ValueError, fits.VerifyError):
                header.append(fits.Card(card.keyword, card.value, card.comment), end=True)
    for place, name in enumerate(("CRPIX1", "CRPIX2")):
        if isinstance(header.get(name), int | float):
            header[name] -= origin[place]
    return header


def _planes_first(pixels: PixelArray) -> PixelArray:
    return pixels if pixels.ndim == 2 else np.ascontiguousarray(np.moveaxis(pixels, -1, 0))


def _ascii(line: str) -> str:
    """Letters that FITS has; Greek ones by their names would be longer, so that they become question marks."""
    plain = unicodedata.normalize("NFKD", line).encode("ascii", "replace").decode()
    return "".join(letter if letter.isprintable() else " " for letter in plain)

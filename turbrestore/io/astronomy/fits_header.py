"""Where the image of a FITS file lies, and what its numbers mean; headers are checked before any data are read.

Astropy reads the cards of a header, and would read one without an end as a whole, however long. Headers are therefore
looked up here, one after the other, and compared with the limits before anything else is read.
"""

from __future__ import annotations

import gzip
import math
import re
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from ...core.errors import DataError
from ...core.extras import missing_package
from ...core.remarks import Doubt
from ..limits import Limits, check_input, format_errors, input_errors
from ..pixels import BAYER_CODES

if TYPE_CHECKING:
    from astropy.io.fits import Header

FITS_SUFFIXES = (".fits", ".fit", ".fts")
_BLOCK = 2880
_PIECE = 1 << 20
# Most cards of a header, a thousand blocks of them, and most headers of a file before its first image; both chosen.
_MOST_CARDS, _MOST_HEADERS = 36_000, 100
# Images of this name show the scene, and those of the other names say something about it.
_SCENE = "SCI"
_ABOUT_SCENE = {"ERR", "ERROR", "DQ", "VAR", "STAT", "WHT", "WEIGHT", "CTX", "MASK", "UNCERT", "SIGMA", "FLOW", "BPM"}
_TYPES = {8: "u1", 16: ">i2", 32: ">i4", 64: ">i8", -32: ">f4", -64: ">f8"}
_DAMAGED = "not a FITS file, or damaged"
_CUT = "the file is cut short; copy it again"


@dataclass(frozen=True, eq=False)
class FitsImage:
    """An image of a FITS file."""

    path: Path
    cards: tuple[str, ...]  # the header without its end, 80 characters each
    shape: tuple[int, ...]  # in the order of NumPy, the fastest axis last
    dtype: np.dtype[Any]  # of the numbers in the file
    offset: int  # of the first number, bytes
    scale: tuple[float, float]  # BSCALE and BZERO: the value of a number is BSCALE · number + BZERO
    blank: int | None  # integer that marks a missing value
    notes: tuple[str, ...]  # what is unusual
    # Colours of the first pixels of the file, where the header says that they are those of a Bayer sensor.
    bayer: str | None = None
    name: str = ""  # EXTNAME without a number at its end, in capitals
    tiles: int | None = None  # number of the extension, if the image is compressed in tiles

    @property
    def kind(self) -> tuple[object, ...]:
        """What images of one video have in common."""
        return self.shape, self.dtype, self.bayer

    def numbers(self, limits: Limits) -> NDArray[Any]:
        """Map the numbers of the file into memory, or load them from a compressed file."""
        with input_errors(self.path), format_errors(self.path, _DAMAGED):
            if self.tiles is None and not _is_compressed(self.path):
                return np.memmap(self.path, self.dtype, "r", self.offset, self.shape)
            end = self.offset + math.prod(self.shape) * self.dtype.itemsize
            limits.check_bytes(end, str(self.path))
            if self.tiles is not None:
                with _astropy_file(self.path) as tiled:
                    return np.array(tiled[self.tiles].data)
            with _opened(self.path) as file:
                data = file.read(end)
                # The checksum is at the end; the images that follow it are skipped.
                for _ in range(end, limits.max_bytes, _PIECE):
                    if not file.read(_PIECE):
                        break
            if len(data) < end:
                raise DataError(f"{self.path}: expected {end} bytes, found {len(data)}; {_CUT}")
            return np.frombuffer(data, self.dtype, offset=self.offset).reshape(self.shape)


def is_fits(path: Path) -> bool:
    """Whether a name is that of a FITS file: .fits, .fit or .fts, one of them with .gz or .fz, or .fz alone."""
    name = path.name.lower()
    return name.endswith(".fz") or name.removesuffix(".gz").endswith(FITS_SUFFIXES)


def astropy_fits() -> Any:
    """Return the module ``astropy.io.fits``; raise ConfigurationError where it is not installed."""
    try:
        from astropy.io import fits
    except ImportError as error:
        raise missing_package("FITS", "astropy", "fits") from error
    return fits


def find_images(path: Path, limits: Limits) -> tuple[FitsImage, ...]:
    """Find the images of the scene in a FITS file; nothing but headers is read."""
    found: list[FitsImage] = []
    with format_errors(path, _DAMAGED), warnings.catch_warnings():
        # Astropy warns of cards that break rules, and reads them.
        warnings.simplefilter("ignore")
        for image in _images(path, limits):
            found.append(image)
            if image.name == _SCENE and len(image.shape) > 2:
                break
            if len(found) == 1 and len(image.shape) > 2 and image.name not in _ABOUT_SCENE:
                break
    if not found:
        raise DataError(f"{path}: expected an image of two axes or more, found none")
    named = [image for image in found if image.name == _SCENE]
    first = (named or [image for image in found if image.name not in _ABOUT_SCENE] or found)[0]
    if len(first.shape) > 2:
        return (first,)
    return tuple(image for image in found if (image.kind, image.name) == (first.kind, first.name))


def _images(path: Path, limits: Limits) -> Iterator[FitsImage]:
    """Yield the images of a file in their order, as their headers describe them."""
    fits = astropy_fits()
    size, count = check_input(path).st_size, 0
    with input_errors(path), _opened(path) as file:
        for index in range(limits.max_frames + _MOST_HEADERS):
            cards = _read_cards(path, file, first=index == 0)
            if not cards or (index >= _MOST_HEADERS and not count):
                return
            header = fits.Header.fromstring("".join(cards))
            offset, length = file.tell(), _data_bytes(path, header)
            image = None
            if header.get("ZIMAGE", False):
                # Astropy knows the header that the image had before.
                with _astropy_file(path) as tiled:
                    header = tiled[index].header
                    cards = [card.image[:80].ljust(80) for card in header.cards]
                    image = replace(_image(path, cards, header, 0), tiles=index)
            elif header.get("XTENSION", "IMAGE").strip() == "IMAGE" and header["NAXIS"] >= 2 and length:
                image = _image(path, cards, header, offset)
            if image is not None:
                _check_size(image, limits)
                count += 1
                limits.check_count(count, str(path))
                if not _is_compressed(path) and offset + length > size:
                    raise DataError(f"{path}: expected {offset + length} bytes, found {size}; {_CUT}")
                yield image
            offset += -(-length // _BLOCK) * _BLOCK
            if _is_compressed(path):
                limits.check_bytes(offset, str(path))
            file.seek(offset)


def _astropy_file(path: Path) -> Any:
    return astropy_fits().open(path, do_not_scale_image_data=True, memmap=False)


def _read_cards(path: Path, file: IO[bytes], first: bool) -> list[str]:
    """Read the next header up to its end; nothing where no other follows."""
    cards: list[str] = []
    while len(cards) < _MOST_CARDS:
        block = file.read(_BLOCK)
        if not cards and (len(block) < _BLOCK or not block.startswith((b"SIMPLE  =", b"XTENSION="))):
            if first:
                raise DataError(f"{path}: not a FITS file; it does not begin with SIMPLE and a whole header")
            # What follows the last header is no concern of ours.
            return []
        if len(block) < _BLOCK:
            raise DataError(f"{path}: damaged; its header does not end")
        text = block.decode("ascii", "replace").replace("\ufffd", "?")
        for start in range(0, _BLOCK, 80):
            card = text[start : start + 80]
            if card.rstrip() == "END":
                return cards
            cards.append(card)
    raise DataError(f"{path}: expected a header of up to {_MOST_CARDS} cards, found more")


def _data_bytes(path: Path, header: Header) -> int:
    axes = [header[f"NAXIS{place}"] for place in range(1, header["NAXIS"] + 1)]
    counts = [header["BITPIX"], header["NAXIS"], *axes, header.get("PCOUNT", 0), header.get("GCOUNT", 1)]
    if not all(type(count) is int for count in counts) or min(counts[1:]) < 0 or counts[0] not in _TYPES:
        raise DataError(f"{path}: damaged; its header states no size")
    return abs(counts[0]) // 8 * counts[-1] * (counts[-2] + math.prod(axes)) if axes else 0


def _image(path: Path, cards: list[str], header: Header, offset: int) -> FitsImage:
    shape = tuple(int(header[f"NAXIS{place}"]) for place in range(header["NAXIS"], 0, -1))
    dtype = np.dtype(_TYPES[header["BITPIX"]])
    scale, zero, blank = float(header.get("BSCALE", 1)), float(header.get("BZERO", 0)), header.get("BLANK")
    if not (math.isfinite(scale) and math.isfinite(zero)) or scale == 0:
        raise DataError(f"{path}: expected finite BSCALE and BZERO, found {scale} and {zero}")
    notes = []
    bottom_up = str(header.get("ROWORDER", "")).strip().upper() == "BOTTOM-UP"
    if bottom_up:
        notes.append("rows run from the bottom up, and keep the order of the file")
    pattern = str(header.get("BAYERPAT", "")).strip()
    bayer = _first_colours(pattern, header, shape[-2] if bottom_up and len(shape) > 1 else None)
    if pattern and bayer is None:
        notes.append(Doubt(f"the Bayer pattern {pattern} is unknown, so it is not made into colour"))
    missing = blank if dtype.kind in "iu" and isinstance(blank, int) else None
    name = re.sub(r"[\s_-]*\d*$", "", str(header.get("EXTNAME", "")).strip().upper())
    return FitsImage(path, tuple(cards), shape, dtype, offset, (scale, zero), missing, tuple(notes), bayer, name)


def _first_colours(pattern: str, header: Header, rows: int | None) -> str | None:
    """Colours of the first 2×2 pixels of the file; ``rows`` counts them where the last is the first of the sensor."""
    colours = pattern.lower()
    if colours not in BAYER_CODES:
        return None
    across, down = (header.get(name, 0) for name in ("XBAYROFF", "YBAYROFF"))
    across, down = (
        int(value) if isinstance(value, int | float) and math.isfinite(value) else 0 for value in (across, down)
    )
    down += 0 if rows is None else rows - 1
    return "".join(colours[2 * ((row + down) % 2) + (column + across) % 2] for row in (0, 1) for column in (0, 1))


def _check_size(image: FitsImage, limits: Limits) -> None:
    """Refuse sizes beyond the limits, whichever axis counts the frames."""
    if len(image.shape) > 4:
        raise DataError(f"{image.path}: expected two to four axes, found {len(image.shape)}")
    height, width = image.shape[-2:]
    if len(image.shape) == 4 and width == 3 and 3 not in image.shape[:2]:
        height, width = image.shape[1:3]
    limits.check_size(width, height, str(image.path))
    limits.check_count(max(image.shape[:-2], default=1), str(image.path))


def _is_compressed(path: Path) -> bool:
    return path.suffix.lower() == ".gz"


@contextmanager
def _opened(path: Path) -> Iterator[IO[bytes]]:
    if not _is_compressed(path):
        with path.open("rb") as file:
            yield file
        return
    try:
        with gzip.open(path) as unpacked:
            yield cast("IO[bytes]", unpacked)
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise DataError(f"{path}: compressed data are damaged or cut short; copy the file again") from error

"""Still images before they are decoded: their size, and whether what is compressed is whole.

OpenCV allocates whatever a header asks for and fills up what is missing; its decoders print what they find damaged.
"""

from __future__ import annotations

import io
import struct
import warnings
import zlib
from pathlib import Path

from ..core.errors import DataError
from .files import first_line
from .limits import Limits
from .tiff_pages import check_page, check_parts, count_pages, tiff_errors

# What Pillow may take a file for; it knows many formats more.
_FORMATS = ("PNG", "JPEG", "BMP", "PPM", "WEBP")
_PNG, _IHDR_BITS, _CHUNK = b"\x89PNG\r\n\x1a\n", 24, 2**20


def check_still(path: Path, data: bytes, limits: Limits) -> None:
    """Refuse what must not be decoded: too many pixels, several pages, checksums that fail, too few pixels.

    Parameters
    ----------
    path : Path
        For messages; its suffix tells TIFF from the other formats.
    data : bytes
        The whole file.
    limits : Limits
        Largest image.

    Raises
    ------
    DataError
        Not an image, damaged, too large, or more than one page.

    Examples
    --------
    >>> check_still(Path("a.png"), b"text", Limits())
    Traceback (most recent call last):
    ...
    turbrestore.core.errors.DataError: a.png: not an image of a known format
    """
    if path.suffix.lower() in (".tif", ".tiff"):
        _check_tiff(path, data, limits)
        return
    width, height = _pillow_size(path, data, limits)
    limits.check_size(width, height, str(path))
    if data.startswith(_PNG):
        _check_inflated(path, data, width, height)


def _check_tiff(path: Path, data: bytes, limits: Limits) -> None:
    import tifffile

    pages = count_pages(path, io.BytesIO(data), limits)
    if pages != 1:
        raise DataError(f"{path}: expected one image, found {pages} pages; read it as a video")
    with tiff_errors(path), tifffile.TiffFile(io.BytesIO(data)) as tiff:
        page = tiff.pages.first
        check_page(path, page, limits)
        check_parts(path, page)


def _pillow_size(path: Path, data: bytes, limits: Limits) -> tuple[int, int]:
    import PIL.Image

    try:
        with warnings.catch_warnings():
            # Pillow warns at a size of its own.
            warnings.simplefilter("ignore", PIL.Image.DecompressionBombWarning)
            with PIL.Image.open(io.BytesIO(data), formats=_FORMATS) as header:
                size = header.size
                # Checks PNG checksums without inflating; libpng would print its complaint to the terminal.
                header.verify()
    except PIL.Image.DecompressionBombError as error:
        raise DataError(f"{path}: expected up to {limits.max_pixels} pixels, found far more") from error
    except PIL.UnidentifiedImageError as error:
        raise DataError(f"{path}: not an image of a known format") from error
    except Exception as error:  # Pillow raises SyntaxError, ValueError, struct.error, … by the format
        raise DataError(f"{path}: not an image, or damaged ({first_line(error)})") from error
    return size


def _check_inflated(path: Path, data: bytes, width: int, height: int) -> None:
    """Refuse a PNG whose pixels are fewer than its header says: libpng would print that to the terminal."""
    bits, colour, _, _, interlaced = struct.unpack_from(">5B", data, _IHDR_BITS)
    values = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}.get(colour, 0)
    # Every row has a byte for its filter; the seven passes of an interlaced image need more, never fewer.
    needed = height * (1 + (width * bits * values + 7) // 8) if not interlaced else width * height * bits * values // 8
    inflate, found, place = zlib.decompressobj(), 0, len(_PNG)
    try:
        while found < needed and place + 8 <= len(data):
            size, kind = struct.unpack_from(">I4s", data, place)
            packed = data[place + 8 : place + 8 + size] if kind == b"IDAT" else b""
            while packed and found < needed:
                found += len(inflate.decompress(packed, _CHUNK))
                packed = inflate.unconsumed_tail
            place += size + 12
    except zlib.error as error:
        raise DataError(f"{path}: compressed pixels are damaged ({first_line(error)}); copy the file again") from error
    if found < needed:
        raise DataError(f"{path}: expected {needed} bytes of pixels, found {found}; the file is damaged")

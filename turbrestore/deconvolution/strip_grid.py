"""Images and their spectra on one grid, worked on in strips of rows and blocks of columns.

A transform in two dimensions is one along the rows and one along the columns.  What is done to an image between its
transforms is done to a strip of rows, and what is done to a spectrum to a block of columns, while they are in the cache
of a processor; strips and blocks are shared among threads.  A block lies in one piece.  Images and spectra may lie in
files: then no more of them is in memory than what is worked on.

Results of single strips are put together in their order, so nothing depends on threads, nor on where images lie.

Symbols
-------
P, Q : rows and columns of an image; half a spectrum has H = Q // 2 + 1 columns.
B, C : blocks of a spectrum, and columns of each; of the last one some may be empty: B C ≥ H.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from ..blur.psf import Spectrum
from ..core.arrays import FloatArray
from ..runtime.scratch import drop_pages, new_stack
from ..runtime.threads import ThreadTeam

Item = TypeVar("Item")
Found = TypeVar("Found")
# Smaller images are one strip: threads would wait for each other longer than they save.
_ONE_STRIP = 1 << 18
# Pixels of a strip, about; what numbers of strips of rows, and widths of blocks, are multiples of.
_STRIP, _EVEN, _ALIGNED = 1 << 18, 4, 16


@dataclass(frozen=True, eq=False)
class StripGrid:
    """Grid of images.

    Attributes
    ----------
    shape : (int, int)
        P and Q.
    team : ThreadTeam, optional
        Threads that work on strips side by side.
    folder : Path, optional
        Where images lie in files; without it they are in memory.
    """

    shape: tuple[int, int]
    team: ThreadTeam | None = None
    folder: Path | None = None

    @property
    def one_strip(self) -> bool:
        """Whether an image is worked on as a whole."""
        return self.shape[0] * self.shape[1] < _ONE_STRIP

    @cached_property
    def blocks(self) -> tuple[slice, ...]:
        """Columns of half a spectrum that are in each block."""
        columns = self.shape[1] // 2 + 1
        step = columns if self.one_strip else -(-self._step(columns) // _ALIGNED) * _ALIGNED
        return tuple(slice(start, min(start + step, columns)) for start in range(0, columns, step))

    def image(self) -> FloatArray:
        """Make an image, to be filled: float32, shape (P, Q)."""
        return np.asarray(new_stack(self.shape, self.folder))

    def spectrum(self) -> NDArray[np.complex64]:
        """Make half a spectrum, to be filled: complex64, shape (B, P, C)."""
        return self._in_blocks(2).view(np.complex64)

    def multiplier(self) -> FloatArray:
        """Make a real function of the frequency, to be filled: float32, shape (B, P, C)."""
        return self._in_blocks(1)

    def in_blocks(self, spectrum: Spectrum) -> Spectrum:
        """Put a function of the frequency, of shape (P, H), into blocks; 1 where there is no column."""
        found = self.spectrum() if np.iscomplexobj(spectrum) else self.multiplier()
        for block, columns in zip(found, self.blocks, strict=True):
            part = spectrum[:, columns]
            block[:, : part.shape[1]], block[:, part.shape[1] :] = part, 1
            drop_pages(found)
        return found

    def copied(self, image: FloatArray) -> FloatArray:
        """Copy an image."""
        copy = self.image()

        def put(rows: slice) -> None:
            copy[rows] = image[rows]

        self.over_rows(put, copy, image)
        return copy

    @cached_property
    def spectra(self) -> tuple[NDArray[np.complex64], NDArray[np.complex64]]:
        """Two spectra that hold nothing from one call to the next."""
        return self.spectrum(), self.spectrum()

    @cached_property
    def spare(self) -> FloatArray:
        """An image that holds nothing from one call to the next."""
        return self.image()

    def transform_strip(self, strip: FloatArray, spectrum: NDArray[np.complex64], rows: slice) -> None:
        """Transform some rows of an image along themselves."""
        found = fft.rfft(strip, axis=1)
        for block, columns in zip(spectrum, self.blocks, strict=True):
            part = found[:, columns]
            block[rows, : part.shape[1]] = part
            block[rows, part.shape[1] :] = 0

    def strip_of(self, spectrum: NDArray[np.complex64], rows: slice) -> FloatArray:
        """Rows of an image, from their own spectra."""
        found = np.concatenate(spectrum[:, rows], axis=1)[:, : self.shape[1] // 2 + 1]
        strip: FloatArray = fft.irfft(found, n=self.shape[1], axis=1)
        return strip

    def over_rows(self, work: Callable[[slice], Found], *touched: object) -> list[Found]:
        """Do something to every strip of rows, and hand back the memory of arrays that lie in files."""
        height = self.shape[0]
        step = height if self.one_strip else self._step(height)
        strips = [slice(start, min(start + step, height)) for start in range(0, height, step)]
        return self._over(work, strips, touched)

    def over_blocks(self, work: Callable[[int], Found], *touched: object) -> list[Found]:
        """Do something to every block of a spectrum, by its number, likewise."""
        return self._over(work, range(len(self.blocks)), touched)

    def inner(self, a: FloatArray, b: FloatArray) -> float:
        """Inner product of two images, summed in double precision."""
        return sum(self.over_rows(lambda rows: inner(a[rows], b[rows]), a, b))

    def spectral_inner(self, a: Spectrum, b: Spectrum, number: int) -> float:
        """Share of a block of two spectra in the inner product of their images (Parseval)."""
        return spectral_inner(a, b, self.shares[number])

    @cached_property
    def shares(self) -> NDArray[np.float64]:
        """What columns of half a spectrum count, (B, C): the other half repeats all but the first and a middle one."""
        height, width = self.shape
        shares = np.zeros(self._in_blocks_shape(1)[::2])
        flat = shares.reshape(-1)
        flat[: width // 2 + 1] = 2.0
        flat[0] = 1.0
        if width % 2 == 0:
            flat[width // 2] = 1.0
        return shares / (height * width)

    def _in_blocks(self, numbers: int) -> FloatArray:
        return np.asarray(new_stack(self._in_blocks_shape(numbers), self.folder))

    def _in_blocks_shape(self, numbers: int) -> tuple[int, int, int]:
        return len(self.blocks), self.shape[0], numbers * (self.blocks[0].stop - self.blocks[0].start)

    def _step(self, length: int) -> int:
        """Of an axis so long, the length of a strip."""
        return -(-length // (_EVEN * -(-self.shape[0] * self.shape[1] // (_EVEN * _STRIP))))

    def _over(self, work: Callable[[Item], Found], items: Sequence[Item], touched: tuple[object, ...]) -> list[Found]:
        def do(item: Item) -> Found:
            found = work(item)
            for array in touched:
                drop_pages(array)
            return found

        return list(map(do, items) if self.team is None or self.one_strip else self.team.map(do, items))


def inner(a: FloatArray, b: FloatArray) -> float:
    """Inner product, summed in double precision.

    Parameters
    ----------
    a, b : ndarray, float32, equal shapes

    Returns
    -------
    float

    Examples
    --------
    >>> inner(np.float32([1, 2]), np.float32([3, 4]))
    11.0
    """
    return float(np.sum(a * b, dtype=np.float64))


def spectral_inner(a: Spectrum, b: Spectrum, shares: NDArray[np.float64]) -> float:
    """Inner product of columns of two spectra, summed in double precision.

    Parameters
    ----------
    a, b : ndarray, complex64, shape (P, C)
    shares : ndarray, float64, shape (C,)
        What each column counts.

    Returns
    -------
    float

    Examples
    --------
    >>> spectral_inner(np.complex64([[1 + 2j, 1]]), np.complex64([[3 + 4j, 5]]), np.array([1.0, 2.0]))
    21.0
    """
    products = a.real * b.real
    products += a.imag * b.imag
    return float(products.sum(axis=0, dtype=np.float64) @ shares)

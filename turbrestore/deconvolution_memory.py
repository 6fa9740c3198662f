"""What a nonlocal deconvolution takes of memory, and how it keeps within what it is given.

Bytes, for c channels of H × W pixels, each joined to b others of its n neighbours, and t threads, while weights are
found and while the image is iterated, of which the larger counts::

    work + H W · (60 + 20 c + 8 pairs) + 60 · 64 W · b + t · 4 · tile · n
    work + H W · (132 c + (8 + 8 c) pairs) + t · 26 · strip · b

64 W pixels are the band whose choices become pairs at a time; of a tile a thread has the distances to all neighbours,
and of a strip the edges; with Numba it needs less.  A pixel has 0.65 b pairs.  They may be kept in a file: their terms
are 0 then.
"""

from __future__ import annotations

from dataclasses import dataclass

from .nonlocal_tv import STRIP_PIXELS, NonlocalParams
from .patch_search import BAND_ROWS, tile_columns

# Of the process; of every pixel while weights are found, once and for a channel; of every channel in an iteration.
_WORK, _FOUND, _FOUND_CHANNEL, _ITERATED = 2e7, 60.0, 20.0, 132.0
# Of a pair: its head and weight, and its dual in every channel.
_PAIR, _DUAL = 8.0, 8.0
# Of every choice of a band, and of every choice of a strip for each thread.
_BAND_CHOICE, _STRIP_CHOICE = 60.0, 26.0
# Pairs per pixel over those that a pixel chooses: many are chosen from both sides.
_SHARE_OF_PAIRS = 0.65


@dataclass(frozen=True)
class Room:
    """How a nonlocal deconvolution works.

    Attributes
    ----------
    threads : int
        Parts of the image worked on side by side.
    in_file : bool
        Whether pairs are kept in files.
    """

    threads: int
    in_file: bool


@dataclass(frozen=True)
class NonlocalWork:
    """Size of a nonlocal deconvolution.

    Attributes
    ----------
    shape : tuple of int
        (H, W) with the margin.
    channels : int
        Those that are deblurred.
    weights : NonlocalParams
        Size of patches, search and neighbourhood.
    """

    shape: tuple[int, ...]
    channels: int
    weights: NonlocalParams

    @property
    def pixels(self) -> int:
        """H W."""
        return self.shape[0] * self.shape[1]

    def pairs(self) -> float:
        """Bytes of pairs and of their duals.

        Returns
        -------
        float

        Examples
        --------
        >>> NonlocalWork((100, 100), 1, NonlocalParams()).pairs()
        1456000.0
        """
        return self.pixels * self._pairs * (_PAIR + _DUAL * self.channels)

    def peak(self, room: Room) -> float:
        """Largest need.

        Parameters
        ----------
        room : Room

        Returns
        -------
        float

        Examples
        --------
        >>> work = NonlocalWork((1080, 1920), 1, NonlocalParams())
        >>> [round(work.peak(Room(threads, True)) / 1e6) for threads in (1, 2)]
        [311, 332]
        """
        height, width = self.shape
        offsets, rows = self.weights.search**2 - 1, min(BAND_ROWS, height)
        tile = 4 * rows * min(tile_columns(offsets), width) * offsets
        strip = _STRIP_CHOICE * min(self.pixels, max(STRIP_PIXELS, 4 * width)) * self._choices
        band = _BAND_CHOICE * rows * width * self._choices
        found = self.pixels * (_FOUND + _FOUND_CHANNEL * self.channels) + band + room.threads * tile
        iterated = self.pixels * _ITERATED * self.channels + room.threads * strip
        if not room.in_file:
            found, iterated = found + self.pixels * self._pairs * _PAIR, iterated + self.pairs()
        return _WORK + max(found, iterated)

    def room(self, memory: float | None, threads: int) -> Room:
        """Choose what keeps within memory: a file before fewer threads; where nothing does, what takes least.

        Parameters
        ----------
        memory : float or None
            Bytes; None where there is no limit.
        threads : int
            Most that may work.

        Returns
        -------
        Room

        Examples
        --------
        >>> work = NonlocalWork((1080, 1920), 1, NonlocalParams())
        >>> work.room(None, 2), work.room(3.4e8, 8), work.room(1.0, 8)
        (Room(threads=2, in_file=False), Room(threads=2, in_file=True), Room(threads=1, in_file=True))
        """
        if memory is None:
            return Room(threads, False)
        rooms = (Room(count, in_file) for count in range(threads, 0, -1) for in_file in (False, True))
        return next((room for room in rooms if self.peak(room) <= memory), Room(1, True))

    @property
    def _choices(self) -> int:
        return self.weights.best + self.weights.nearest

    @property
    def _pairs(self) -> float:
        return _SHARE_OF_PAIRS * self._choices

"""What a deconvolution takes of memory, and how it keeps within what it is given.

Bytes, for c channels of H × W pixels and t threads.  Of nltv each pixel is joined to b others of its n neighbours; the
largest of these counts, of the time when its start is found, its weights, and while it is iterated::

    work + H W · (20 + 10 c + 32 min(t, c + 1)) + 8 MB · t
    work + H W · (35 + 10 c + 8 pairs) + 60 · 64 W · b + t · 4 · tile · n
    work + H W · (50 + 52 c + (8 + 8 c) pairs) + t · max(26 · strip · b, 8 MB)

64 W pixels are the band whose choices become pairs at a time, which takes 30 instead of 60 with Numba; of a tile a
thread has the distances to all neighbours, and of a strip the edges; with Numba it needs less.  A pixel has 0.65 b
pairs.  They may be kept in a file: their terms are 0 then.  Where images are kept in files too, H W · (50 + 56 c)
bytes of them, H W · (14 + 4 c) remains of the first line and H W · 20 of each of the others.

tv takes H W · (40 + 52 c) and the linear methods H W · (35 + 32 c), in files H W · (14 + 4 c), and 8 MB · t.
The blur is one that is known by its width: a sampled point spread function takes more.
"""

from __future__ import annotations

from dataclasses import dataclass

from ..runtime.jit import can_compile
from .nonlocal_tv import STRIP_PIXELS, NonlocalParams
from .patch_search import BAND_ROWS, tile_columns

# Of the process.
_WORK = 2e7
# Of every pixel, and for a channel: of tv and of the linear methods, in memory and where images are in files.
_TV, _LINEAR, _IN_FILE = (40.0, 52.0), (35.0, 32.0), (14.0, 4.0)
# Of nltv: while the start is found, and for a thread; while weights are found; in an iteration.
_STARTED, _STARTED_THREAD = (20.0, 10.0), 32.0
_FOUND, _FOUND_IN_FILE = (35.0, 10.0), (20.0, 0.0)
_ITERATED, _ITERATED_IN_FILE = (50.0, 52.0), (20.0, 0.0)
# Of a pair: its head and weight, and its dual in every channel.
_PAIR, _DUAL = 8.0, 8.0
# Of a thread: strips and blocks of images.
_THREAD = 8e6
# Of every choice of a band, by NumPy and compiled, and of every choice of a strip for each thread.
_BAND_CHOICE, _BAND_CHOICE_COMPILED, _STRIP_CHOICE = 60.0, 30.0, 26.0
# Pairs per pixel over those that a pixel chooses: many are chosen from both sides.
_SHARE_OF_PAIRS = 0.65
# Pairs in files, and images: what is tried, one after the other.
_FILINGS = (False, False), (True, False), (True, True)
# In files: of every pixel, and for a channel.
_FILES = 50.0, 56.0


@dataclass(frozen=True)
class Room:
    """How a deconvolution works.

    Attributes
    ----------
    threads : int
        Parts of the image worked on side by side.
    in_file : bool
        Whether pairs are kept in files.
    images_in_file : bool
        Whether images are too.
    """

    threads: int
    in_file: bool
    images_in_file: bool = False


@dataclass(frozen=True)
class DeconvolutionWork:
    """Size of a deconvolution.

    Attributes
    ----------
    shape : tuple of int
        (H, W) with the margin.
    channels : int
        Those that are deblurred.
    method : str
        Only nltv has pairs.
    weights : NonlocalParams
        Size of patches, search and neighbourhood.
    """

    shape: tuple[int, ...]
    channels: int
    method: str
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
        >>> DeconvolutionWork((100, 100), 1, "nltv", NonlocalParams()).pairs()
        1456000.0
        """
        return self.pixels * self._pairs * (_PAIR + _DUAL * self.channels) if self.method == "nltv" else 0.0

    def files(self, room: Room) -> float:
        """Bytes of all files.

        Parameters
        ----------
        room : Room

        Returns
        -------
        float

        Examples
        --------
        >>> work = DeconvolutionWork((100, 100), 1, "nltv", NonlocalParams())
        >>> [work.files(Room(1, *files)) for files in ((False, False), (True, False), (True, True))]
        [0.0, 1456000.0, 2516000.0]
        """
        images = self._all(_FILES) if room.images_in_file else 0.0
        return images + (self.pairs() if room.in_file else 0.0)

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
        >>> work = DeconvolutionWork((1080, 1920), 1, "tv", NonlocalParams())
        >>> [round(work.peak(Room(2, False, in_file)) / 1e6) for in_file in (False, True)]
        [227, 73]
        """
        if self.method != "nltv":
            in_memory = _TV if self.method == "tv" else _LINEAR
            return _WORK + self._all(_IN_FILE if room.images_in_file else in_memory) + room.threads * _THREAD
        height, width = self.shape
        offsets, rows = self.weights.search**2 - 1, min(BAND_ROWS, height)
        found, iterated = self._all(_FOUND), self._all(_ITERATED)
        started = self._all(_STARTED) + self.pixels * _STARTED_THREAD * min(room.threads, self.channels + 1)
        if room.images_in_file:
            started = self._all(_IN_FILE)
            found, iterated = self._all(_FOUND_IN_FILE), self._all(_ITERATED_IN_FILE)
        if not room.in_file:
            found, iterated = found + self.pixels * self._pairs * _PAIR, iterated + self.pairs()
        found += (_BAND_CHOICE_COMPILED if can_compile() else _BAND_CHOICE) * rows * width * self._choices
        found += room.threads * 4 * rows * min(tile_columns(offsets), width) * offsets
        strip = _STRIP_CHOICE * min(self.pixels, max(STRIP_PIXELS, 4 * width)) * self._choices
        return _WORK + max(started + room.threads * _THREAD, found, iterated + room.threads * max(strip, _THREAD))

    def room(self, memory: float | None, threads: int) -> Room:
        """Choose what keeps within memory: files before fewer threads; where nothing does, what takes least.

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
        >>> work = DeconvolutionWork((1080, 1920), 1, "nltv", NonlocalParams())
        >>> work.room(None, 2), work.room(3e8, 2)
        (Room(threads=2, in_file=False, images_in_file=False), Room(threads=2, in_file=True, images_in_file=False))
        >>> work.room(1.0, 8)
        Room(threads=1, in_file=True, images_in_file=True)
        """
        if memory is None:
            return Room(threads, False)
        rooms = (Room(count, *files) for count in range(threads, 0, -1) for files in _FILINGS)
        return next((room for room in rooms if self.peak(room) <= memory), Room(1, True, True))

    def _all(self, bytes_a_pixel: tuple[float, float]) -> float:
        """Sum over all pixels and channels."""
        return self.pixels * (bytes_a_pixel[0] + bytes_a_pixel[1] * self.channels)

    @property
    def _choices(self) -> int:
        return self.weights.best + self.weights.nearest

    @property
    def _pairs(self) -> float:
        return _SHARE_OF_PAIRS * self._choices

"""From the patches that every pixel chooses to the pairs of pixels that are tied together.

Symbols
-------
choice : see :mod:`turbrestore.patch_search`.
tail, head : the pixels x < y of a pair, in the order of the image.
halves : offsets from a tail to its heads, from the first to the last in the order of the image.

A pixel chooses some of its pairs as their tail and others as their head, and a pair may be chosen from both sides: then
it counts once, with the smaller of the two distances, which differ by rounding.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .arrays import FloatArray
from .compiled import compiled
from .patch_search import OUTSIDE, Keys, PatchSearch

# Bits of a choice, below the number of its half in what is sorted.
_BITS = 31
_CHOICE = (1 << _BITS) - 1

Codes = NDArray[np.int64]


class Pairs(NamedTuple):
    """Pairs whose tails are in a band of rows, by tail and head.

    Attributes
    ----------
    degrees : ndarray, intp, shape (n,)
        Pairs of each of the n pixels of the band, of which it is the tail.
    heads : ndarray, int32, shape (e,)
        Where each pair ends, pixels from the first of the band on.
    distances : ndarray, float32, shape (e,)
        d.
    """

    degrees: NDArray[np.intp]
    heads: NDArray[np.int32]
    distances: FloatArray


def pairs_of_band(keys: Keys, below: Keys, width: int, search: PatchSearch) -> Pairs:
    """Pairs whose tails are in a band.

    Parameters
    ----------
    keys : ndarray, int32, shape (n, nearest + best)
        Choices of the pixels of the band.
    below : ndarray, int32, shape (m, nearest + best)
        Choices of the pixels of the next band, whose heads may be tails in this one.
    width : int
        Columns of the image.
    search : PatchSearch
        What was chosen from.

    Returns
    -------
    Pairs

    Examples
    --------
    >>> search = PatchSearch(np.ones((1, 1), np.float32), np.array([[0, -1], [0, 1]], np.int32), nearest=0, best=1)
    >>> to_the_left, to_the_right = 0, 1
    >>> keys = np.array([[to_the_right], [to_the_left], [to_the_left]], np.int32)
    >>> pairs_of_band(keys, keys[:0], 3, search)[:2]
    (array([1, 1, 0]), array([1, 2], dtype=int32))
    """
    below = below[: search.reach * width]
    offsets = search.offsets.astype(np.int64)
    forward = (offsets[:, 0] > 0) | ((offsets[:, 0] == 0) & (offsets[:, 1] > 0))
    halves, numbers = np.unique(np.where(forward[:, None], offsets, -offsets), axis=0, return_inverse=True)
    steps, half = halves @ [width, 1], numbers.ravel()
    to_tail = np.where(forward, 0, -steps[half])
    loops = compiled(join_choices)
    if loops is None:
        return _join(keys, below, steps, (half, to_tail, search.rank_mask))
    codes, degrees = np.empty(keys.size + below.size, np.int64), np.empty(len(keys), np.intp)
    rows = np.ascontiguousarray(keys), np.ascontiguousarray(below)
    loops(*rows, half, to_tail, search.rank_mask, steps, codes, degrees)
    return _pairs(degrees, codes[: degrees.sum()], search.rank_mask)


def _join(keys: Keys, below: Keys, steps: Codes, ranks: tuple[Codes, Codes, int]) -> Pairs:
    """:func:`join_choices` by NumPy."""
    half, to_tail, mask = ranks
    own, codes = len(keys), []
    # Number of the pair among all of the band, less that of the first pair of the pixel that chose it.
    ahead = to_tail * len(steps) + half
    for first, part in ((0, keys), (own, below)):
        numbers = ahead[part & mask]
        numbers += (np.arange(first, first + len(part)) * len(steps))[:, None]
        useful = (part < OUTSIDE) & (numbers >= 0) & (numbers < own * len(steps))
        # Many offsets of a wide image need every bit.
        codes.append((numbers[useful].view(np.uint64) << np.uint64(_BITS)) | part[useful].view(np.uint32))
    # Runs are sorted already, which this kind of sort makes use of.
    joined = np.sort(np.concatenate(codes), kind="stable")
    pairs, kept = (joined >> np.uint64(_BITS)).view(np.int64), np.ones(len(joined), bool)
    np.not_equal(pairs[1:], pairs[:-1], out=kept[1:])
    tails, numbers = np.divmod(pairs[kept], len(steps))
    choices = (joined[kept] & np.uint64(_CHOICE)).view(np.int64)
    return _pairs(np.bincount(tails, minlength=own), ((tails + steps[numbers]) << _BITS) | choices, mask)


def _pairs(degrees: NDArray[np.intp], codes: Codes, rank_mask: int) -> Pairs:
    distances = (codes & (_CHOICE - rank_mask)).astype(np.int32).view(np.float32)
    return Pairs(degrees, (codes >> _BITS).astype(np.int32), distances)


def join_choices(
    keys: Keys,
    below: Keys,
    half: Codes,
    to_tail: Codes,
    rank_mask: int,
    steps: Codes,
    codes: Codes,
    degrees: NDArray[np.intp],
) -> None:
    """Sort the choices of a band by tail and half, and leave out those made twice; to be compiled.

    Parameters
    ----------
    keys, below : ndarray, int32, shape (n, nearest + best) and (m, nearest + best)
        Choices of the band, and of pixels below it.
    half, to_tail : ndarray, int64, shape (offsets,)
        Half of each offset, and the way from the pixel that chose it to the tail.
    rank_mask : int
        See :class:`turbrestore.patch_search.PatchSearch`.
    steps : ndarray, int64, shape (halves,)
        Way from the tail to the head.
    codes : ndarray, int64, shape (choices of band and pixels below,)
        Filled from the first entry on: head, and below its bits the choice.
    degrees : ndarray, intp, shape (n,)
        Filled: pairs of each tail.

    Examples
    --------
    >>> keys, none = np.array([[1], [0]], np.int32), np.zeros((0, 1), np.int32)
    >>> codes, degrees = np.zeros(2, np.int64), np.zeros(2, np.intp)
    >>> join_choices(keys, none, np.array([0, 0]), np.array([-1, 0]), 3, np.array([1]), codes, degrees)
    >>> degrees, codes[:1] >> 31
    (array([1, 0]), array([1]))
    """
    own, chosen = len(keys), keys.shape[1]
    starts, ends = np.zeros(own + 1, np.int64), np.zeros(own, np.int64)
    for pixel in range(own + len(below)):
        row = keys[pixel] if pixel < own else below[pixel - own]
        for place in range(chosen):
            tail = pixel + to_tail[np.uintp(row[place] & rank_mask)]
            if row[place] < OUTSIDE and 0 <= tail < own:
                starts[np.uintp(tail + 1)] += 1
    for pixel in range(own):
        starts[pixel + 1] += starts[pixel]
        ends[pixel] = starts[pixel]
    for pixel in range(own + len(below)):
        row = keys[pixel] if pixel < own else below[pixel - own]
        for place in range(chosen):
            rank = np.uintp(row[place] & rank_mask)
            tail = pixel + to_tail[rank]
            if row[place] < OUTSIDE and 0 <= tail < own:
                # A pixel has few pairs: each goes to its place as it comes.
                code, last = (half[rank] << _BITS) | row[place], ends[np.uintp(tail)]
                while last > starts[np.uintp(tail)] and codes[np.uintp(last - 1)] > code:
                    codes[np.uintp(last)] = codes[np.uintp(last - 1)]
                    last -= 1
                codes[np.uintp(last)] = code
                ends[np.uintp(tail)] += 1
    size = 0
    for tail in range(own):
        first, before = size, -1
        for index in range(starts[tail], ends[tail]):
            code = codes[np.uintp(index)]
            number = code >> _BITS
            if number != before:
                codes[np.uintp(size)] = ((tail + steps[np.uintp(number)]) << _BITS) | (code & _CHOICE)
                size += 1
            before = number
        degrees[tail] = size - first

"""From the patches that every pixel chooses to the pairs of pixels that are tied together.

Symbols
-------
choice : see :mod:`turbrestore.deconvolution.patch_search`.
tail, head : the pixels x < y of a pair, in the order of the image.
halves : offsets from a tail to its heads, from the first to the last in the order of the image.

A pixel chooses some of its pairs as their tail and others as their head.  A pair that is chosen from both sides, or as
near and as similar, counts once, with the smallest of its distances, which differ by rounding.

All choices of a band could be sorted, which is what NumPy can do.  Compiled, they are counted first, so that each tail
has its place, and what is sorted is as little as a pixel has.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray
from ..runtime.jit import compiled
from .patch_search import OUTSIDE, Keys, PatchSearch

# Bits of a choice, below the number of its half, or its head.
_BITS = 31
_CHOICE = (1 << _BITS) - 1

Numbers = NDArray[np.int64]


class Pairs(NamedTuple):
    """Pairs whose tails are in a band of rows, by tail and head.

    Attributes
    ----------
    degrees : ndarray, intp, shape (n,)
        Pairs of each of the n pixels of the band, of which it is the tail.
    heads : ndarray, int32, shape (e,)
        Where each pair ends, pixels from the first of the band on.
    distances : ndarray, float32, shape (e,)
        d, intensity squared, without the last bits that a choice gives to its rank.
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
        Choices of the pixels of the next band, some of which are heads of pairs whose tails are in this one; none below
        the last band.
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
        return _join(keys, below, half, to_tail, search.rank_mask, steps)
    codes, degrees = np.empty(keys.size + below.size, np.int64), np.empty(len(keys), np.intp)
    # The compiler takes a row from one or the other only where it knows that both lie alike.
    rows = np.ascontiguousarray(keys), np.ascontiguousarray(below)
    loops(*rows, half, to_tail, search.rank_mask, steps, codes, degrees)
    codes = codes[: degrees.sum()]
    distances = (codes & (_CHOICE - search.rank_mask)).astype(np.int32).view(np.float32)
    return Pairs(degrees, (codes >> _BITS).astype(np.int32), distances)


def _join(keys: Keys, below: Keys, half: Numbers, to_tail: Numbers, rank_mask: int, steps: Numbers) -> Pairs:
    """:func:`join_choices` by NumPy."""
    own, codes = len(keys), []
    # What is sorted are pairs, numbered through the band, and below them distances without the rank: that leaves enough
    # bits for many offsets of a wide image.
    ranks = rank_mask.bit_length()
    bits, ahead = _BITS - ranks, to_tail * len(steps) + half
    for first, part in ((0, keys), (own, below)):
        numbers = ahead[part & rank_mask]
        numbers += (np.arange(first, first + len(part)) * len(steps))[:, None]
        useful = (part < OUTSIDE) & (numbers >= 0) & (numbers < own * len(steps))
        codes.append((numbers[useful] << bits) | (part[useful] >> ranks))
    joined = np.concatenate(codes)
    del codes, numbers, useful
    # Runs are sorted already, which this kind of sort makes use of.
    joined.sort(kind="stable")
    kept = np.ones(len(joined), bool)
    np.not_equal(joined[1:] >> bits, joined[:-1] >> bits, out=kept[1:])
    joined = joined[kept]
    distances = ((joined & ((1 << bits) - 1)) << ranks).astype(np.int32).view(np.float32)
    joined >>= bits
    heads, numbers = np.divmod(joined, len(steps))
    degrees = np.bincount(heads, minlength=own)
    heads += steps[numbers]
    return Pairs(degrees, heads.astype(np.int32), distances)


def join_choices(
    keys: Keys,
    below: Keys,
    half: Numbers,
    to_tail: Numbers,
    rank_mask: int,
    steps: Numbers,
    codes: Numbers,
    degrees: NDArray[np.intp],
) -> None:
    """Sort the choices of a band by tail and half, and leave out those made twice; to be compiled.

    Parameters
    ----------
    keys, below : ndarray, int32, shape (n, nearest + best) and (m, nearest + best)
        Choices of the band, and of the pixels below it that offsets reach.
    half, to_tail : ndarray, int64, shape (offsets,)
        Number of the half of each offset, and the way from the pixel that chose it to the tail, pixels of the flattened
        image.
    rank_mask : int
        See :class:`turbrestore.deconvolution.patch_search.PatchSearch`.
    steps : ndarray, int64, shape (halves,)
        Way from the tail to the head, pixels of the flattened image.
    codes : ndarray, int64, shape (choices of band and pixels below,)
        One entry for a pair, from the first on: head, and below its bits the choice.  The rest is worked in.
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
                # Those from below come in order, so that a choice passes few on the way to its place.
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

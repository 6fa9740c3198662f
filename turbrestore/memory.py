"""How a restoration keeps within a memory limit: what each stage takes, and what is done where that is too much.

Peak memory of the process is taken to be, in bytes, with HW pixels of c channels, τ training frames, n states and t
threads::

    base + stack + modes + HW · (shared + c · colour + t · (each + c · each_colour))

    stack = τ HW · (4 c + 8)    training frames and their flows
    modes = 8 n HW              modes of the flow model, once it is identified

Stack and modes may be kept in a file; what the threads have in hand of it then still counts.

The constants are those of ``python benchmarks/memory.py --stages`` at 1280×720, grey and in colour, with one, two and
four threads, and a tenth added.  The deconvolution is told what is left, and works in strips where that is little;
the other stages need what they need.  So the training frames go to a file first, then fewer threads work side by side,
and at last fewer frames are trained on.  Only the last changes the result.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from .alternating import FilterParams
from .decision import Decision
from .dynamics import DynamicsParams
from .errors import ConfigurationError, DataError, require
from .flow import MIN_SIDE, FlowParams
from .parallel import available_cores

_FEWEST_TRAINED, _MOST_TRAINED = 40, 100
# Fewer training frames than these are not worth a lower limit.
_FEWEST_IN_NEED = 10
# Training frames and their flows: 12 bytes a pixel for grey frames, up to this many bytes where no limit is given.
_TRAINING_BYTES = 1.5e9
_UNITS = {"": 1, "b": 1, "kb": 1e3, "mb": 1e6, "gb": 1e9, "tb": 1e12, "kib": 2**10, "mib": 2**20, "gib": 2**30}
_SPELT = {"kb": "kB", "kib": "KiB", "mib": "MiB", "gib": "GiB"}
# Interpreter and libraries, readers, heap between the arrays.
_BASE = 160e6
# Numbers of the modes that a thread has in hand.
_IN_HAND = 1 << 23
# Strips of flows in float64 and what is made of one, and what a flow adds to them a pixel where all fit in one.
_STRIPS, _STRIP_NUMBER = 140e6, 70.0


class MemorySize(float):
    """Number of bytes; text such as ``"2GB"`` or ``"1.5 GiB"`` is understood.

    Parameters
    ----------
    value : float or str
        A number of bytes, or text of a number with a unit: B, kB, MB, GB, TB, KiB, MiB, GiB.

    Raises
    ------
    ConfigurationError
        Neither.

    Examples
    --------
    >>> MemorySize("2GB"), MemorySize("1.5 MiB"), MemorySize(3e9)
    (2000000000.0, 1572864.0, 3000000000.0)
    """

    def __new__(cls, value: float | str) -> MemorySize:
        """Read number and unit."""
        text = str(value).strip()
        digits = text.rstrip("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ ")
        unit = text[len(digits) :].strip().lower()
        expected = "--memory-limit: expected a size such as 2GB, 800MB or 1.5GiB"
        try:
            size = float(digits) * _UNITS[unit]
        except (KeyError, ValueError):
            close = difflib.get_close_matches(unit, _UNITS, n=1, cutoff=0.4)
            meant = f"; did you mean {digits}{_SPELT.get(close[0], close[0].upper())}?" if digits and close else ""
            raise ConfigurationError(f"{expected}, found {value!r}{meant}") from None
        require(0 < size < float("inf"), f"{expected}, found {value!r}")
        return super().__new__(cls, size)


@dataclass(frozen=True)
class StageMemory:
    """Bytes a pixel that a stage takes beside stack and modes.

    Attributes
    ----------
    shared, colour : float
        Once: for any frame, and for every channel.
    each, each_colour : float
        For every thread, likewise.
    """

    shared: float
    colour: float
    each: float
    each_colour: float

    def bytes(self, pixels: int, channels: int, threads: int) -> float:
        """Sum over pixels, channels and threads.

        Parameters
        ----------
        pixels, channels, threads : int

        Returns
        -------
        float

        Examples
        --------
        >>> StageMemory(10, 2, 5, 1).bytes(100, 3, 2)
        3200.0
        """
        each = self.each + channels * self.each_colour
        return float(pixels * (self.shared + channels * self.colour + threads * each))


# While flow is measured: that of dis, which takes most.
_FLOW = StageMemory(120, 5, 185, 10)
# While frames are registered and weighed beside that.
_FILTER = StageMemory(30, 20, 25, 15)
# Images and maps that earlier stages leave, and the least that the deconvolution works with.
_HELD = StageMemory(60, 40, 0, 0)
_DECONVOLUTION_WORK, _DECONVOLUTION = 110e6, StageMemory(40, 120, 0, 0)


@dataclass(frozen=True)
class MemoryPlan:
    """What is done to keep within a limit.

    Attributes
    ----------
    train : int
        Training frames.
    threads : int
        Frames worked on side by side, as in :class:`turbrestore.flow.FlowParams`.
    in_file : bool
        Whether training frames and flows are kept in a file.
    file_bytes : int
        Size of the file.
    deconvolution : float or None
        Bytes that are left for the deconvolution; None where there is no limit.
    decisions : tuple of Decision
        What the limit has caused.
    """

    train: int
    threads: int
    in_file: bool = False
    file_bytes: int = 0
    deconvolution: float | None = None
    decisions: tuple[Decision, ...] = ()


@dataclass(frozen=True)
class _Work:
    """Size of a restoration, and the settings that memory depends on."""

    frames: int
    pixels: int
    channels: int
    filter: FilterParams
    dynamics: DynamicsParams
    until: str

    def stack(self, train: int) -> float:
        return train * self.pixels * (4.0 * self.channels + 8.0)

    def modes(self, train: int) -> float:
        chosen = self.dynamics.rank
        most = min(self.dynamics.max_rank, int(train / self.dynamics.frames_per_state))
        return 8.0 * self.pixels * min(most if chosen is None else chosen, train - 1)

    def peak(self, train: int, threads: int, in_file: bool) -> float:
        """Largest need of any stage, the deconvolution at its least."""
        size = self.pixels, self.channels, threads
        stack, modes = self.stack(train), self.modes(train) if self.until != "centroid" else 0.0
        if in_file:
            # What threads have in hand comes into memory while it is used.
            stack, modes = min(stack, self.stack(2 * threads + 3)), min(modes, 4.0 * _IN_HAND * threads)
        flow = _FLOW.bytes(*size)
        block = 4.0 * self.pixels * self.channels * min(self.filter.block, self.frames)
        judged = 8.0 * self.pixels * train if self.filter.frame_noise == "blur" else 0.0
        later = {
            "centroid": 0.0,
            "identify": min(_STRIPS, _STRIP_NUMBER * self.pixels * train),
            "filter": flow + _FILTER.bytes(*size) + block + judged,
            "deconvolve": self.held() + _DECONVOLUTION_WORK + _DECONVOLUTION.bytes(*size),
        }
        stages = list(later)[: list(later).index(self.until) + 1]
        return _BASE + stack + max(flow, modes + max(later[stage] for stage in stages))

    def held(self) -> float:
        """Results of the stages before the deconvolution."""
        return _HELD.bytes(self.pixels, self.channels, 0)


def plan_memory(
    shape: tuple[int, ...],
    limit: float | None = None,
    wanted: int | None = None,
    flow: FlowParams | None = None,
    filter: FilterParams | None = None,
    dynamics: DynamicsParams | None = None,
    until: str = "deconvolve",
) -> MemoryPlan:
    """Decide how many frames are trained on, where they are kept, and how many threads work.

    Parameters
    ----------
    shape : tuple of int
        Of the frames, (T, H, W) or (T, H, W, 3).
    limit : float, optional
        Most memory of the process, bytes.
    wanted : int, optional
        Training frames that the user asked for; they are not made fewer.
    flow : FlowParams, optional
    filter : FilterParams, optional
    dynamics : DynamicsParams, optional
    until : str
        Last stage.

    Returns
    -------
    MemoryPlan

    Raises
    ------
    DataError
        Fewer than two frames, or frames too small.
    ConfigurationError
        More training frames wanted than there are, or the limit cannot be kept.

    Examples
    --------
    >>> plan_memory((300, 1080, 1920)).train
    60
    >>> plan = plan_memory((300, 1080, 1920), limit=2e9)
    >>> plan.train, plan.in_file
    (60, True)
    """
    flow, filter, dynamics = flow or FlowParams(), filter or FilterParams(), dynamics or DynamicsParams()
    train = training_share(shape[0], shape[1:], wanted)
    if limit is None:
        return MemoryPlan(train, flow.threads)
    channels = shape[3] if len(shape) == 4 else 1
    work = _Work(shape[0], shape[1] * shape[2], channels, filter, dynamics, until)
    most = flow.threads or available_cores()
    fewest = train if wanted is not None else min(train, _FEWEST_IN_NEED)
    for count in range(train, fewest - 1, -1):
        if work.peak(count, 1, True) <= limit:
            choices = ((threads, in_file) for threads in range(most, 0, -1) for in_file in (False, True))
            threads, in_file = next(choice for choice in choices if work.peak(count, *choice) <= limit)
            kept = work.modes(count) + work.stack(count)
            left = limit - _BASE - work.held() - (0 if in_file else kept)
            decisions = tuple(_decisions(work, limit, (train, most), (count, threads, in_file)))
            return MemoryPlan(count, threads, in_file, int(kept) if in_file else 0, left, decisions)
    asked = f" and {train} training frames" if wanted is not None else ""
    raise ConfigurationError(
        f"--memory-limit: expected at least {_text(1.01 * work.peak(fewest, 1, True))} for frames of "
        f"{shape[2]}×{shape[1]}{asked}, found {_text(limit)}; allow more, or use a --roi"
    )


def training_share(frame_count: int, frame_shape: tuple[int, ...], wanted: int | None = None) -> int:
    """How many frames the centroid and the flow dynamics are taken from, if memory is not limited.

    Parameters
    ----------
    frame_count : int
        Frames there are.
    frame_shape : tuple of int
        (H, W) or (H, W, 3).
    wanted : int, optional
        What the user asked for.

    Returns
    -------
    int
        ``wanted``; else all of up to 40 frames, then half of them, at most 100 and at most what 1.5 GB hold.

    Raises
    ------
    DataError
        Fewer than two frames, or frames too small.
    ConfigurationError
        More wanted than there are.

    Examples
    --------
    >>> [training_share(n, (256, 256)) for n in (5, 40, 60, 120, 900)]
    [5, 40, 40, 60, 100]
    """
    if frame_count < 2:
        raise DataError(f"frames: expected at least 2 to restore an image from, found {frame_count}")
    if min(frame_shape[:2]) < MIN_SIDE:
        raise DataError(
            f"frames: expected at least {MIN_SIDE}×{MIN_SIDE} pixels, found {frame_shape[1]}×{frame_shape[0]}"
        )
    if wanted is not None:
        require(wanted >= 2, f"train: expected 2 frames or more, found {wanted}")
        require(wanted <= frame_count, f"train: expected at most the {frame_count} frames there are, found {wanted}")
        return wanted
    share = min(max(frame_count // 2, _FEWEST_TRAINED), _MOST_TRAINED)
    frame_bytes = 4 * (int(np.prod(frame_shape)) + 2 * frame_shape[0] * frame_shape[1])
    return min(frame_count, max(2, min(share, int(_TRAINING_BYTES // frame_bytes))))


def _decisions(work: _Work, limit: float, wanted: tuple[int, int], chosen: tuple[int, int, bool]) -> Iterator[Decision]:
    """Put into words what the limit has changed."""
    (train, most), (count, threads, in_file) = wanted, chosen
    allowed = f"of {_text(limit)} allowed"
    if count < train:
        needed = _text(work.peak(train, 1, True))
        yield Decision("memory", f"{count} training frames, not {train}", f"all of them would take {needed} {allowed}")
    if in_file:
        size = _text(work.stack(count) + work.modes(count))
        yield Decision("memory", "training frames kept in a file", f"with flows and modes they take {size} {allowed}")
    if threads < most:
        needed = _text(work.peak(count, most, in_file))
        yield Decision("memory", f"{threads} of {most} threads", f"all of them would take {needed} {allowed}")


def _text(size: float) -> str:
    return f"{size / 1e9:.2f} GB" if size >= 1e9 else f"{np.ceil(size / 1e6):.0f} MB"

"""How a restoration keeps within a memory limit: what each stage takes, and what is done where that is too much.

Peak memory of the process is taken to be, in bytes, with HW pixels of c channels, T frames, τ of them for training, b
in a block of the filter, n states and t threads::

    base + stack + modes + block + HW · (shared + c · colour + t · (each + c · each_colour))

    stack = τ HW · (4 c + 8)                training frames and their flows
    modes = 8 n HW                          modes of the flow model, once it is identified
    block = min(b, T − τ) HW · (4 c + 2)    frames that follow those, and what flow prepares of them, in the filter

and for the deconvolution what :mod:`turbrestore.deconvolution.deconvolution_memory` says.

Stack and modes may be kept in a file; what the threads have in hand of it then still counts.  Where they are in
memory, what flow prepares of the training frames is kept too, τ HW bytes until the filter has passed over them.

Where even that is too much for whole frames, they are worked on in tiles that overlap
(:mod:`turbrestore.tiled_stages`).  A tile takes what a clip of its size takes.  Before, between and after tiles the
whole images are worked on, which lie in files::

    base + HW · (whole + c · colour)

and while a tile is worked on, what is decoded of the frame that it is cut from is in memory beside it.

The constants of stages are those of ``python benchmarks/memory.py --stages``, and at least a twentieth added: of tiles,
as of whole frames, at 1280×720, grey and in colour, with one, two and four threads, and of the whole beside tiles at
3840×2160; of what codes the images of a report at 1920×1080.
torch counts where a device is asked for, but not what a stage holds there, on the processor or not.  The deconvolution
is told what is left, of whole frames as of tiles, and works in strips of files and fewer threads where that is little;
the other stages need what they need.
So the training frames go to a file first, then fewer threads work side by side, then fewer frames are trained on, and
at last frames are worked on in tiles, as large ones as there is room for with two threads, or below 640 pixels with
one.  Only the last two change the result.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from .core.decision import Decision
from .core.errors import ConfigurationError, DataError, require
from .deconvolution.deconvolution_memory import DeconvolutionWork, Room
from .deconvolution.deconvolve import MARGIN_SIGMAS, DeconvolutionParams
from .dynamics.dynamic_texture import DynamicsParams
from .filtering.alternating import FilterParams
from .registration.flow import MIN_SIDE, FlowParams
from .runtime.device import TORCH_BYTES
from .runtime.jit import COMPILER_BYTES, can_compile
from .runtime.memory_size import size_text
from .runtime.threads import available_cores
from .runtime.tiling import HALO, halo_tiles, largest_tile

_FEWEST_TRAINED, _MOST_TRAINED = 40, 100
# Fewer training frames than these are not worth a lower limit.
_FEWEST_IN_NEED = 10
# Training frames and their flows: 12 bytes a pixel for grey frames, up to this many bytes where no limit is given.
_TRAINING_BYTES = 1.5e9
# Interpreter and libraries, readers, heap between the arrays.
_BASE = 160e6
# Numbers of the modes that a thread has in hand.
_IN_HAND = 1 << 23
# Strips of flows in float64 and what is made of one, and what a flow adds to them a pixel where all fit in one.
_STRIPS, _STRIP_NUMBER = 140e6, 70.0


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
_FILTER = StageMemory(0, 15, 10, 5)
# Of the whole beside tiles: while frames are looked through and read, and the result is put into words and written;
# while the flow model is found, the blur, and bounds on it.
_WHOLE_RESULT, _WHOLE_MODEL = StageMemory(3, 15, 0, 0), StageMemory(27, 0, 0, 0)
_WHOLE_BLUR, _WHOLE_BOUNDS = StageMemory(22, 2, 0, 0), StageMemory(17, 0, 0, 0)
# Beside that, what bounds take for each frame that they are found from, a pixel; and of tiles that are fitted together,
# at most and a pixel, two images or for each frame.
_BOUNDS_FRAME, _BOUNDS_FIT, _PAIR_FIT, _FRAME_FIT = 0.25, 200e6, 80.0, 4.7
# What is decoded of a frame while tiles are cut from it.
_READING = StageMemory(0, 10.5, 0, 0)
# Two maps of the widths of the blur.
_WHOLE_WIDTHS = StageMemory(8, 0, 0, 0)
# Of a report, the frame that it shows included: matplotlib and text; maps of the motion and figures of the images; the
# images, one after the other, and for each pixel that is shown those that are coded, and one that is.
_REPORT_TEXT, _REPORT, _SHOWN = 60e6, StageMemory(23, 5, 0, 0), StageMemory(0, 8.8, 0, 0)
_CODING, _SHOWN_SIDE = StageMemory(31, 5.5, 0, 0), 2048
# A comparison with the true scene, with both images.
_COMPARISON = StageMemory(75, 15, 0, 0)
# Shortest side of a tile that is worth a thread less, pixels, and the step in which sides are tried.
_WORTH, _SIDE_STEP = 640, 32
# The size of tiles changes the result, so it must not follow from the number of cores.
_THREADS_OF_TILES = 2
# Images and maps that earlier stages leave, and what is made of them while the width of the blur is found.
_HELD, _BLUR = StageMemory(60, 40, 0, 0), StageMemory(40, 0, 0, 0)
# Width of the blur where it is not known yet: the widest that is found, pixels.
_WIDEST = 21.0
# From this share of the limit on, what freed arrays leave in the heap counts.
_ROOMY = 0.5
# The largest limit that means anything, bytes.
_MOST = 1e15


@dataclass(frozen=True)
class MemoryPlan:
    """What is done to keep within a limit.

    Attributes
    ----------
    train : int
        Training frames.
    threads : int
        Frames worked on side by side, as in :class:`turbrestore.registration.flow.FlowParams`.
    in_file : bool
        Whether training frames and flows are kept in a file.
    tile : int or None
        Longest side of the tiles that frames are worked on in, pixels; None for whole frames.
    file_bytes : int
        Size of all files, with those of the deconvolution.
    deconvolution : float or None
        Bytes that are left for the deconvolution; None where there is no limit, or no deconvolution.
    tight : bool
        Whether memory that is freed has to go back to the system.
    results : float
        Bytes of the process when all is done; 0 where there is no limit.
    decisions : tuple of Decision
        What the limit has caused.
    """

    train: int
    threads: int
    in_file: bool = False
    tile: int | None = None
    file_bytes: int = 0
    deconvolution: float | None = None
    tight: bool = False
    results: float = 0.0
    decisions: tuple[Decision, ...] = ()


@dataclass(frozen=True)
class _Work:
    """Size of a restoration, and the settings that memory depends on."""

    shape: tuple[int, ...]
    filter: FilterParams
    dynamics: DynamicsParams
    deconvolution: DeconvolutionParams
    until: str
    blur_bounds: bool
    on_device: bool

    @property
    def pixels(self) -> int:
        return self.shape[1] * self.shape[2]

    @property
    def channels(self) -> int:
        return self.shape[3] if len(self.shape) == 4 else 1

    @property
    def base(self) -> float:
        return _BASE + (TORCH_BYTES if self.on_device else 0) + (COMPILER_BYTES if can_compile() else 0)

    @property
    def deblurring(self) -> DeconvolutionWork:
        """The deconvolution, with its margin."""
        sigma = _WIDEST if self.deconvolution.sigma is None else self.deconvolution.sigma
        margin = 2 * int(np.ceil(MARGIN_SIGMAS * sigma)) if self.deconvolution.boundary == "unknown" else 0
        channels = self.channels if self.deconvolution.channels == "each" else 1
        shape = self.shape[1] + margin, self.shape[2] + margin
        return DeconvolutionWork(shape, channels, self.deconvolution.method, self.deconvolution.weights)

    def stack(self, train: int) -> float:
        return train * self.pixels * (4.0 * self.channels + 8.0)

    def modes(self, train: int) -> float:
        if self.until == "centroid":
            return 0.0
        chosen = self.dynamics.rank
        most = min(self.dynamics.max_rank, int(train / self.dynamics.frames_per_state))
        return 8.0 * self.pixels * min(most if chosen is None else chosen, train - 1)

    def peak(self, train: int, threads: int, in_file: bool) -> float:
        """Largest need of any stage, the deconvolution at its least."""
        size = self.pixels, self.channels, threads
        stack, modes = self.stack(train), self.modes(train)
        if in_file:
            # What threads have in hand comes into memory while it is used.
            stack, modes = min(stack, self.stack(2 * threads + 2)), min(modes, 4.0 * _IN_HAND * threads)
        flow = _FLOW.bytes(*size)
        # From the third iteration on that of the first block is kept even there.
        prepared = 0.0 if in_file and self.filter.inner_iterations < 3 else 1.0 * self.pixels * train
        # A frame, what flow prepares of it, and its flow at half the resolution; the first block is that of the stack.
        block = self.pixels * (4.0 * self.channels + 2.0) * min(self.filter.block, self.shape[0] - train)
        judged = 8.0 * self.pixels * train if self.filter.frame_noise == "blur" else 0.0
        deblurred = _BLUR.bytes(*size) + self.deblurring.peak(Room(1, True, True))
        later = {
            "centroid": 0.0,
            "identify": min(_STRIPS, _STRIP_NUMBER * self.pixels * train) + prepared,
            "filter": flow + _FILTER.bytes(*size) + max(block, prepared) + judged,
            "deconvolve": self.held() + max(deblurred, self.bounds(train)),
        }
        stages = list(later)[: list(later).index(self.until) + 1]
        report = self.held() + self.report()
        return self.base + stack + max(flow + prepared, modes + max(report, *(later[stage] for stage in stages)))

    def part(self, side: int) -> _Work:
        """Return the work on one tile: all that tiles are for, so that a run which goes further has the same."""
        largest = largest_tile((self.shape[1], self.shape[2]), side)
        return replace(self, shape=(self.shape[0], *largest, *self.shape[3:]), until="filter")

    def peak_in_tiles(self, train: int, threads: int, side: int) -> float:
        """Largest need of any stage where frames are worked on in tiles."""
        part, size = self.part(side), (self.pixels, self.channels, 0)
        model = _WHOLE_MODEL.bytes(*size) + min(self.modes(train), 4.0 * _IN_HAND * threads)
        model += min(_STRIPS, _STRIP_NUMBER * self.pixels * train)
        deblurred = self.deblurring.peak(Room(1, True, True))
        blur = max(_WHOLE_BLUR.bytes(*size), self.bounds(train), deblurred) + _WHOLE_WIDTHS.bytes(*size)
        result = _WHOLE_RESULT.bytes(*size)
        later = {"centroid": result, "identify": max(result, model), "filter": result, "deconvolve": blur}
        stages = list(later)[: list(later).index(self.until) + 1]
        reading = part.peak(train, threads, True) + _READING.bytes(*size)
        return max(reading, self.base + max(self.report(), *(later[stage] for stage in stages)))

    def bounds(self, train: int) -> float:
        """Bounds on the width of the blur."""
        if not self.blur_bounds:
            return 0.0
        fit = min(_BOUNDS_FIT, (_PAIR_FIT + _FRAME_FIT * train) * self.pixels)
        return _WHOLE_BOUNDS.bytes(self.pixels, self.channels, 0) + fit + _BOUNDS_FRAME * train * self.pixels

    def report(self) -> float:
        """Room for a report, whether or not there will be one: the result must not follow from that."""
        shown = self.pixels * min(1.0, _SHOWN_SIDE / max(self.shape[1:3])) ** 2
        coding = _SHOWN.bytes(self.pixels, self.channels, 0) + _CODING.bytes(int(shown), self.channels, 0)
        return _REPORT_TEXT + max(_REPORT.bytes(self.pixels, self.channels, 0), coding)

    def held(self) -> float:
        """Results of the stages before the deconvolution."""
        return _HELD.bytes(self.pixels, self.channels, 0)

    def left(self, limit: float, kept: float) -> float | None:
        """Bytes for the deconvolution, beside what is kept in memory."""
        if self.until != "deconvolve":
            return None
        return min(limit - self.base - self.held() - kept, self.deconvolution.memory or _MOST)

    def room(self, memory: float | None) -> Room:
        """How the deconvolution works."""
        return self.deblurring.room(memory if self.until == "deconvolve" else None, available_cores())


def plan_memory(
    shape: tuple[int, ...],
    limit: float | None = None,
    wanted: int | None = None,
    flow: FlowParams | None = None,
    filter: FilterParams | None = None,
    dynamics: DynamicsParams | None = None,
    deconvolution: DeconvolutionParams | None = None,
    until: str = "deconvolve",
    blur_bounds: bool = False,
    on_device: bool = False,
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
    deconvolution : DeconvolutionParams, optional
    until : str
        Last stage.
    blur_bounds : bool
        Whether bounds on the width of the blur are found.
    on_device : bool
        Whether any stage may compute with torch.

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
    work = _Work(shape, filter, dynamics, deconvolution or DeconvolutionParams(), until, blur_bounds, on_device)
    if limit is None:
        room = work.room(work.deconvolution.memory)
        return MemoryPlan(train, flow.threads, file_bytes=int(work.deblurring.files(room)))
    most = flow.threads or available_cores()
    fewest = train if wanted is not None else min(train, _FEWEST_IN_NEED)
    for count in range(train, fewest - 1, -1):
        if work.peak(count, 1, True) <= limit:
            choices = ((threads, in_file) for threads in range(most, 0, -1) for in_file in (False, True))
            chosen = next(choice for choice in choices if work.peak(count, *choice) <= limit)
            return _plan(work, limit, (train, most), (count, *chosen))
    # In a file there is room for more frames than without a limit.
    train = train if wanted is not None else max(train, min(_FEWEST_IN_NEED, shape[0]))
    for threads, side in _tilings(work):
        if work.peak_in_tiles(train, threads, side) <= limit:
            return _plan_in_tiles(work, limit, (train, most), side)
    smallest = list(_tilings(work))[-1:]
    least = min([work.peak(fewest, 1, True), *(work.peak_in_tiles(train, *tiling) for tiling in smallest)])
    asked = f" and {train} training frames" if wanted is not None else ""
    raise ConfigurationError(
        f"--memory-limit: expected at least {size_text(1.01 * least)} for frames of "
        f"{shape[2]}×{shape[1]}{asked}, found {size_text(limit)}; allow more, or use a --roi"
    )


def check_comparison(
    plan: MemoryPlan, limit: float | None, frame_shape: tuple[int, ...], truth_shape: tuple[int, ...]
) -> None:
    """Refuse a comparison with the true scene, after a restoration, that would take more memory than is allowed.

    Parameters
    ----------
    plan : MemoryPlan
    limit : float or None
        What the plan is for, bytes.
    frame_shape, truth_shape : tuple of int
        (H, W) or (H, W, 3).

    Raises
    ------
    ConfigurationError
        It would.

    Examples
    --------
    >>> plan = plan_memory((9, 4320, 7680), 2e9)
    >>> check_comparison(plan, 2e9, (4320, 7680), (4320, 7680))
    Traceback (most recent call last):
    ...
    turbrestore.core.errors.ConfigurationError: --truth: ...
    """
    if limit is None:
        return
    pixels = max(shape[0] * shape[1] for shape in (frame_shape, truth_shape))
    channels = 3 if max(len(frame_shape), len(truth_shape)) == 3 else 1
    least = plan.results + _COMPARISON.bytes(pixels, channels, 0)
    require(
        limit >= least,
        f"--truth: expected a --memory-limit of at least {size_text(1.01 * least)} to compare images of "
        f"{truth_shape[1]}×{truth_shape[0]}, found {size_text(limit)}; allow more, or leave it out and compare the "
        "result with turbrestore evaluate",
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


def _tilings(work: _Work) -> Iterator[tuple[int, int]]:
    """Yield numbers of threads and sides of tiles, the best ones first."""
    largest = max(work.shape[1:3])
    yield from ((_THREADS_OF_TILES, side) for side in reversed(range(_WORTH, largest, _SIDE_STEP)))
    yield from ((1, side) for side in reversed(range(4 * HALO, min(_WORTH, largest), _SIDE_STEP)))


def _plan(work: _Work, limit: float, wanted: tuple[int, int], chosen: tuple[int, int, bool]) -> MemoryPlan:
    """Training frames and threads are wanted, and chosen with a file or without."""
    count, threads, in_file = chosen
    kept = work.modes(count) + work.stack(count)
    left = work.left(limit, 0 if in_file else kept)
    room = work.room(left)
    maps = 16.0 * work.pixels if work.modes(count) else 0.0
    files = (kept + maps if in_file else 0) + work.deblurring.files(room)
    decisions = tuple(_decisions(work, limit, wanted, chosen, room))
    tight = bool(decisions) or work.peak(*chosen) > _ROOMY * limit
    results = work.base + work.held() + (0 if in_file else kept)
    return MemoryPlan(count, threads, in_file, None, int(files), left, tight, results, decisions)


def _plan_in_tiles(work: _Work, limit: float, wanted: tuple[int, int], side: int) -> MemoryPlan:
    """Training frames and threads are wanted; tiles of this side fit with one thread at least."""
    train, most = wanted
    # Of all sides with the same tiles, the same one, for results that are kept are told apart by it.
    side = max(*largest_tile((work.shape[1], work.shape[2]), side), 4 * HALO)
    threads = next(count for count in range(most, 0, -1) if work.peak_in_tiles(train, count, side) <= limit)
    part, widths = work.part(side), _WHOLE_WIDTHS.bytes(work.pixels, work.channels, 0)
    left = work.left(limit, widths - work.held())
    # Maps of the flow models; results of two tries of the blur, centroid, sums of the tiles, and the tiles themselves,
    # which overlap fourfold where they are small.
    images = 16.0 * (work.pixels + part.pixels) + 4.0 * work.pixels * (6 + 14 * work.channels)
    files = work.modes(train) + work.stack(train) + part.modes(train) + part.stack(train) + images
    files += work.deblurring.files(work.room(left))
    decisions = tuple(_decisions_in_tiles(work, limit, part, (threads, most), side))
    return MemoryPlan(train, threads, True, side, int(files), left, True, work.base, decisions)


def _decisions_in_tiles(
    work: _Work, limit: float, part: _Work, threads: tuple[int, int], side: int
) -> Iterator[Decision]:
    """Put into words what the limit has changed; threads are those that work, and those that there are."""
    height, width = part.shape[1:3]
    tiles = len(halo_tiles((work.shape[1], work.shape[2]), side))
    words = f"{tiles} tiles of up to {width}×{height} pixels, training frames kept in a file"
    yield Decision("memory", words, f"whole frames would take more than the {size_text(limit)} allowed")
    if threads[0] < threads[1]:
        yield Decision("memory", f"{threads[0]} of {threads[1]} threads", "more of them would need smaller tiles")


def _decisions(
    work: _Work, limit: float, wanted: tuple[int, int], chosen: tuple[int, int, bool], room: Room
) -> Iterator[Decision]:
    """Put into words what the limit has changed."""
    (train, most), (count, threads, in_file) = wanted, chosen
    allowed = f"of {size_text(limit)} allowed"
    if count < train:
        needed = size_text(work.peak(train, 1, True))
        yield Decision("memory", f"{count} training frames, not {train}", f"all of them would take {needed} {allowed}")
    if in_file:
        size = size_text(work.stack(count) + work.modes(count))
        yield Decision("memory", "training frames kept in a file", f"with flows and modes they take {size} {allowed}")
    if threads < most:
        needed = size_text(work.peak(count, most, in_file))
        yield Decision("memory", f"{threads} of {most} threads", f"all of them would take {needed} {allowed}")
    if room.in_file:
        kept = ["nonlocal pairs"] if work.deblurring.pairs() else []
        kept += ["images of the deconvolution"] if room.images_in_file else []
        size = size_text(work.deblurring.files(room))
        # What is not known yet is taken to be the widest blur that may be found.
        words = "kept in files" if work.deconvolution.sigma is not None else "kept in files where the blur is wide"
        yield Decision("memory", f"{' and '.join(kept)} {words}", f"they take up to {size} {allowed}")

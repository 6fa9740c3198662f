"""How a restoration keeps within a memory limit, and takes no more than it has to without one.

Every stage says beside its code how many bytes it takes; the peak of a restoration is the largest sum of what is held
and what one stage takes.  The plan is the first of these that fits:

1. all in memory, on all threads;
2. training frames and their flows in a scratch file, without a limit too where memory would take more than 2.2 GB;
3. fewer threads;
4. fewer training frames, down to ten, unless their number was given;
5. frames in tiles that overlap (:mod:`turbrestore.tiles`), as large as fit.

The deconvolution splits its image into tiles where the limit is too small for the whole.  Fewer training frames and
tiles change the result, slightly; nothing else does, and neither depends on the number of threads.
"""

from __future__ import annotations

import math
import os
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np

from .core.arrays import PART
from .core.decision import Decision
from .core.errors import ConfigurationError, DataError, require
from .deblurring.remove_blur import SMALLEST_SIDE, remove_blur_memory
from .dynamics.dynamic_texture import identify_memory, modes_memory
from .filtering.filter_records import filter_memory
from .footage.survey import survey_memory, survey_scratch_bytes
from .registration.flow import MIN_SIDE
from .registration.flow_methods.opencv_flow import flow_memory
from .registration.registered_noise import halves_memory, kept_halves_memory
from .runtime.device import TORCH_BYTES, find_device, needs_torch
from .runtime.jit import COMPILER_BYTES
from .runtime.memory_size import size_text
from .runtime.runtime import Runtime
from .runtime.tiling import HALO, halo_tiles, largest_tile
from .settings import RestoreParams
from .verification.halves import keep_agreed_memory

# Half of a clip trains, but no fewer frames than the first and no more than the second; both chosen.
_FEWEST_TRAINED, _MOST_TRAINED = 40, 100
# Fewer training frames than these are not worth a lower limit, chosen.
_FEWEST_IN_NEED = 10
# Most that training frames and their flows take where no limit is given, bytes, chosen.
_TRAINING_BYTES = 1.5e9
# Peak without a limit from which training frames go to a scratch file, bytes; required free space as a multiple of it;
# both chosen.
_SPILL_ABOVE_BYTES, _FREE_SPACE_FACTOR = 2.2e9, 3
# Interpreter, libraries and readers, bytes.  Runs with limits in benchmarks/results/memory.md show that this and what
# follows down to the report suffice, but not that less would not.
_BASE = 1.6e8
# Memory of the preparation, bytes a pixel and bytes a pixel and channel.
_PREPARED, _PREPARED_COLOUR = 44, 34
# Images and maps that the stages leave, bytes a pixel and bytes a pixel and channel; with tiles most of them lie in
# scratch files.
_RESULTS, _RESULTS_COLOUR = 60, 48
_RESULTS_OF_TILES, _RESULTS_OF_TILES_COLOUR = 3, 23
# A report with its pictures, which are at most 2048 pixels wide: bytes, bytes a pixel and a pixel that is shown.
_REPORT, _REPORT_PIXEL, _REPORT_SHOWN, _SHOWN_SIDE = 6e7, 40, 50, 2048
# Elements of the modes that a thread holds while they lie in a file: twice the PART that is read of them at once.
_MODE_ELEMENTS_PER_THREAD = 2 * PART
# Side of a tile below which one thread is used, and the step in which sides are tried, pixels; both chosen.
_ONE_THREAD_BELOW, _SIDE_STEP = 640, 32
# The size of the tiles changes the result, so it must not depend on the number of cores; two were chosen.
_THREADS_OF_TILES = 2


@dataclass(frozen=True)
class MemoryPlan:
    """What is done to keep within a memory limit."""

    train: int  # number of training frames
    # For the stages: the threads that work, the device that was found, and the folder of the scratch files or None.
    runtime: Runtime
    tile: int | None = None  # longest side of the tiles in which frames are processed, pixels; None for whole frames
    scratch_bytes: int = 0  # size of all scratch files
    # Longest side of the tiles in which the image is deconvolved, pixels; None for the whole image.
    deconvolution_side: int | None = None
    decisions: tuple[Decision, ...] = ()  # what is done to save memory, in words


@dataclass(frozen=True)
class _Choice:
    """What the plan may choose."""

    train: int
    threads: int
    in_scratch: bool = False
    tile: int | None = None


def plan_memory(shape: tuple[int, ...], params: RestoreParams, runtime: Runtime) -> MemoryPlan:
    """Decide how many frames are trained on and where they are kept, and set threads and tiles."""
    train = training_share(shape[0], shape[1:], params.train, params.filter.training == "skip")
    runtime = replace(runtime, device=find_device(runtime.device))
    folder = runtime.scratch or Path(tempfile.gettempdir())
    most = runtime.workers
    tile = runtime.tile if runtime.tile is not None and max(shape[1:3]) > runtime.tile else None
    base = _BASE + COMPILER_BYTES + (TORCH_BYTES if needs_torch(runtime.device) else 0)
    if runtime.memory_limit is None and tile is None:
        return _without_limit(shape, params, _Choice(train, most), replace(runtime, scratch=folder), base)
    limit = math.inf if runtime.memory_limit is None else runtime.memory_limit
    budget = limit - base
    for choice in _choices(shape, train, most, params, tile):
        if _peak(shape, params, choice, budget) <= budget:
            break
    else:
        raise _too_little(shape, params, base, limit)
    if choice.tile is not None:
        threads = (replace(choice, threads=count) for count in range(most, 0, -1))
        choice = next((other for other in threads if _peak(shape, params, other, budget) <= budget), choice)
    return MemoryPlan(
        choice.train,
        replace(runtime, threads=choice.threads, scratch=folder if choice.in_scratch else None),
        choice.tile,
        _scratch_bytes(shape, params, choice) if choice.in_scratch else 0,
        _deconvolution_side(shape, params, choice, budget),
        tuple(_decisions(shape, params, choice, _Choice(train, most, tile=tile), base, limit)),
    )


def _without_limit(
    shape: tuple[int, ...], params: RestoreParams, choice: _Choice, runtime: Runtime, base: float
) -> MemoryPlan:
    """Keep the training frames in a scratch file if memory takes much and the disk has room; no result changes."""
    in_file, folder = replace(choice, in_scratch=True), runtime.scratch
    size = _scratch_bytes(shape, params, in_file)
    much = base + _peak(shape, params, choice, math.inf) > _SPILL_ABOVE_BYTES
    if not much or folder is None or not _has_room(folder, _FREE_SPACE_FACTOR * size):
        return MemoryPlan(choice.train, replace(runtime, scratch=None))
    decisions = tuple(_decisions(shape, params, in_file, choice, base, math.inf))
    return MemoryPlan(choice.train, runtime, scratch_bytes=size, decisions=decisions)


def _has_room(folder: Path, size: int) -> bool:
    try:
        return os.access(folder, os.W_OK) and shutil.disk_usage(folder).free >= size
    except OSError:
        return False


def training_share(
    frame_count: int, frame_shape: tuple[int, ...], wanted: int | None = None, half: bool = False
) -> int:
    """Return how many frames the centroid and the flow dynamics are found from, if memory is not limited."""
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
    share = min(max(frame_count // 2, 0 if half else _FEWEST_TRAINED), _MOST_TRAINED)
    return min(frame_count, max(share, 2), frames_in_memory(frame_shape))


def frames_in_memory(frame_shape: tuple[int, ...]) -> int:
    """Return how many frames, each with its flow, 1.5 GB hold, and at least two."""
    frame_bytes = 4 * (int(np.prod(frame_shape)) + 2 * frame_shape[0] * frame_shape[1])
    return max(2, int(_TRAINING_BYTES // frame_bytes))


def _choices(
    shape: tuple[int, ...], train: int, most: int, params: RestoreParams, tile: int | None = None
) -> Iterator[_Choice]:
    """Yield what may be done, the best first; only tiles that are not larger than ``tile``, if that is given."""
    if tile is None:
        fewest = train if params.train is not None else min(train, _FEWEST_IN_NEED)
        for count, threads in product(range(train, fewest - 1, -1), range(most, 0, -1)):
            yield _Choice(count, threads)
            yield _Choice(count, threads, in_scratch=True)
    # A file holds more frames than memory does without a limit.
    train = train if params.train is not None else max(train, min(_FEWEST_IN_NEED, shape[0]))
    longest = max(shape[1:3])
    if tile is not None:
        yield _tiles_of(shape, train, _THREADS_OF_TILES, tile)
        longest = tile
    for side in reversed(range(_ONE_THREAD_BELOW, longest, _SIDE_STEP)):
        yield _tiles_of(shape, train, _THREADS_OF_TILES, side)
    for side in reversed(range(4 * HALO, min(_ONE_THREAD_BELOW, longest), _SIDE_STEP)):
        yield _tiles_of(shape, train, 1, side)


def _tiles_of(shape: tuple[int, ...], train: int, threads: int, side: int) -> _Choice:
    # Of all sides that cut the same tiles the same one, because kept results are recognised by it.
    side = max(*largest_tile((shape[1], shape[2]), side), 4 * HALO)
    return _Choice(train, threads, in_scratch=True, tile=side)


def _peak(shape: tuple[int, ...], params: RestoreParams, choice: _Choice, budget: float) -> float:
    """Bytes of the stage that takes most, with what is held meanwhile."""
    part = shape if choice.tile is None else (shape[0], *largest_tile((shape[1], shape[2]), choice.tile), *shape[3:])
    train, threads = choice.train, choice.threads
    frames, flows, modes = _stack(part, params, train)
    if choice.in_scratch:
        in_hand = (2 * threads + 2) / train
        frames, flows, modes = frames * in_hand, flows * in_hand, min(modes, 4 * _MODE_ELEMENTS_PER_THREAD * threads)
    # The sum of the frames; in tiles the frame that is being read, while the other images of the whole lie in files.
    held = frames + flows + (8 if choice.tile is None else 10.5) * _pixels(shape) * _channels(shape)
    flow, side = flow_memory(part, threads), _deconvolution_side(shape, params, choice, budget)
    results = _held_by_deconvolution(shape, params, choice)
    prepared = _pixels(shape) * float(_PREPARED + _PREPARED_COLOUR * _channels(shape))
    prepared += survey_memory(shape, choice.in_scratch)
    deblurring = max(remove_blur_memory(shape[1:], params.deconvolution, side), keep_agreed_memory(shape[1:]))
    # The halves of the clip are of whole frames in any case.
    filtering = max(flow + filter_memory(part, train, params.filter, threads), halves_memory(shape[1:], threads))
    stages = {
        "centroid": max(held + flow, prepared),
        "identify": held + modes + identify_memory(part, train),
        "filter": held + modes + filtering,
        "deconvolve": results + _kept_halves(shape, params) + deblurring,
    }
    finer = 0.0 if params.scale == 1 else results + _on_finer_grid(shape, params, threads)
    return max(finer, results + _report(shape), *(size for name, size in stages.items() if params.runs(name)))


def _on_finer_grid(shape: tuple[int, ...], params: RestoreParams, threads: int) -> float:
    """Bytes of the sums of two halves, which every thread has too, and of the deconvolution there."""
    side = round(params.scale * shape[1]), round(params.scale * shape[2]), *shape[3:]
    sums = side[0] * side[1] * 16 * (_channels(shape) + 1) * (threads + 2)
    return max(sums, remove_blur_memory(side, params.deconvolution) + 8 * side[0] * side[1] * _channels(shape))


def _deconvolution_side(shape: tuple[int, ...], params: RestoreParams, choice: _Choice, budget: float) -> int | None:
    """Return the side of the largest tiles that fit while the training frames are in a scratch file.

    It is the same where they are in memory, so that the result does not depend on the number of threads.
    """
    left = (
        budget - _held_by_deconvolution(shape, params, replace(choice, in_scratch=True)) - _kept_halves(shape, params)
    )
    size = shape[1], shape[2]
    sides = range(max(size) - _SIDE_STEP, SMALLEST_SIDE, -_SIDE_STEP)
    for side in (None, *sides):
        if remove_blur_memory(shape[1:], params.deconvolution, side) <= left:
            # Of all sides that cut the same tiles the same one.
            return None if side is None else max(*largest_tile(size, side), SMALLEST_SIDE)
    return SMALLEST_SIDE


def _stack(shape: tuple[int, ...], params: RestoreParams, train: int) -> tuple[float, float, float]:
    """Bytes of the training frames, of their flows and of the modes of the flow model."""
    pixels = _pixels(shape)
    modes = modes_memory(shape, train, params.dynamics) if params.runs("identify") else 0.0
    return 4 * train * pixels * _channels(shape), 8 * train * pixels, modes


def _held_by_deconvolution(shape: tuple[int, ...], params: RestoreParams, choice: _Choice) -> float:
    """Bytes of the results of the stages before the deconvolution."""
    if choice.tile is not None:
        return _pixels(shape) * float(_RESULTS_OF_TILES + _RESULTS_OF_TILES_COLOUR * _channels(shape))
    held = _pixels(shape) * float(_RESULTS + _RESULTS_COLOUR * _channels(shape))
    return held if choice.in_scratch else held + sum(_stack(shape, params, choice.train)[1:])


def _kept_halves(shape: tuple[int, ...], params: RestoreParams) -> float:
    """Bytes of the halves that the result is compared with, where the width of the blur is not given."""
    return kept_halves_memory(shape[1:]) if params.finds_blur else 0.0


def _scratch_bytes(shape: tuple[int, ...], params: RestoreParams, choice: _Choice) -> int:
    size = sum(_stack(shape, params, choice.train)) + 16 * _pixels(shape)
    if choice.tile is not None:
        part = shape[0], *largest_tile((shape[1], shape[2]), choice.tile), *shape[3:]
        # A tile has copies of its frames and flows and a model of its own; tiles of the images overlap up to fourfold.
        size += sum(_stack(part, params, choice.train)) + 4 * _pixels(shape) * (6 + 14 * _channels(shape))
    return int(max(size, survey_scratch_bytes(shape)))


def _report(shape: tuple[int, ...]) -> float:
    """Bytes of a report, reserved whether or not there will be one: the result must not depend on that."""
    shown = _pixels(shape) * min(1.0, _SHOWN_SIDE / max(shape[1:3])) ** 2
    return _REPORT + _REPORT_PIXEL * _pixels(shape) + _REPORT_SHOWN * shown


def _pixels(shape: tuple[int, ...]) -> int:
    return shape[1] * shape[2]


def _channels(shape: tuple[int, ...]) -> int:
    return shape[3] if len(shape) == 4 else 1


def _too_little(shape: tuple[int, ...], params: RestoreParams, base: float, limit: float) -> ConfigurationError:
    train = training_share(shape[0], shape[1:], params.train, params.filter.training == "skip")
    least = base + min(_peak(shape, params, choice, 0.0) for choice in _choices(shape, train, 1, params))
    asked = "" if params.train is None else f" and {train} training frames"
    return ConfigurationError(
        f"memory_limit: expected at least {size_text(1.01 * least)} for frames of {shape[2]}×{shape[1]}{asked}, "
        f"found {size_text(limit)}; allow more, or restore a smaller part of the frame (roi)"
    )


def _decisions(
    shape: tuple[int, ...], params: RestoreParams, choice: _Choice, wanted: _Choice, base: float, limit: float
) -> Iterator[Decision]:
    """Put into words what the limit has changed."""
    allowed = size_text(limit)

    def needed(other: _Choice) -> str:
        return f"{size_text(base + _peak(shape, params, other, limit - base))} of {allowed} allowed"

    few_threads = f"{choice.threads} of {wanted.threads} threads" if choice.threads < wanted.threads else None
    if choice.tile is not None:
        height, width = largest_tile((shape[1], shape[2]), choice.tile)
        count = len(halo_tiles((shape[1], shape[2]), choice.tile))
        words = f"{count} tiles of up to {width}×{height} pixels, training frames in a scratch file"
        because = f"whole frames would take more than the {allowed} allowed"
        yield Decision("memory", words, because if wanted.tile is None else "tiles were asked for")
        if few_threads:
            yield Decision("memory", few_threads, "more threads would need smaller tiles")
    else:
        if choice.train < wanted.train:
            every = needed(_Choice(wanted.train, 1, in_scratch=True))
            yield Decision("memory", f"{choice.train} training frames, not {wanted.train}", f"all would take {every}")
        if choice.in_scratch:
            size = size_text(_scratch_bytes(shape, params, choice))
            yield Decision("memory", "training frames in a scratch file", f"with flows and modes they take {size}")
        if few_threads:
            every = needed(replace(choice, threads=wanted.threads))
            yield Decision("memory", few_threads, f"all would take {every}")
    side = _deconvolution_side(shape, params, choice, limit - base)
    if side is not None and params.runs("deconvolve"):
        words = f"deconvolution in tiles of up to {side} pixels"
        yield Decision("memory", words, f"the whole image would take more than the {allowed} allowed")

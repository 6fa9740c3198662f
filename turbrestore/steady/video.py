"""Video in, video out: every frame steadied by its neighbours and the memory of the scene, and deblurred.

1. A frame is freed of its turbulent displacement, and fused with its neighbours
   (:mod:`turbrestore.steady.dewarping`), as soon as the last of them is there.
2. Where the scene is static it is fused with the memory of all frames before (:mod:`turbrestore.steady.memory`), which
   lies at the mean geometry of the frames around, if they can be read ahead (:mod:`turbrestore.steady.scene_mean`).
3. One blur, which windows of frames tell (:mod:`turbrestore.steady.window_blur`), is removed from every frame by linear
   filters (:mod:`turbrestore.steady.deblurring`); from what is remembered, one that is estimated there.
4. A title, where a static camera has drawn one, keeps the pixels of its frame (:mod:`turbrestore.footage.overlays`).

What is carried from frame to frame is the memory, the blurs and, where the camera is locked, its path.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass, replace
from itertools import chain, islice, repeat

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..blur.psf import KOLMOGOROV
from ..core.arrays import FloatArray, luminance
from ..core.errors import DataError, settings_of
from ..display.preview import summary
from ..footage.overlays import Title, find_title
from ..footage.survey import take_survey
from ..io.source import FrameSource
from ..registration.warp import sample_linear, warp
from ..runtime.runtime import DEFAULT, Runtime
from ..runtime.threads import map_in_turns, one_thread_each
from .camera_path.camera import Matrix, camera_flow
from .camera_path.path import LONGEST, camera_position, homogeneous, longer_path, motion, smooth_motion
from .deblurring import deblur
from .dewarping import DewarpedFrame, dewarp_frame, measure_flow
from .displacement import largest_displacement, whole_displacement
from .fusion import for_channels, share_of_estimate
from .grid import enlarged, follow, pixel_of, reduced
from .memory import Around, Memory, remember, shown
from .scene_mean import SceneMean, iter_scene_means
from .settings import SteadyParams
from .window_blur import WindowWitnesses, find_blur_of_image, find_blur_of_window, find_blur_of_windows
from .windows import Window, iter_windows, relit

# Frames since the memory began when the width of its blur is estimated, and frames over which the width that is removed
# goes there, so that no frame is suddenly sharper; both chosen.
_REMEMBERED, _GRADUALLY = 24, 16


@dataclass(frozen=True, eq=False)
class SteadyFrame:
    """A frame of a steadied video.

    Attributes
    ----------
    number : int
        Number of the frame in the stream, from 0.
    image : ndarray, float32, shape (H, W) or (H, W, 3)
    moving : ndarray, bool, shape (H, W)
        Where something moves against the scene.
    displacement : float
        Root mean square of the displacement that was removed, pixels.
    sigma : float
        Width of the blur that was removed from a frame, pixels.
    starts_scene : bool
        Whether a new scene starts here.
    replaced : float
        Share of the accumulated image, or of the estimate, that this frame replaced, because the frames lay nearer to
        their own mean or were sharper (:mod:`turbrestore.steady.fusion`).
    """

    number: int
    image: FloatArray
    moving: NDArray[np.bool_]
    displacement: float
    sigma: float
    starts_scene: bool
    replaced: float

    def __repr__(self) -> str:
        removed = f"{self.displacement:.2f} pixels of motion, {self.sigma:.2f} of blur"
        return summary("SteadyFrame", [("number", str(self.number)), ("removed", removed)], self.image.shape)


def steady_frames(
    frames: Iterable[ArrayLike], params: SteadyParams | None = None, runtime: Runtime = DEFAULT
) -> Iterator[SteadyFrame]:
    """Steady a stream of frames, one output frame for each input frame.

    Frames that can be read again, as those of an array, a list or :func:`turbrestore.open_frames`, are read ahead by 60
    frames, once more at the start for the blur, and placed in the mean of about 48 frames before and after them.  The
    frames of an iterator, and all with ``params.live``, are placed by those before them and their neighbours after
    them, which leaves turbulence that moves the whole image slowly.

    The output lags behind an iterator by ``params.reach`` frames and two for each thread, and at the start by half of
    ``params.reach`` more, because the blur is estimated there; with ``params.live`` by two frames.  Memory does not
    grow with the length of the stream.

    Parameters
    ----------
    frames : iterable of array_like, shape (H, W) or (H, W, 3)
        Intensities in [0, 1]; read lazily, and more than once unless it is an iterator.
    params : SteadyParams, optional
        Settings.
    runtime : Runtime
        Threads.

    Yields
    ------
    SteadyFrame

    Raises
    ------
    DataError
        Frames differ in size or are smaller than 16×16, values are not finite or on another scale than 0 to 1, or there
        are fewer frames when they are read again.
    ConfigurationError
        Settings are of another type.

    Examples
    --------
    >>> frames = np.random.default_rng(0).random((1, 32, 32)).repeat(3, 0)
    >>> [frame.number for frame in steady_frames(frames, SteadyParams(sigma=0))]
    [0, 1, 2]
    """
    params = settings_of(SteadyParams, params)
    windows = iter_windows(frames, params.distances, params.later)
    if params.live:
        yield from _one_by_one(windows, params, runtime)
        return
    # The first frame that has neighbours on both sides.
    head = list(islice(windows, params.reach // 2 + 1))
    twice = _can_be_read_twice(frames)
    sigma, exponent, said = params.sigma, KOLMOGOROV, None
    if head and sigma is None:
        seen = [window for window in head if not window.frame.blank]
        sigma, exponent, said = find_blur_of_windows(seen[-1], frames if twice else (), params, runtime)
    width = sigma or 0.0
    scenes = _Scenes(params, width, said, runtime)
    if head:
        scenes.keep_title(head[-1])
    means = iter_scene_means(frames) if twice else repeat(None)
    yield from map_in_turns(
        lambda pair: (dewarp_frame(pair[0], params), pair[1]),
        lambda pair: (pair[0], scenes.estimate(*pair)),
        lambda pair: _sharpened(*pair, width, exponent),
        _paired(chain(head, windows), means),
        runtime.threads,
    )


def _can_be_read_twice(frames: Iterable[ArrayLike]) -> bool:
    return not isinstance(frames, Iterator) and iter(frames) is not iter(frames)


def _paired(windows: Iterable[Window], means: Iterable[SceneMean | None]) -> Iterator[tuple[Window, SceneMean | None]]:
    """Yield the window of every frame with the mean around it."""
    means = iter(means)
    for window in windows:
        try:
            mean = next(means)
        except StopIteration:
            found = f"only {window.number} another time"
            raise DataError(
                f"frames: expected the same frames every time they are read, found {found}; pass iter(frames)"
            ) from None
        yield window, mean


def _one_by_one(windows: Iterable[Window], params: SteadyParams, runtime: Runtime) -> Iterator[SteadyFrame]:
    """Frames of a live stream, each before the next is asked for.  OpenCV shares out what one frame takes."""
    sigma, exponent, unknown = params.sigma or 0.0, KOLMOGOROV, True
    scenes = _Scenes(params, sigma, None, runtime)
    with nullcontext() if runtime.threads != 1 else one_thread_each():
        for window in windows:
            if unknown and window.number >= params.reach // 2 and not window.frame.blank:
                unknown = False
                scenes.keep_title(window)
                if params.sigma is None:
                    sigma, exponent, said = find_blur_of_window(window, params, runtime)
                    scenes.remove(sigma, said)
            frame = dewarp_frame(window, params)
            yield _sharpened(frame, scenes.estimate(frame, None), sigma, exponent)


class _Scenes:
    """What is carried from frame to frame of a scene."""

    def __init__(self, params: SteadyParams, sigma: float, said: WindowWitnesses | None, runtime: Runtime) -> None:
        self._params = params
        self._memory: Memory | None = None
        self._runtime = runtime
        self._found: float | None = None
        self._title: Title | None = None
        self.remove(sigma, said)
        self._positions: deque[Matrix] = deque(maxlen=LONGEST)
        # From the frame before to the steadied one.
        self._steadied = np.eye(3)

    def remove(self, sigma: float, said: WindowWitnesses | None) -> None:
        """Set the blur width of frames; the witnesses ``said`` allow another for the accumulated image."""
        self._said, self._first, self._width = said, sigma, sigma

    def keep_title(self, window: Window) -> None:
        """Keep the title that a static camera has drawn over the frames of a window, as long as it is there."""
        images = [frame.image for _, frame in sorted({0: window.frame, **window.neighbours}.items())]
        shape = (len(images), *images[0].shape[:2])
        # Nothing says how many bits a stream has, nor is it held to the range that a clip is.
        clip = FrameSource(
            "stream", "array", shape, 1, 8, lambda chosen: (np.clip(luminance(images[k]), 0, 1) for k in chosen)
        )
        self._title = find_title(take_survey(clip))

    def estimate(
        self, frame: DewarpedFrame, mean: SceneMean | None
    ) -> tuple[Memory, NDArray[np.bool_], float, Title | None]:
        """Estimate of the scene at a frame, what moves, the width of the blur of what is remembered, and the title."""
        if frame.starts_scene:
            self._memory, self._width, self._found = None, self._first, None
            self._positions.clear()
        if frame.seen.blank:
            # What is remembered waits for the next frame, and nothing tells that the camera has moved.
            self._positions.append(self._positions[-1])
            still = np.eye(3)
            alone = remember(
                None, frame.image, measure_flow, frame.noise, frame.largest, 0.0, frame.moving, still, still
            )
            return alone, frame.moving, 0.0, self._title
        carry, offset, around = self._follow(frame, mean)
        image, moving = frame.image, frame.moving
        if self._params.camera != "keep":
            image, moving = _placed(image, moving, offset)
            offset = np.eye(3)
        self._memory = remember(
            self._memory,
            image,
            measure_flow,
            frame.noise,
            frame.largest,
            frame.steadiness,
            moving,
            carry,
            offset,
            around,
        )
        estimate = shown(self._memory)
        if self._params.camera == "keep":
            estimate = _checked(estimate, frame, self._steadied)
        if self._title is not None:
            self._title = self._title.at_rest(frame.seen.image, frame.noise)
        return estimate, moving, self._remembered_width(self._memory), self._title

    def _follow(self, frame: DewarpedFrame, mean: SceneMean | None) -> tuple[Matrix, Matrix, Around | None]:
        """Follow the camera: maps from the steadied frame to the one before and to the dewarped one, the mean."""
        shape = frame.moving.shape
        position = camera_position(self._positions, frame.cameras) if mean is None else mean.position
        dewarped = homogeneous(frame.removed_camera)
        if self._params.camera == "lock":
            if not self._positions:
                self._start = dewarped
            steadied = self._start @ np.linalg.inv(position)
        elif self._params.camera == "steady":
            steadied = dewarped
        else:
            tolerance = whole_displacement(frame.size, frame.largest)
            path = longer_path(self._positions, position, frame.cameras) if mean is None else mean.path
            steadied = homogeneous(frame.turbulence * smooth_motion(path, tolerance, shape))
        back, carry = np.linalg.inv(steadied), np.eye(3)
        if self._positions:
            carry = self._steadied @ self._positions[-1] @ np.linalg.inv(position) @ back
        self._positions.append(position)
        self._steadied = steadied
        if mean is None:
            return carry, dewarped @ back, None
        largest = self._params.largest or largest_displacement(frame.size, 1.0)
        return carry, dewarped @ back, Around(mean, back, largest, frame.turbulence)

    def _remembered_width(self, memory: Memory) -> float:
        """Width to remove from what is remembered, which gradually becomes the one that its own image needs."""
        if self._said is not None and self._found is None and memory.frames >= _REMEMBERED:
            count = float(memory.held.mean())
            # An image that does not determine its width says nothing against the one that was found before.
            self._found = max(find_blur_of_image(memory.image, self._said, count, self._runtime)[0], self._first)
        if self._found is not None:
            self._width += (self._found - self._width) / _GRADUALLY
        return self._width


def _checked(estimate: Memory, frame: DewarpedFrame, steadied: Matrix) -> Memory:
    """Estimate with as much of the frame as it was as the check asks for."""
    seen, shape = frame.seen, frame.moving.shape
    mean = follow(
        frame.mean, camera_flow(motion(np.asarray(np.linalg.inv(steadied), np.float64)), shape, frame.mean.shape), shape
    )
    share = share_of_estimate(luminance(reduced(estimate.image)), seen.grey, mean, frame.noise / pixel_of(shape))
    share = enlarged(share, shape)
    image = seen.image + for_channels(share, seen.image) * (estimate.image - seen.image)
    held = 1 + share * (estimate.held - 1)
    return replace(estimate, image=image, held=held, replaced=max(estimate.replaced, float(1 - share.mean())))


def _placed(image: FloatArray, moving: NDArray[np.bool_], offset: Matrix) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Dewarped frame and what moves, where the camera is wanted."""
    if np.allclose(offset, np.eye(3)):
        return image, moving
    flow = camera_flow(motion(offset), moving.shape)
    return warp(image, flow), sample_linear((moving.astype(np.float32),), flow) > 0.5


def _sharpened(
    frame: DewarpedFrame, estimate: tuple[Memory, NDArray[np.bool_], float, Title | None], sigma: float, exponent: float
) -> SteadyFrame:
    memory, moving, width, title = estimate
    noise = frame.noise * frame.share
    remembered = noise / float(np.sqrt(memory.held.mean()))
    width = round(width, 2)
    # What is remembered tells the blur where few frames did not; a blank frame shows none.
    sigma = 0.0 if frame.seen.blank else sigma or width
    sharp = deblur(memory.image, (sigma, width), exponent, (noise, remembered), memory.held)
    image = relit(sharp, frame.light)
    if title is not None:
        image = replace(title, frame=frame.seen.image).put_back(image)
    return SteadyFrame(
        number=frame.number,
        image=image,
        moving=moving,
        displacement=frame.displacement,
        sigma=sigma,
        starts_scene=frame.starts_scene,
        replaced=memory.replaced,
    )

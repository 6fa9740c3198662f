"""Windows of a stream of frames: each frame with its neighbours in the same scene, as soon as they are there.

Memory is bounded by the frames of two windows and the flows between them, however long the stream is.  A frame that is
unlike the one before, as thumbnails show it (:mod:`turbrestore.footage.checks.scene_cuts`), starts a new scene; a
window holds frames of one scene only.  Frames that show nothing in between, as a flash or a dropout, are blank: they
end no scene and have no neighbours.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import FloatArray, check_stream, check_unit_image, luminance
from ..core.errors import DataError
from ..footage.checks.content import BLANK_CONTRAST, LEAST_CONTRAST
from ..footage.checks.scene_cuts import ALIKE, similarity_at, thumbnail
from ..registration.camera.global_shift import ShiftReference, prepare_shift_reference
from ..registration.flow import MIN_SIDE, FlowParams, normalise_to_8_bits
from ..registration.flow_methods.opencv_flow import GreyImage
from ..runtime.image_stacks import spline_planes
from .camera_path.camera import Matrix
from .grid import pixel_of, reduced

# Flows (h, w, 2) from a frame to its neighbours, and their affine parts (2, 3), by their distance in frames.
MeasuredFlows = tuple[dict[int, FloatArray], dict[int, Matrix]]

# Side of the squares in which light is compared, pixels; range of intensities compared, and fewest squares; chosen.
_SQUARE, _EXPOSED, _FEWEST = 8, (0.02, 0.95), 16
# A gain that is as many times the scatter of the squares counts half: half or twice as much fails in test_light.py.
_SCATTER = 2.0
# Smallest and largest logarithm of a gain, chosen: half a per cent and a factor of two.  How often the intensity is
# squared for the power by which it fades towards white, chosen: NumPy's power takes four times as long.
_LEAST_LIGHT, _MOST_LIGHT, _WHITE_SQUARED = 0.005, 0.7, 3
# Standard deviation of the shading that is taken off thumbnails, pixels of the thumbnail, chosen.
_SHADING = 5.0


@dataclass(frozen=True, eq=False)
class WindowFrame:
    """A frame of a stream."""

    image: FloatArray  # (H, W) or (H, W, 3)
    planes: FloatArray  # (C, H + 3, W + 3): splines through its channels, which are sampled for each of its neighbours
    grey: FloatArray  # (h, w): luminance on the grid of the image
    normalised: GreyImage  # (h, w): luminance of normalised local contrast, which flow is measured from
    coarse: FloatArray  # (h', w') or (h', w', 3): means of squares, which light is measured from
    scene: int  # number of the scene, from 0
    blank: bool  # whether it shows nothing of its scene
    shift_reference: ShiftReference  # what shifts of the whole image are measured against


class LaterFlows:
    """Flows from a frame to its later neighbours: whoever needs them first measures them.

    Reversed, they lead from those neighbours to the frame, whose windows other threads work on.
    """

    def __init__(self, frame: WindowFrame, neighbours: Mapping[int, WindowFrame]) -> None:
        self._lock = threading.Lock()
        self._of: tuple[WindowFrame, Mapping[int, WindowFrame]] | None = frame, neighbours
        self._found: MeasuredFlows = {}, {}

    def measured(self, measure: Callable[[WindowFrame, Mapping[int, WindowFrame]], MeasuredFlows]) -> MeasuredFlows:
        """Flows, and the motion of the camera, by the distance of the neighbours."""
        with self._lock:
            if self._of is not None:
                self._found, self._of = measure(*self._of), None
            return self._found


@dataclass(frozen=True, eq=False)
class Window:
    """A frame and its neighbours in the same scene."""

    number: int  # number of the frame in the stream, from 0
    frame: WindowFrame
    neighbours: Mapping[int, WindowFrame]  # by their distance in frames, negative before the frame
    starts_scene: bool  # whether the frame is the first of its scene
    later: LaterFlows
    earlier: Mapping[int, LaterFlows]  # of the neighbours before the frame


def iter_windows(
    frames: Iterable[ArrayLike], earlier: Sequence[int], later: Sequence[int] | None = None
) -> Iterator[Window]:
    """Yield the window of every frame, in order, once the last neighbour has been read.

    ``frames`` (H, W) or (H, W, 3) each; distances of the neighbours before a frame, and after it if they are others.
    """
    offsets = sorted([-distance for distance in earlier] + list(earlier if later is None else later), key=abs)
    before, after = -min(offsets), max(offsets)
    kept: deque[WindowFrame] = deque()
    flows: dict[int, LaterFlows] = {}
    # Number of the first frame that is kept, and of the next one whose window is due.
    first = due = 0
    for frame in _prepared(frames):
        kept.append(frame)
        if len(kept) + first > due + after:
            yield _window(kept, flows, first, due, offsets)
            due += 1
        if len(kept) > before + after:
            kept.popleft()
            flows.pop(first, None)
            first += 1
    for number in range(due, first + len(kept)):
        yield _window(kept, flows, first, number, offsets)


def iter_scenes(frames: Iterable[ArrayLike]) -> Iterator[tuple[FloatArray, int, bool]]:
    """Yield every frame (H, W) or (H, W, 3) with the number of its scene, from 0, and whether it is blank in it.

    No scene begins with a blank frame: black ones at the start are a scene of their own, and of a scene of little
    contrast the first frame counts as a blank one of the scene before.

    Raises DataError for a frame that differs from the first in size, is too small for flow, or is no image.
    """
    scene, usual, shape = 0, 0.0, None
    before = faint = np.zeros((1, 1), np.float32)
    for number, values in enumerate(check_stream(frames)):
        image = check_unit_image(values, f"frame {number}")
        shape = shape or image.shape
        if image.shape != shape:
            raise DataError(f"frame {number}: expected shape {shape} as the first frame, found {image.shape}")
        if min(shape[:2]) < MIN_SIDE:
            found = f"{shape[1]}×{shape[0]}"
            raise DataError(f"frames: expected at least {MIN_SIDE}×{MIN_SIDE} pixels for optical flow, found {found}")
        detail = thumbnail(image)
        detail = detail - cv2.GaussianBlur(detail, (0, 0), _SHADING)
        contrast = float(detail.std())
        if contrast <= LEAST_CONTRAST:
            contrast, detail = 0.0, np.zeros_like(detail)
        if usual and contrast <= BLANK_CONTRAST * usual:
            # Noise differs from frame to frame; what does not is a scene of little contrast.
            alike = np.any(detail) and np.any(faint) and similarity_at(detail, faint)[0] >= ALIKE
            faint = detail
            if not alike:
                yield image, scene, True
                continue
        cut = number > 0 and contrast > 0 and similarity_at(detail, before)[0] < ALIKE
        scene += cut
        # A scene that fades out keeps its contrast, so that noise does not become one.
        before, usual = detail, contrast if cut else max(usual, contrast)
        yield image, scene, False


def normalised_grey(grey: FloatArray, shape: tuple[int, ...]) -> GreyImage:
    """Normalise the local contrast of the luminance (h, w) of an image of this shape on its grid."""
    return normalise_to_8_bits(grey, FlowParams.contrast_window / pixel_of(shape), FlowParams.contrast_floor)


def coarse_image(image: FloatArray) -> FloatArray:
    """Means of the squares in which light is compared: they hardly notice turbulence.

    ``image`` (H, W) or (H, W, 3); returns (h', w') or (h', w', 3).
    """
    height, width = (max(length // _SQUARE, 1) for length in image.shape[:2])
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


def light_between(frame: FloatArray, other: FloatArray) -> FloatArray:
    """Logarithm of the gain that gives a coarse image the light of another, 0 where it is not worth the while.

    ``frame, other`` (h', w') or (h', w', 3); returns (1,) or (3,).
    """
    pair = np.stack([frame, other]).reshape(2, frame.shape[0] * frame.shape[1], -1)
    exposed = ((pair > _EXPOSED[0]) & (pair < _EXPOSED[1])).all(axis=(0, 2))
    if exposed.sum() < _FEWEST:
        return np.zeros(pair.shape[2], np.float32)
    ratios = np.log(pair[0, exposed] / pair[1, exposed])
    gains = np.median(ratios, axis=0)
    size, scatter = np.abs(gains).max(), np.median(np.abs(ratios - gains), axis=0).max()
    if size < _LEAST_LIGHT:
        return np.zeros(pair.shape[2], np.float32)
    # Content that has moved changes some squares up and others down; light changes all alike.
    gains /= 1 + (_SCATTER * scatter / size) ** 4
    return gains.clip(-_MOST_LIGHT, _MOST_LIGHT).astype(np.float32)


def relit(image: FloatArray, gain: FloatArray) -> FloatArray:
    """Multiply an image by a gain, of which its logarithm is given, and leave white as it is: it may be clipped.

    ``image`` (H, W) or (H, W, 3); ``gain`` (1,) or (3,).
    """
    if not np.any(gain):
        return image
    # Rows as they lie in memory: NumPy is slow along an axis of three.
    rows = image.reshape(len(image), -1)
    factor = np.broadcast_to(np.exp(gain), image.shape[1:]).ravel()
    scaled = np.clip(rows, 0, 1)
    for _ in range(_WHITE_SQUARED):
        scaled *= scaled
    scaled *= factor - 1
    scaled += 1
    np.divide(factor, scaled, out=scaled)
    scaled *= rows
    return scaled.reshape(image.shape)


def _window(
    kept: deque[WindowFrame], flows: dict[int, LaterFlows], first: int, number: int, offsets: Sequence[int]
) -> Window:
    """Window of a frame; the flows from it to later ones are added to those that are kept."""
    place = number - first
    frame = kept[place]
    there = {offset: kept[place + offset] for offset in offsets if 0 <= place + offset < len(kept)}
    neighbours = {
        offset: other
        for offset, other in there.items()
        if other.scene == frame.scene and not (frame.blank or other.blank)
    }
    flows[number] = LaterFlows(frame, {offset: other for offset, other in neighbours.items() if offset > 0})
    earlier = {offset: flows[number + offset] for offset in neighbours if offset < 0}
    starts_scene = number == 0 or kept[place - 1].scene != frame.scene
    return Window(number, frame, neighbours, starts_scene, flows[number], earlier)


def _prepared(frames: Iterable[ArrayLike]) -> Iterator[WindowFrame]:
    for image, scene, blank in iter_scenes(frames):
        grey = luminance(reduced(image))
        normalised = normalised_grey(grey, image.shape)
        shift_reference = prepare_shift_reference(image)
        coarse = coarse_image(image)
        yield WindowFrame(image, spline_planes(image), grey, normalised, coarse, scene, blank, shift_reference)

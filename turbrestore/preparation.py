"""Preparation of the frames: without bars, overlays and moving objects, under steady light, and stretched."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from .core.arrays import FloatArray
from .core.decision import Decision
from .core.remarks import Doubt
from .core.verdict import CheckKind
from .footage.background import find_moving_objects
from .footage.bars import find_bars
from .footage.checks.two_states import find_two_states
from .footage.correction import Correction, PutBack
from .footage.levels import Levels
from .footage.lighting.light import find_light
from .footage.lighting.range import find_range
from .footage.lighting.white_balance import find_white_balance
from .footage.overlays import find_overlay, read_static_mask
from .footage.sensor.pixel_pattern import find_pixel_pattern
from .footage.sensor.stripes import find_stripes
from .footage.survey import Survey, take_survey
from .io.source import FrameSource, Window
from .results import Restoration, at_levels_of_clip
from .runtime.steps import Progress
from .settings import RestoreParams

Find = Callable[[Survey], Correction | None]


@dataclass(frozen=True, eq=False)
class Prepared:
    """Frames as the stages take them, and what was changed."""

    source: FrameSource
    corrections: tuple[Correction, ...] = ()  # in the order in which they act
    # (H, W): pixels of the scene that no frame shows, because an overlay covers them or the file lacks them.
    hidden: NDArray[np.bool_] | None = None
    decisions: tuple[Decision, ...] = ()

    @property
    def levels(self) -> Levels:
        """From the levels of the clip to those of the stages."""
        return next((each.levels for each in self.corrections if each.levels is not None), Levels())

    @property
    def picture(self) -> Window:
        """Rows and columns between the bars."""
        return next((each.picture for each in self.corrections if each.picture is not None), np.s_[:, :])

    def stretched(self, params: RestoreParams) -> RestoreParams:
        """Bring the settings that are intensities to the levels of the stages."""
        given, square = params.filter, self.levels.gain**2
        noise = None if given.image_noise is None else given.image_noise * square
        return replace(params, filter=replace(given, image_noise=noise, image_drift=given.image_drift * square))

    def put_back(self, image: FloatArray) -> FloatArray:
        """Put what is no scene back into an image (H, W[, 3]) at the levels of the clip."""
        for put_back in self._to_put_back():
            image = put_back(image)
        return image

    def undo(self, restoration: Restoration) -> Restoration:
        """Bring a restoration back to the levels of the clip, and put what is no scene back."""
        objects_replaced = any(each.replaces_objects for each in self.corrections)
        restoration = replace(restoration, objects_replaced=objects_replaced)
        if self.levels.changed:
            restoration = _at_levels_of_clip(restoration, self.levels)
        for put_back in self._to_put_back():
            restoration = _put_back(restoration, put_back)
        return restoration

    def _to_put_back(self) -> Iterator[PutBack]:
        return (each.put_back for each in reversed(self.corrections) if each.put_back is not None)


def prepare(
    source: FrameSource, static_mask: str = "auto", scratch: Path | None = None, progress: Progress | None = None
) -> Prepared:
    """Prepare the frames of a clip, which are read once, and once more if there are moving objects."""
    finds, corrections = _detectors(static_mask, source), list[Correction]()
    survey = take_survey(source, scratch, progress)
    for find in finds:
        correction = find(survey)
        if correction is not None:
            survey = survey.corrected(correction)
            # The reduced frames are not needed any more.
            corrections.append(replace(correction, small=None))
    hidden = [each.hidden for each in corrections if each.hidden is not None]
    if source.unseen is not None:
        hidden.append(source.unseen[source.window])
    decisions = [
        Decision("input", "to be checked", found, CheckKind.INPUT)
        for found in source.warnings
        if isinstance(found, Doubt)
    ]
    for correction in corrections:
        decisions += correction.decisions
    nowhere = np.logical_or.reduce(hidden) if hidden else None
    return Prepared(survey.clip, tuple(corrections), nowhere, tuple(decisions))


def _detectors(static_mask: str, source: FrameSource) -> list[Find]:
    """List what is looked for, in this order."""
    mask = None if static_mask in ("auto", "off") else read_static_mask(static_mask, source)
    with_overlays = static_mask != "off"
    return [
        # Bars first: a dark field stop would be mistaken for bands of flicker.
        find_bars,
        # Stripes before overlays: a dead column is static and would be taken for an overlay.
        find_stripes,
        find_pixel_pattern,
        *([partial(find_overlay, mask=mask)] if with_overlays else ()),
        # Colours before light: a channel that changes by itself would be taken for a change of the light.
        find_white_balance,
        find_light,
        # What is left when the light has been evened out blinks by itself.
        find_two_states,
        # The range is that of the frames as they are registered; objects are told by their contrast in it.
        find_range,
        *([find_moving_objects] if with_overlays else ()),
    ]


def _at_levels_of_clip(restoration: Restoration, levels: Levels) -> Restoration:
    finer, uncertainty, noise = restoration.finer, restoration.uncertainty, restoration.noise
    return replace(
        restoration,
        image=np.clip(levels.original(restoration.image), 0, 1),
        mean=levels.original(restoration.mean),
        centroid=at_levels_of_clip(restoration.centroid, levels),
        filtered=at_levels_of_clip(restoration.filtered, levels),
        deconvolution=at_levels_of_clip(restoration.deconvolution, levels),
        blur=at_levels_of_clip(restoration.blur, levels),
        noise=None if noise is None else noise.scaled(1 / levels.gain**2),
        uncertainty=None if uncertainty is None else uncertainty / np.float32(levels.gain),
        finer=None if finer is None else np.clip(levels.original(finer), 0, 1),
    )


def _put_back(restoration: Restoration, put_back: PutBack) -> Restoration:
    """Put what is no scene back into the images of a restoration."""
    corner, finer, uncertainty = restoration.crop[:2], restoration.finer, restoration.uncertainty
    image = put_back(restoration.image, *corner)
    if finer is not None:
        size = finer.shape[1::-1]
        covered = cv2.resize((image != restoration.image).astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
        finer = np.where(covered > 0.5, cv2.resize(image, size, interpolation=cv2.INTER_LINEAR), finer)
    if uncertainty is not None:
        covered = np.atleast_3d(put_back(np.full_like(restoration.image, -1), *corner))[..., 0] >= 0
        # Pixels under it were never observed.
        uncertainty = np.where(covered, np.float32(np.inf), uncertainty)
    return replace(restoration, image=image, mean=put_back(restoration.mean), uncertainty=uncertainty, finer=finer)

"""Preparation of the frames: without bars, overlays and moving objects, under steady light, and stretched."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from .core.decision import Decision
from .core.remarks import Doubt
from .core.verdict import CheckKind
from .footage.background import without_moving_objects
from .footage.bars import Bars, without_bars
from .footage.checks.two_states import find_two_states
from .footage.levels import Levels, stretch_levels
from .footage.lighting.light import steady_light
from .footage.lighting.white_balance import steady_white_balance
from .footage.overlays import Title, read_static_mask, without_overlay
from .footage.pixel_pattern import without_pixel_pattern
from .footage.sensor_pattern import without_stripes
from .footage.survey import measure_moments, take_survey
from .io.source import FrameSource, Window
from .results import Restoration, at_levels_of_clip


@dataclass(frozen=True, eq=False)
class Prepared:
    """Frames as the stages take them, and what was changed."""

    source: FrameSource
    levels: Levels  # from the levels of the clip to those of the stages
    bars: Bars | None
    # (H, W): pixels of the scene that no frame shows, because an overlay covers them or the file lacks them.
    hidden: NDArray[np.bool_] | None
    title: Title | None  # overlay that is put back into results
    decisions: tuple[Decision, ...]
    objects_replaced: bool = False

    @property
    def picture(self) -> Window:
        """Rows and columns between the bars."""
        return np.s_[:, :] if self.bars is None else self.bars.picture


def prepare(source: FrameSource, static_mask: str = "auto", scratch: Path | None = None) -> Prepared:
    """Prepare the frames of a clip, which are read once, and once more if there are moving objects."""
    mask = None if static_mask in ("auto", "off") else read_static_mask(static_mask, source)
    survey = take_survey(source, scratch)
    # Bars first: a dark field stop would be mistaken for bands of flicker.
    survey, bars, bar_decisions = without_bars(survey)
    moments = measure_moments(survey)
    # Stripes before overlays: a dead column is static and would be taken for an overlay.
    survey, stripe_decisions = without_stripes(survey, moments)
    moments = measure_moments(survey) if stripe_decisions else moments
    survey, pattern_decisions = without_pixel_pattern(survey, moments)
    hidden, title, overlay_decisions = None, None, tuple[Decision, ...]()
    if static_mask != "off":
        survey, hidden, title, overlay_decisions = without_overlay(survey, mask, None if pattern_decisions else moments)
    if source.unseen is not None:
        unseen = source.unseen[source.window]
        hidden = unseen if hidden is None else hidden | unseen
    survey, colour_decisions = steady_white_balance(survey)
    survey, light_decisions = steady_light(survey)
    state_decisions = find_two_states(survey)
    survey, levels, range_decisions = stretch_levels(survey)
    clip, object_decisions = without_moving_objects(survey) if static_mask != "off" else (survey.clip, ())
    decisions = (
        *(
            Decision("input", "to be checked", found, CheckKind.INPUT)
            for found in source.warnings
            if isinstance(found, Doubt)
        ),
        *bar_decisions,
        *stripe_decisions,
        *pattern_decisions,
        *overlay_decisions,
        *colour_decisions,
        *light_decisions,
        *state_decisions,
        *range_decisions,
        *object_decisions,
    )
    return Prepared(clip, levels, bars, hidden, title, decisions, bool(object_decisions))


def undo_preparation(restoration: Restoration, prepared: Prepared) -> Restoration:
    """Bring a restoration of prepared frames back to the levels of the clip, and put title and bars back."""
    restoration = replace(restoration, objects_replaced=prepared.objects_replaced)
    if prepared.levels.changed:
        restoration = _at_levels_of_clip(restoration, prepared.levels)
    for part in (prepared.title, prepared.bars):
        restoration = restoration if part is None else _put_back(restoration, part)
    return restoration


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


def _put_back(restoration: Restoration, part: Bars | Title) -> Restoration:
    """Put what is no scene back into the images of a restoration."""
    corner, finer, uncertainty = restoration.crop[:2], restoration.finer, restoration.uncertainty
    image = part.put_back(restoration.image, *corner)
    if finer is not None:
        size = finer.shape[1::-1]
        covered = cv2.resize((image != restoration.image).astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
        finer = np.where(covered > 0.5, cv2.resize(image, size, interpolation=cv2.INTER_LINEAR), finer)
    if uncertainty is not None:
        covered = np.atleast_3d(part.put_back(np.full_like(restoration.image, -1), *corner))[..., 0] >= 0
        # Pixels under it were never observed.
        uncertainty = np.where(covered, np.float32(np.inf), uncertainty)
    return replace(restoration, image=image, mean=part.put_back(restoration.mean), uncertainty=uncertainty, finer=finer)

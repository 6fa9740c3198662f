"""Preparation of the frames: without bars, overlays and what passes, under steady light, in units of their range."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from .agreement.sensor_pattern import without_stripes
from .core.decision import Decision
from .footage.bars import Bars, without_bars
from .footage.levels import Levels, stretch_levels
from .footage.lighting.light import steady_light
from .footage.lighting.white_balance import steady_white_balance
from .footage.overlays import Title, read_static_mask, without_overlay
from .footage.passers import without_passers
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

    @property
    def picture(self) -> Window:
        """Rows and columns between the bars."""
        return np.s_[:, :] if self.bars is None else self.bars.picture


def prepare(source: FrameSource, static_mask: str = "auto", scratch: Path | None = None) -> Prepared:
    """Prepare the frames of a clip, which are read once, and once more where something passes through the scene."""
    mask = None if static_mask in ("auto", "off") else read_static_mask(static_mask, source)
    survey = take_survey(source, scratch)
    # Before the light, because a stop would be taken for bands of it.
    survey, bars, on_bars = without_bars(survey)
    moments = measure_moments(survey)
    # Before what stands is looked for, because a dead column stands.
    survey, on_stripes = without_stripes(survey, moments)
    hidden, title, on_overlay = None, None, tuple[Decision, ...]()
    if static_mask != "off":
        survey, hidden, title, on_overlay = without_overlay(survey, mask, None if on_stripes else moments)
    if source.unseen is not None:
        unseen = source.unseen[source.window]
        hidden = unseen if hidden is None else hidden | unseen
    survey, on_colours = steady_white_balance(survey)
    survey, on_light = steady_light(survey)
    survey, levels, on_range = stretch_levels(survey)
    clip, on_passers = without_passers(survey) if static_mask != "off" else (survey.clip, ())
    decisions = (*on_bars, *on_stripes, *on_overlay, *on_colours, *on_light, *on_range, *on_passers)
    return Prepared(clip, levels, bars, hidden, title, decisions)


def as_recorded(restoration: Restoration, prepared: Prepared) -> Restoration:
    """Bring a restoration of prepared frames back to the levels of the clip, and give it back what is no scene."""
    if prepared.levels.changed:
        restoration = _at_levels_of_clip(restoration, prepared.levels)
    for kept in (prepared.title, prepared.bars):
        restoration = restoration if kept is None else _put_back(restoration, kept)
    return restoration


def _at_levels_of_clip(restoration: Restoration, levels: Levels) -> Restoration:
    finer, uncertainty = restoration.finer, restoration.uncertainty
    return replace(
        restoration,
        image=np.clip(levels.original(restoration.image), 0, 1),
        mean=levels.original(restoration.mean),
        centroid=at_levels_of_clip(restoration.centroid, levels),
        filtered=at_levels_of_clip(restoration.filtered, levels),
        deconvolution=at_levels_of_clip(restoration.deconvolution, levels),
        blur=at_levels_of_clip(restoration.blur, levels),
        uncertainty=None if uncertainty is None else uncertainty / np.float32(levels.gain),
        finer=None if finer is None else np.clip(levels.original(finer), 0, 1),
    )


def _put_back(restoration: Restoration, kept: Bars | Title) -> Restoration:
    image, uncertainty = kept.put_back(restoration.image, *restoration.crop[:2]), restoration.uncertainty
    finer = restoration.finer
    if finer is not None:
        changed, usual = (image != restoration.image).astype(np.float32), image
        size = finer.shape[1::-1]
        hidden, usual = (cv2.resize(one, size, interpolation=cv2.INTER_LINEAR) for one in (changed, usual))
        finer = np.where(hidden > 0.5, usual, finer)
    if uncertainty is not None:
        # What lies under it was not seen.
        hidden = kept.put_back(np.full_like(restoration.image, -1), *restoration.crop[:2]) >= 0
        uncertainty = np.where(hidden if hidden.ndim == 2 else hidden[..., 0], np.float32(np.inf), uncertainty)
    return replace(restoration, image=image, mean=kept.put_back(restoration.mean), uncertainty=uncertainty, finer=finer)

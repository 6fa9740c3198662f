"""Preparation of the frames: without bars, overlays and what passes, under steady light, in units of their range."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .agreement.sensor_pattern import without_stripes
from .core.arrays import FloatArray
from .core.decision import Decision
from .footage.bars import Bars, without_bars
from .footage.levels import Levels, stretch_levels
from .footage.lighting.light import steady_light
from .footage.lighting.white_balance import steady_white_balance
from .footage.moments import measure_moments
from .footage.overlays import FEWEST, Title, read_static_mask, without_overlay
from .footage.passers import without_passers
from .io.source import FrameSource, Window
from .registration.centroid import Centroid
from .runtime.scratch import mean_of
from .seeing.strength import Seeing, measure_seeing
from .seeing.tilt_theory import Optics


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


def prepare(source: FrameSource, train: int, static_mask: str = "auto") -> Prepared:
    """Prepare the frames of a clip."""
    mask = None if static_mask in ("auto", "off") else read_static_mask(static_mask, source)
    # Before the light, because a stop would be taken for bands of it.
    source, bars, on_bars = without_bars(source)
    moments = measure_moments(source) if len(source) >= FEWEST else None
    # Before what stands is looked for, because a dead column stands.
    source, on_stripes = without_stripes(source, moments)
    source, hidden, title, on_overlay = (
        without_overlay(source, mask, None if on_stripes else moments)
        if static_mask != "off"
        else (source, None, None, ())
    )
    if source.unseen is not None:
        unseen = source.unseen[source.window]
        hidden = unseen if hidden is None else hidden | unseen
    source, on_colours = steady_white_balance(source)
    source, on_light = steady_light(source)
    source, levels, on_range = stretch_levels(source, train)
    source, on_passers = without_passers(source) if static_mask != "off" else (source, ())
    return Prepared(
        source,
        levels,
        bars,
        hidden,
        title,
        (*on_bars, *on_stripes, *on_overlay, *on_colours, *on_light, *on_range, *on_passers),
    )


def seeing_of_picture(
    prepared: Prepared, frames: FloatArray, centroid: Centroid, optics: Optics | None = None, threads: int = 0
) -> Seeing:
    """Measure the strength of the turbulence between the bars, since what fills them is not the scene.

    ``frames`` (T, H, W) or (T, H, W, 3).
    """
    rows, columns = prepared.picture
    seen, flows = frames[:, rows, columns], centroid.flows[:, rows, columns]
    return measure_seeing(seen, flows, centroid.image[rows, columns], mean_of(seen), optics, threads)

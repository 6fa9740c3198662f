"""The page of a steadied video: a player, plots of every frame, and how to repeat the run.

The player is one film of four panels (input, output, their difference, what moves), of which it shows two, split by a
divider; without scripts it shows all four.
"""

from __future__ import annotations

import base64
import os
import shlex
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import ROUNDING, FloatArray, luminance
from ..core.remarks import Doubt, counted
from ..core.verdict import CheckKind, Verdict
from ..display.curves import plot_over_frames
from ..io.output import atomic_write
from ..io.source import FrameSource
from ..metrics import sharpness
from ..runs.run_record import RunRecord
from ..steady.settings import SteadyParams
from ..steady.video import SteadyFrame
from ..wording import share_words, write_check
from .comparison import environment, film_comparison
from .facts import Fact, duration, settings
from .film import film_length, write_film
from .page import check_report, page_code
from .panels import Panel, make_panel

# Quality of the film as a rate factor of H.264, and its frames per second where those of the input are unknown; both
# chosen.
_RATE_FACTOR = 22
_USUAL_RATE = 25.0
# Share of the image from which it is worth saying that the long average drifted, chosen.
_ASTRAY = 0.02


@dataclass(eq=False)
class SteadyFigures:
    """What is known about the frames of a run, in order."""

    # Root mean square of the displacement that was removed, pixels.
    displacement: list[float] = field(default_factory=list)
    moving: list[float] = field(default_factory=list)  # share of the image that moves
    replaced: list[float] = field(default_factory=list)  # share of the image that is averaged less
    scenes: int = 0
    sigma: float = 0.0  # width of the blur that was removed, pixels
    seconds: float = 0.0  # time of the run
    remarks: tuple[str, ...] = ()  # on the input

    def note(self, frame: SteadyFrame) -> None:
        """Take note of the next frame."""
        self.scenes += frame.starts_scene
        self.sigma = frame.sigma
        self.displacement.append(frame.displacement)
        self.moving.append(float(frame.moving.mean()))
        self.replaced.append(frame.replaced)

    @property
    def verdict(self) -> Verdict:
        """What was gained, and what to look at."""
        removed = [f"{np.mean(self.displacement):.2f} pixels of motion"]
        if self.sigma > 0:
            removed.append(f"{self.sigma:.2f} pixels of blur")
        count, moves = counted(len(self.moving), "frame"), share_words(float(np.mean(self.moving)))
        gained = f"{count} with {' and '.join(removed)} removed; {moves} of the image moves"
        checks = [write_check(CheckKind.INPUT, remark) for remark in self.remarks if isinstance(remark, Doubt)]
        astray = float(np.mean(self.replaced))
        if astray >= _ASTRAY:
            checks.append(write_check(CheckKind.DRIFT, share_words(astray)))
        return Verdict(gained, tuple(checks))


def write_steady_report(
    path: str | os.PathLike[str],
    sources: tuple[FrameSource, FrameSource],
    masks: Iterable[NDArray[np.bool_]],
    figures: SteadyFigures,
    run: RunRecord,
    overwrite: bool = False,
) -> None:
    """Write a steadied video as one HTML file.

    Memory does not grow with the length of the video but by the film, see :func:`film_length`.
    ``masks`` (H, W) each.
    """
    check_report(path, overwrite=overwrite)
    sharp: list[float] = []
    change: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        path_of_film = Path(folder, "film.mp4")
        count = film_length(len(sources[0]), *sources[0].shape[1:3])
        pairs = _compared(sources, sharp, change)
        film = write_film(path_of_film, pairs, count, sources[0].fps or _USUAL_RATE, _RATE_FACTOR, masks)
        address = "data:video/mp4;base64," + base64.b64encode(path_of_film.read_bytes()).decode("ascii")
    page = environment().get_template("steadied.html").render(
        page_code(("palette.css", "compare.css", "style.css"), ("film.js", "compare.js"), media="data:"),
        run=run,
        comparison=film_comparison(film, address),
        shown=count,
        frames=len(sources[0]),
        scenes=figures.scenes,
        size=sources[0].shape[1:3],
        panels=_plots(figures, sharp, change),
        headline=_headline(figures, sharp, change),
        verdict=figures.verdict,
        settings=settings(run, asdict(SteadyParams())),
        command=shlex.join(run.command),
    )  # fmt: skip
    atomic_write(path, page.encode(errors="replace"), overwrite)


def _compared(
    sources: tuple[FrameSource, FrameSource], sharp: list[float], change: list[float]
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Pairs of input and output; notes how much sharper, and how much less restless, the output is."""
    before = None
    for pair in zip(*sources, strict=True):
        grey = [luminance(frame) for frame in pair]
        sharp.append(sharpness(grey[1], grey[0]) if np.ptp(grey[0]) > 0 else np.nan)
        steps = [0.0, 0.0] if before is None else [float(abs(a - b).mean()) for a, b in zip(grey, before, strict=True)]
        change.append(steps[1] / steps[0] if steps[0] > 0 else np.nan)
        before = grey
        yield pair


def _plots(figures: SteadyFigures, sharp: list[float], change: list[float]) -> list[Panel]:
    removed = {"Displacement, pixels": figures.displacement, "What moves, %": [100 * share for share in figures.moving]}
    caption = "Displacement that was removed, root mean square, and share of the image that moves."
    motion = make_panel(plot_over_frames(removed), "motion", "Displacement and moving share of every frame", caption)
    rows = {"Sharpness, input = 1": sharp, "Change since the frame before, input = 1": change}
    caption = (
        "The output should be sharper than the input. It changes less where the air has moved the scene, and more "
        "where something moves that is sharper now."
    )
    quality = make_panel(plot_over_frames(rows, 1.0), "quality", "Sharpness and change of every frame", caption)
    return [motion, quality]


def _headline(figures: SteadyFigures, sharp: list[float], change: list[float]) -> list[Fact]:
    facts = [
        Fact("Displacement", f"{np.mean(figures.displacement):.2f} px", "removed, on average"),
        Fact("Blur removed", f"{figures.sigma:.2f} px" if figures.sigma > 0 else "none", "standard deviation"),
        Fact("Moves", share_words(float(np.mean(figures.moving))), "of the image"),
    ]
    if np.isfinite(sharp).any():
        facts.append(Fact("Sharpness", f"×{np.nanmean(sharp):.2f}", "relative to the input"))
    if np.isfinite(change).any():
        facts.append(Fact("Change", f"×{np.nanmean(change):.2f}", "from frame to frame"))
    rate = len(sharp) / max(figures.seconds, ROUNDING)
    return [*facts, Fact("Time", duration(figures.seconds), f"{rate:.1f} frames a second")]

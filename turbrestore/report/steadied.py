"""The page of a steadied video: a player, plots of every frame, and how to repeat the run.

The player is one film of four panels (input, output, their difference, what moves), so that they cannot get out of
step, and the page needs no script.
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

from ..core.arrays import FloatArray, luminance
from ..display.plots import plot_over_frames
from ..display.preview import shrink
from ..io.encoding import Encoding, write_container
from ..io.output import atomic_write
from ..io.source import FrameSource
from ..metrics import sharpness
from ..runs.run_record import RunRecord
from ..steady.settings import SteadyParams
from .comparison import environment, text_file
from .facts import Fact, duration, settings
from .page import check_report, policy
from .vector import inline_svg

# Most frames of the film, longest side of a panel, pixels, and its rate factor: half a minute of 640×360 takes 5 MB.
_MOST_FRAMES, _LONGEST, _RATE_FACTOR = 750, 640, 24
_USUAL_RATE = 25.0
# The difference is shown so many times enlarged, around grey; what does not move is shown so bright.
_ENLARGED, _DIMMED = 2.0, 0.3


@dataclass(eq=False)
class SteadyFigures:
    """What is known about the frames of a run, in order.

    Attributes
    ----------
    displacement : list of float
        Root mean square of the displacement that was removed, pixels.
    moving : list of float
        Share of the image that moves.
    scenes : int
    sigma : float
        Width of the blur that was removed, pixels.
    seconds : float
        Time of the run.
    """

    displacement: list[float] = field(default_factory=list)
    moving: list[float] = field(default_factory=list)
    scenes: int = 0
    sigma: float = 0.0
    seconds: float = 0.0


def write_steady_report(
    path: str | os.PathLike[str],
    sources: tuple[FrameSource, FrameSource],
    masks: Iterable[NDArray[np.bool_]],
    figures: SteadyFigures,
    run: RunRecord,
    overwrite: bool = False,
) -> None:
    """Write a steadied video as one HTML file.

    Memory does not grow with the length of the video but by the film, of at most 750 frames.

    Parameters
    ----------
    path : path
        Ends in .html or .htm.
    sources : tuple of FrameSource
        Input and output, of as many frames of one size.
    masks : iterable of ndarray, bool, shape (H, W)
        Where something moves, for every frame.
    figures : SteadyFigures
    run : RunRecord
        Input, settings and versions, see :func:`turbrestore.runs.run_record.describe_run`.
    overwrite : bool
        Replace an existing file.

    Raises
    ------
    ConfigurationError
        The suffix is not .html or .htm, or a package is not installed.
    OutputError
        The file exists, or its folder does not.
    DataError
        A video cannot be read.
    StorageError
        Writing failed; nothing is left behind.
    """
    from markupsafe import Markup

    check_report(path, overwrite=overwrite)
    sharp: list[float] = []
    change: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        film = Path(folder, "film.mp4")
        panels = _panels(_compared(sources, sharp, change), masks)
        write_container(film, panels, sources[0].fps or _USUAL_RATE, encoding=Encoding("h264", _RATE_FACTOR))
        address = "data:video/mp4;base64," + base64.b64encode(film.read_bytes()).decode("ascii")
    style = "".join(map(text_file, ("palette.css", "style.css")))
    page = environment().get_template("steadied.html").render(
        run=run,
        policy=policy(style, media="data:"),
        style=Markup(style),
        film=address,
        shown=min(len(sources[0]), _MOST_FRAMES),
        frames=len(sources[0]),
        size=sources[0].shape[1:3],
        enlarged=f"{_ENLARGED:g}",
        plots=[(Markup(svg), caption) for svg, caption in _plots(figures, sharp, change)],
        headline=_headline(figures, sharp, change),
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


def _panels(pairs: Iterable[tuple[FloatArray, FloatArray]], masks: Iterable[NDArray[np.bool_]]) -> Iterator[FloatArray]:
    """Frames of the film: input and output above, difference and what moves below."""
    for number, (pair, mask) in enumerate(zip(pairs, masks, strict=True)):
        if number >= _MOST_FRAMES:
            continue
        seen, ours = (shrink(frame if frame.ndim == 3 else frame[..., None].repeat(3, -1), _LONGEST) for frame in pair)
        light = _DIMMED + (1 - _DIMMED) * shrink(mask.astype(np.float32), _LONGEST)[..., None]
        yield np.block([[[seen], [ours]], [[0.5 + _ENLARGED * (ours - seen)], [light * ours]]])


def _plots(figures: SteadyFigures, sharp: list[float], change: list[float]) -> Iterator[tuple[str, str]]:
    rows = {"Displacement, pixels": figures.displacement, "What moves, %": [100 * share for share in figures.moving]}
    caption = "Displacement that was removed, root mean square, and share of the image that moves."
    yield inline_svg(plot_over_frames(rows), "motion", "Displacement and moving share of every frame"), caption
    rows = {"Sharpness, input = 1": sharp, "Change since the frame before, input = 1": change}
    caption = "The output should be sharper than the input, and change less from frame to frame."
    yield inline_svg(plot_over_frames(rows, 1.0), "quality", "Sharpness and change of every frame"), caption


def _headline(figures: SteadyFigures, sharp: list[float], change: list[float]) -> list[Fact]:
    scenes = f"{figures.scenes} scenes" if figures.scenes > 1 else "one scene"
    facts = [
        Fact("Frames", str(len(sharp)), scenes),
        Fact("Displacement", f"{np.mean(figures.displacement):.2f} px", "removed, on average"),
        Fact("Blur removed", f"{figures.sigma:.2f} px" if figures.sigma > 0 else "none", "standard deviation"),
        Fact("Moves", f"{100 * np.mean(figures.moving):.0f} %", "of the image"),
    ]
    if np.isfinite(sharp).any():
        facts.append(Fact("Sharpness", f"×{np.nanmean(sharp):.2f}", "relative to the input"))
    if np.isfinite(change).any():
        facts.append(Fact("Change", f"×{np.nanmean(change):.2f}", "from frame to frame"))
    return [*facts, Fact("Time", duration(figures.seconds), f"{len(sharp) / max(figures.seconds, 1e-3):.1f} a second")]

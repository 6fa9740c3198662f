"""What this project would have reached on a clip if it had removed the best blur: takes a lead of others apart."""

from __future__ import annotations

from collections.abc import Iterable

from ablation import best_sigma, stages
from clips import Clip
from peer_tables import BEST, EXPONENT, LEADS, READ, SAME, TURBRESTORE, WIDTH, Figures, Results, leaders
from words import share_read

from turbrestore.blur.psf import GAUSSIAN
from turbrestore.core.arrays import FloatArray
from turbrestore.deconvolution.deconvolve import DeconvolutionParams, deconvolve
from turbrestore.metrics import compare
from turbrestore.pipeline import restore


def add_best(results: Results, clips: dict[str, Clip]) -> None:
    """Add to the figures of this project what the best width gives, on the clips on which another method is ahead."""
    found = results.get(TURBRESTORE, {})
    for name in found:
        lost = {figure: max(ahead.values()) for figure in LEADS if (ahead := leaders(results, name, figure))}
        if lost:
            found[name] |= at_best_blur(clips[name], lost)


def at_best_blur(clip: Clip, lost: dict[str, float]) -> Figures:
    """Width and exponent that are removed, and for each figure those that are best, and the figure with them.

    ``lost`` has the figures of the leading methods.  A Gaussian is tried where no width of the present shape is enough.
    """
    restoration = restore(clip.frames)
    if restoration.deconvolution is None or restoration.posterior is None:
        return {}
    filtered, removed, exponent = stages(restoration)
    found: Figures = {WIDTH: removed, EXPONENT: exponent}
    for figure, wanted in lost.items():
        trials = _trials(filtered, restoration.centroid.image, clip, figure, removed, (exponent, GAUSSIAN), wanted)
        best, width, shape = max(trials)
        found |= {figure + BEST: round(best, 4), figure + WIDTH: width, figure + EXPONENT: shape}
    return found


def _trials(
    filtered: FloatArray,
    guide: FloatArray,
    clip: Clip,
    figure: str,
    start: float,
    exponents: Iterable[float],
    wanted: float,
) -> list[tuple[float, float, float]]:
    """Figure, width and exponent of the best widths of each shape, until the wanted figure is reached."""
    trials: list[tuple[float, float, float]] = []
    for exponent in exponents:
        params = DeconvolutionParams(exponent=exponent)
        width, best = best_sigma(
            lambda sigma, params=params: _score(deconvolve(filtered, sigma, params, guide=guide).image, clip, figure),
            start,
        )
        trials.append((best, width, exponent))
        if best >= wanted - LEADS[figure]:
            break
    return trials


def _score(image: FloatArray, clip: Clip, figure: str) -> float:
    reader = next((name for name, read in READ.items() if figure == f"{read}{SAME}"), None)
    if reader:
        return share_read(image, clip.words, reader)
    assert clip.truth is not None
    return compare(image, clip.truth).psnr

"""What this project would have reached on a clip with another blur or another λ: takes a lead of others apart."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping

import numpy as np
from ablation import SIGMAS, stages
from clips import Clip
from methods.deblurring import deblurred, known, levels_of
from peer_tables import LEADS, TURBRESTORE, Results, Trial, Trials, leaders, reader_of
from words import share_read

from turbrestore.blur.psf import GAUSSIAN
from turbrestore.core.arrays import FloatArray
from turbrestore.core.errors import TurbrestoreError
from turbrestore.deconvolution.deconvolve import DeconvolutionParams
from turbrestore.deconvolution.problem import largest_width
from turbrestore.metrics import compare
from turbrestore.pipeline import Restoration, restore

# Widths are tried as multiples of the one that is removed; these, pixels, where none is removed.
MULTIPLES, SMALL = np.geomspace(0.5, 2, 9), SIGMAS[1:9]
# λ is multiplied by these.
FACTORS = (0.5, 2.0)


def try_others(results: Results, clips: Mapping[str, Clip]) -> Trials:
    """Find what other settings give where another method is ahead."""
    found: Trials = {}
    for name in results.get(TURBRESTORE, {}):
        lost = {figure: max(ahead.values()) for figure in LEADS if (ahead := leaders(results, name, figure))}
        if not lost:
            continue
        try:
            restoration = restore(clips[name].frames)
            for figure, wanted in lost.items():
                if trials := tried(restoration, clips[name], figure, wanted):
                    found[name, figure] = trials
        except TurbrestoreError as error:
            print(f"{name} is not taken apart: {error}", file=sys.stderr)
    return found


def tried(restoration: Restoration, clip: Clip, figure: str, wanted: float) -> list[Trial]:
    """Figures with other widths, and where those are not enough, with a Gaussian and with another λ.

    Nothing where no blur was looked for.  The first trial is what was removed, as all of them at the levels of the
    restoration, but without what follows the deconvolution: detail that the halves of the clip do not share.
    """
    if restoration.deconvolution is None or restoration.posterior is None or restoration.filtered is None:
        return []
    filtered, removed, exponent = stages(restoration)
    levels, told = levels_of(clip.frames), known(restoration)
    usual: dict[tuple[float, float], float] = {}
    widths = _widths(removed, largest_width(filtered.shape))

    def attempt(width: float, shape: float, factor: float = 1.0) -> Trial:
        fidelity = None if factor == 1 else factor * usual[width, shape]
        params = DeconvolutionParams(sigma=width, exponent=shape, fidelity=fidelity)
        found = deblurred(filtered, levels, params, *told)
        usual.setdefault((width, shape), found.fidelity)
        return Trial(_score(found.image, clip, figure), width, shape, factor)

    def rounds() -> Iterator[list[Trial]]:
        yield [attempt(removed, exponent), *(attempt(width, exponent) for width in widths)]
        if figure.startswith("psnr"):
            yield [attempt(width, GAUSSIAN) for width in widths if width]
        best = max(trials, key=lambda trial: trial.figure)
        yield [attempt(best.width, best.exponent, factor) for factor in FACTORS if best.width]

    trials: list[Trial] = []
    for some in rounds():
        trials += some
        if max(trial.figure for trial in trials) >= wanted - LEADS[figure]:
            break
    return trials


def _widths(removed: float, largest: float) -> list[float]:
    near = removed * MULTIPLES if removed else SMALL
    return [0.0, *(float(width) for width in near if width <= largest and width != removed)]


def _score(image: FloatArray, clip: Clip, figure: str) -> float:
    reader = reader_of(figure)
    if reader:
        return share_read(image, clip.words, reader)
    assert clip.truth is not None
    return compare(image, clip.truth).psnr

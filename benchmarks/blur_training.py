"""Training of the estimator of the blur on simulated clips.

``python benchmarks/blur_training.py make FOLDER FIRST LAST`` restores the clips of the seeds FIRST to LAST − 1
(:mod:`blur_simulators`) up to the point where their blur is looked for, and keeps for each what the estimator then
knows, the true transfer function, and the error of the image behind every blur that might be removed.  Clips that are
there are kept, so it goes on where it stopped.  With ``--images DIR`` the scenes are parts of the images below a
folder, such as what ``dpkg-deb -x`` unpacks of the Debian packages supertuxkart-data, plasma-workspace-wallpapers,
gnome-backgrounds and mate-backgrounds.

``python benchmarks/blur_training.py keep FOLDER`` stores the features and gains of these clips in
``blur_training.npz``, with which ``train`` needs no clips.  After a change to anything that comes before the networks,
all clips have to be made again.

``python benchmarks/blur_training.py train [--write benchmarks/results/blur_training.md]
[--weights turbrestore/blur/learnt_blur.npz]`` judges networks that were trained without the simulator, or without the
fifth of the clips, on which they are judged; the fifths are drawn by clip, so that parts of one photograph may be on
both sides.  With ``--weights`` it also trains the networks of :mod:`turbrestore.blur.learnt` on all clips.
"""

from __future__ import annotations

import argparse
import dataclasses
import pickle
import sys
import time
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
import torch
from blur_calibration import CORE, registered
from blur_scenes import read_images
from blur_simulators import CHAMBER, GIVEN, SHARES, SimulatedClip, simulate
from numpy.typing import NDArray
from provenance import origin, publish

from turbrestore import DeconvolutionParams, TurbrestoreError, pipeline
from turbrestore.blur import posterior
from turbrestore.blur.learnt import FACTORS, FARTHEST, LOG_SPREADS, blur_features, learnt_blur
from turbrestore.blur.psf import GAUSSIAN, radial_otf
from turbrestore.blur.witnesses.spectral_variation import RINGS, SIDE
from turbrestore.blur.witnesses.two_tones import TwoTones, two_tones
from turbrestore.core.arrays import FloatArray
from turbrestore.core.noise_spectrum import NoiseSpectrum
from turbrestore.deconvolution.deconvolve import deconvolve
from turbrestore.deconvolution.problem import largest_width
from turbrestore.runtime.runtime import Runtime

KEPT = Path(__file__).resolve().with_suffix(".npz")
# Mean squared error that is invisible; gains, dB, below which all losses count alike in the table, and in training,
# where the best widths are to be told apart and not the worst; unit of the networks, dB.
INVISIBLE, WORST, HARMFUL, UNIT = 10**-3.8, -8.0, -4.0, 3.0
# Widths that are removed, pixels.
WIDTHS = np.array([0, 0.35, 0.5, 0.7, 0.95, 1.25, 1.65, 2.2, 2.9, 3.9, 5.4, 7.5, 10.0])
# Iterations that tell which blur is best; and a loss after which wider blurs are not tried, as a ratio of errors.
ITERATIONS, HOPELESS = 8, 4.0
# Standard deviation of the transition around a title, pixels.
FADED = 5.0
# A blur that is wider than the widest by this factor is taken for hopeless.
BEYOND = 1.5
# Places of the quantiles of the posterior and of its exponent among the features.
POSTERIOR, SHAPE = slice(9, 12), 13
# Networks, their inner width, epochs, size of a batch, rate, decay of the weights, and share of units that are dropped.
NETWORKS, INNER, EPOCHS, BATCH, RATE, DECAY, DROPPED = 10, 48, 14, 128, 3e-3, 0.3, 0.3
# Copies of a clip relative to other widths; deviation of the logarithm of these about the right one and the usual one.
COPIES, NEARBY, FAR = 9, 0.3, 0.5

# Quantiles of the width (3,), and the width that is removed, pixels.
Chosen = tuple[np.ndarray, float]


class _ReachedError(Exception):
    """Ends a restoration where the blur has been found."""


def main() -> int:
    """Make or keep clips, or train and judge networks."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    kinds = parser.add_subparsers(dest="what", required=True)
    make, keep, train = (kinds.add_parser(name) for name in ("make", "keep", "train"))
    for kind in (make, keep):
        kind.add_argument("folder", type=Path)
    make.add_argument("first", type=int)
    make.add_argument("last", type=int)
    make.add_argument("--simulator", choices=[*SHARES, CHAMBER])
    make.add_argument("--images", type=Path)
    train.add_argument("--write", type=Path)
    train.add_argument("--weights", type=Path)
    given = parser.parse_args()
    if given.what == "make":
        given.folder.mkdir(exist_ok=True)
        if given.images is not None and given.simulator == CHAMBER:
            parser.error(f"--simulator {CHAMBER} draws its own scenes: leave out --images")
        images = None if given.images is None else read_images(given.images)
        if images is not None and not images:
            parser.error(f"--images: expected images below a folder, found none below {given.images}")
        make_clips(given.folder, given.first, given.last, given.simulator, images)
        return 0
    if given.what == "keep":
        if not any(given.folder.glob("*.pkl")):
            parser.error(f"expected clips in {given.folder}, found none: `make` makes them")
        keep_clips(given.folder, KEPT)
        return 0
    if given.weights is not None and (given.weights.suffix != ".npz" or not given.weights.parent.is_dir()):
        parser.error(f"--weights: expected a .npz file in a folder that exists, found {given.weights}")
    clips = kept_clips(KEPT)
    table = table_of(clips)
    publish(table, given.write)
    if given.weights is not None:
        every = train_networks(clips, np.ones(len(clips.names), bool))
        scores = next(line for line in table.splitlines() if line.startswith("| a fifth |"))
        about = f"{origin()} python benchmarks/blur_training.py train, {len(clips.names)} clips; {scores}"
        _save(given.weights, about, every)
    return 0


def make_clips(
    folder: Path, first: int, last: int, simulator: str | None, images: list[NDArray[np.uint8]] | None
) -> None:
    """Simulate clips, and keep what is known of each in a file of the folder."""
    for seed in range(first, last):
        path = folder / f"{'' if images is None else GIVEN + '_'}{simulator or 'any'}_{seed}.pkl"
        if not path.exists():
            begun = time.perf_counter()
            clip = simulate(seed, simulator, images)
            found = known_of(clip)
            partial = path.with_suffix(".part")
            partial.write_bytes(pickle.dumps({"seed": seed, "simulator": clip.simulator, "scene": clip.scene, **found}))
            partial.replace(path)
            seconds = time.perf_counter() - begun
            print(seed, clip.simulator, clip.scene, clip.frames.shape, f"{seconds:.1f} s", flush=True)


def known_of(clip: SimulatedClip) -> dict[str, object]:
    """Restore a clip up to its blur: what is known there, the transfer function, and errors behind every blur."""
    known: dict[str, object] = {}

    def spy_levels(*given: object) -> object:
        prepared = prepare(*given)
        known["levels"] = prepared.levels
        return prepared

    def spy_features(*given: object) -> object:
        known["read"] = given
        raise _ReachedError

    prepare = pipeline.prepare
    try:
        with patch.object(pipeline, "prepare", spy_levels), patch.object(posterior, "blur_features", spy_features):
            pipeline.restore(clip.frames, runtime=Runtime(threads=1))
    except _ReachedError:
        pass
    except TurbrestoreError as error:
        return {"refused": str(error)}
    if "read" not in known:
        return {"refused": "no blur is looked for"}
    image, noise = known["read"][0], known["read"][5]
    if image.shape != clip.truth.shape:
        return {"refused": "its dark border is cut off"}
    truth = registered(known["levels"].stretched(clip.truth), image)
    width, exponent = fitted_blur(*(without_title(one, clip.hidden) for one in (image, truth)))
    seen, usual = ~clip.hidden[CORE], blur_features(*known["read"])[SHAPE]
    errors = errors_of(image, truth, noise, seen, WIDTHS, usual)
    right = errors_of(image, truth, noise, seen, np.array([0.0, width]), min(exponent, GAUSSIAN))[1]
    return {"read": known["read"], "width": width, "errors": errors, "right": right}


def without_title(image: FloatArray, hidden: np.ndarray) -> FloatArray:
    """Fade an image (H, W) to its mean where a title hides it."""
    share = cv2.GaussianBlur(np.float32(hidden), (0, 0), FADED)
    return image + share * (image[~hidden].mean() - image)


def errors_of(
    image: FloatArray, truth: FloatArray, noise: NoiseSpectrum, seen: np.ndarray, widths: np.ndarray, exponent: float
) -> FloatArray:
    """Mean squared errors (n,) of the image without blurs of some widths, from none on; NaN where hopeless.

    Pixels of the core that are not ``seen`` do not count: a title is sharp, so that it rings whatever is removed.
    """
    errors = np.full(len(widths), np.nan)
    params = DeconvolutionParams(exponent=exponent, iterations=ITERATIONS)
    for place, width in enumerate(widths):
        if width > largest_width(image.shape):
            break
        result = deconvolve(image, width, params, runtime=Runtime(threads=1), noise=noise).image
        errors[place] = np.mean(np.square(np.clip(result[CORE], 0, 1) - truth[CORE])[seen])
        if errors[place] > max(HOPELESS * np.nanmin(errors), INVISIBLE):
            break
    return errors


def fitted_blur(image: FloatArray, truth: FloatArray) -> tuple[float, float]:
    """Width and exponent of the transfer function from the truth to an image, by least squares."""
    profile = np.hanning(SIDE + 2)[1:-1]
    nu = np.fft.fftfreq(SIDE)
    ring = np.rint(np.hypot(nu[:, None], nu) * SIDE).astype(int).ravel()
    crossed = power = np.zeros(len(RINGS))
    for top in range(12, image.shape[0] - SIDE - 11, SIDE // 4):
        for left in range(12, image.shape[1] - SIDE - 11, SIDE // 4):
            parts = [one[top : top + SIDE, left : left + SIDE] for one in (image, truth)]
            a, b = (np.fft.fft2((part - part.mean()) * np.outer(profile, profile)) for part in parts)
            crossed = crossed + np.bincount(ring, (a * b.conj()).real.ravel())[: len(RINGS)]
            power = power + np.bincount(ring, np.square(np.abs(b)).ravel())[: len(RINGS)]
    best, found = np.inf, (0.0, 2.0)
    for exponent in (1.0, 1.15, 1.3, 1.45, 1.6, 1.8, 2.0, 2.3):
        for width in np.geomspace(0.15, 14, 120):
            otf = radial_otf(RINGS, width, exponent)
            # Registration leaves a gain of a few per cent open.
            gain = np.clip((crossed * otf)[1:].sum() / (power * otf * otf)[1:].sum(), 0.93, 1.07)
            misfit = (np.square(crossed - gain * otf * power) / np.maximum(power, 1e-12))[1:].sum()
            if misfit < best:
                best, found = misfit, (float(width), exponent)
    return found


@dataclass(frozen=True, eq=False)
class TrainingClips:
    """What networks are trained on and judged by."""

    names: np.ndarray  # of files (n,)
    simulators: np.ndarray  # (n,)
    features: np.ndarray  # (n, f)
    alone: np.ndarray  # widths by the image alone (n,), pixels; 0 where it finds no blur
    width: np.ndarray  # true widths (n,), pixels
    gains: np.ndarray  # by WIDTHS (n, w), decibels
    right: np.ndarray  # gains by the true blur (n,), decibels
    two_tones: np.ndarray  # fields of TwoTones (n, 3), whether or not there are two tones; NaN where nothing is told

    @property
    def posterior(self) -> np.ndarray:
        """Quantiles of the posterior (n, 3), pixels."""
        return np.exp(self.features[:, POSTERIOR])

    @property
    def tones(self) -> list[TwoTones | None]:
        """What the two tones of each clip tell."""
        return [None if np.isnan(row).any() else TwoTones(*row.tolist()) for row in self.two_tones]


def keep_clips(folder: Path, path: Path) -> None:
    """Add the clips of a folder to those that are kept in a file, in place of namesakes.

    A clip that was refused, because nothing looks for its blur, is not kept.
    """
    read = {one.stem: _row_of(one.stem, pickle.loads(one.read_bytes())) for one in sorted(folder.glob("*.pkl"))}
    fields = [field.name for field in dataclasses.fields(TrainingClips)]
    rows: dict[str, dict[str, Any] | None] = {}
    if path.exists():
        before = kept_clips(path)
        rows = {name: {field: getattr(before, field)[at] for field in fields} for at, name in enumerate(before.names)}
    kept = [row for _, row in sorted((rows | read).items()) if row is not None]
    _save(path, f"{origin()} python benchmarks/blur_training.py keep", _columns(kept, fields))


def _columns(rows: list[dict[str, Any]], fields: list[str]) -> dict[str, np.ndarray]:
    return {field: np.array([row[field] for row in rows]) for field in fields}


def _save(path: Path, about: str, columns: dict[str, np.ndarray]) -> None:
    """Save arrays in half precision, and what they are."""
    # That rounds features by less than 1 % of their scale; training adds noise of 5 %.
    half = {name: each.astype(np.float16) if each.dtype.kind == "f" else each for name, each in columns.items()}
    partial = path.with_suffix(".part.npz")
    np.savez_compressed(partial, about=about, **half)
    partial.replace(path)


def kept_clips(path: Path) -> TrainingClips:
    """Read the clips that are kept in a file."""
    with np.load(path, allow_pickle=False) as held:
        values = {name: held[name] for name in held.files if name != "about"}
    return TrainingClips(
        **{name: each.astype(float) if each.dtype.kind == "f" else each for name, each in values.items()}
    )


def _row_of(name: str, clip: dict[str, Any]) -> dict[str, Any] | None:
    """Fields of TrainingClips for a clip; None if it was refused."""
    if "errors" not in clip:
        return None
    visible = -10 * np.log10(np.array([*clip["errors"], clip["right"]]) + INVISIBLE)
    gains = np.maximum(np.nan_to_num(visible - visible[0], nan=WORST), WORST)
    read, estimate = clip["read"], clip["read"][4].estimate
    tones = two_tones(read[0], read[-2], read[-1][1])
    return {
        "names": name,
        "simulators": clip["simulator"],
        "features": blur_features(*read),
        "alone": estimate.sigma * estimate.blurred,
        "width": max(clip["width"], WIDTHS[1]),
        "gains": gains[:-1],
        "right": gains[-1],
        "two_tones": np.full(len(TwoTones._fields), np.nan) if tones is None else np.array(tones),
    }


def train_networks(clips: TrainingClips, chosen: np.ndarray) -> dict[str, np.ndarray]:
    """Train networks on some clips, and return their weights and the scale of the features."""
    features, usual = clips.features[chosen], clips.posterior[chosen, 1]
    low, middle, high = np.nanquantile(features, (0.02, 0.5, 0.98), axis=0)
    scale = np.maximum((high - low) / 4, 1e-3)
    standard = np.clip(np.nan_to_num((features - middle) / scale), -FARTHEST, FARTHEST)
    # The posterior may be wrong by a factor.  So that the networks learn gains at every width, and not only where it is
    # right, each clip is shown relative to other widths as well; how much wider these are is one more input, which is 0
    # when the networks are used.
    rng, x, y = np.random.default_rng(0), [], []
    right = np.log(clips.width[chosen] / usual)
    for copy in range(COPIES):
        wider = rng.standard_normal(len(usual)) * (NEARBY if copy % 2 else FAR) + (right if copy % 2 else 0)
        wider *= copy > 0
        grid = [
            np.maximum(_gains_at(gains, width * FACTORS), HARMFUL)
            for gains, width in zip(clips.gains[chosen], usual * np.exp(wider), strict=True)
        ]
        x.append(np.column_stack([standard, np.clip(wider / FAR, -FARTHEST, FARTHEST)]))
        y.append(np.column_stack([right - wider, np.array(grid) / UNIT]))
    inputs, targets = (torch.tensor(np.concatenate(part), dtype=torch.float32) for part in (x, y))
    layers: dict[str, list[np.ndarray]] = {f"{kind}{layer}": [] for layer in (1, 2, 3) for kind in "wb"}
    for member in range(NETWORKS):
        network = _train_one(inputs, targets, member)
        for layer, place in ((1, 0), (2, 3), (3, 6)):
            layers[f"w{layer}"].append(network[place].weight.detach().numpy())
            layers[f"b{layer}"].append(network[place].bias.detach().numpy())
    weights = {"middle": middle, "scale": scale, **{name: np.array(values) for name, values in layers.items()}}
    weights["w1"] = weights["w1"][..., :-1]
    for name in ("w3", "b3"):
        weights[name][:, 2:] *= UNIT
    return weights


def _train_one(x: torch.Tensor, y: torch.Tensor, seed: int) -> torch.nn.Sequential:
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    sizes, inner = (x.shape[1], INNER, INNER), []
    for before, after in pairwise(sizes):
        inner += [torch.nn.Linear(before, after), torch.nn.SiLU(), torch.nn.Dropout(DROPPED)]
    network = torch.nn.Sequential(*inner, torch.nn.Linear(INNER, y.shape[1] + 1))
    optimiser = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=DECAY)
    steps = EPOCHS * -(-len(x) // BATCH)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=steps)
    for _ in range(EPOCHS):
        for batch in torch.randperm(len(x)).split(BATCH):
            out = network(x[batch] + 0.05 * torch.randn_like(x[batch]))
            width, gains = y[batch, 0], y[batch, 1:]
            log = out[:, 1].clamp(*LOG_SPREADS)
            likelihood = (0.5 * torch.square((width - out[:, 0]) / log.exp()) + log).mean()
            loss = torch.square(out[:, 2:] - gains).mean() + 0.1 * likelihood
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
    return network.eval()


def table_of(clips: TrainingClips) -> str:
    """Judge networks on each simulator that they were not trained on, and on a fifth of all clips."""
    lines = [
        "# Blur that is learnt",
        "",
        "Made by `python benchmarks/blur_training.py train --write benchmarks/results/blur_training.md`.",
        "",
        "Error of ln width where the blur exceeds .6 px, and share of true widths within the 68 % interval; gain in",
        "visible error (MSE plus that of 38 dB), dB, by the best width, by the true blur, and what is removed;",
        "clips that are worse than the filtered image by more than .2 dB.",
        "",
        "| left out | clips | error: bias, median, nine of ten | within | best | true | removed | worse |",
        "|---|---|---|---|---|---|---|---|",
    ]
    rng = np.random.default_rng(0)
    folds = rng.integers(0, 5, len(clips.simulators))
    found = dict[int, Chosen]()
    for name in sorted(set(clips.simulators)):
        held = clips.simulators == name
        weights = train_networks(clips, ~held)
        found |= _found(clips, held, weights)
        lines.append(_row(name, clips, held, found))
    every = np.ones(len(folds), bool)
    lines.append(_row("each", clips, every, found))
    found = {}
    for fold in range(5):
        weights = train_networks(clips, folds != fold)
        found |= _found(clips, folds == fold, weights)
    for name in sorted(set(clips.simulators)):
        lines.append(_row(f"a fifth, {name}", clips, clips.simulators == name, found))
    lines.append(_row("a fifth", clips, every, found))
    lines += ["", _of_tones(clips, found)]
    return "\n".join(lines) + "\n"


def _found(clips: TrainingClips, held: np.ndarray, weights: dict[str, np.ndarray]) -> dict[int, Chosen]:
    posterior, tones = clips.posterior, clips.tones
    found = {
        place: learnt_blur(clips.features[place], posterior[place], clips.alone[place], weights)
        for place in np.flatnonzero(held)
    }
    return {place: (one.width, one.chosen(tones[place])) for place, one in found.items()}


def _row(title: str, clips: TrainingClips, held: np.ndarray, found: dict[int, Chosen]) -> str:
    places = np.flatnonzero(held)
    quantiles = np.log([found[place][0] for place in places])
    true, wide = np.log(clips.width[places]), clips.width[places] > 0.6
    error = (quantiles[:, 1] - true)[wide]
    within = ((true >= quantiles[:, 0]) & (true <= quantiles[:, 2])).mean()
    removed = np.array([_gains_at(clips.gains[place], np.array([found[place][1]]))[0] for place in places])
    best = clips.gains[places].max(1).mean()
    size = np.abs(error) if error.size else np.array([np.nan])
    return (
        f"| {title} | {len(places)} | {np.median(error) if error.size else np.nan:+.2f}, {np.median(size):.2f}, "
        f"{np.quantile(size, 0.9):.2f} | {within:.0%} | {best:.2f} | {clips.right[places].mean():.2f} | "
        f"{removed.mean():.2f} | {(removed < -0.2).mean():.0%} |"
    )


def _of_tones(clips: TrainingClips, found: dict[int, Chosen]) -> str:
    """Sentence on the clips that have two tones, of which the networks were trained on none."""
    tones = np.array([one.width if one is not None and one.clear else np.nan for one in clips.tones])
    places = np.flatnonzero(np.isfinite(tones))
    errors = np.log(tones / clips.width)[places]
    removed, told = (
        np.array([_gains_at(clips.gains[place], np.array([width]))[0] for place, width in widths])
        for widths in ([(one, found[one][1]) for one in places], [(one, tones[one]) for one in places])
    )
    scatter = 1.48 * np.median(np.abs(errors - np.median(errors)))
    better, worse = (told > removed + 1).sum(), (told < removed - 1).sum()
    return (
        f"Of the {len(clips.tones):,} clips {len(places)} have two tones, which tell ln width with a bias of "
        f"{np.median(errors):+.2f} and a deviation of {scatter:.2f}, and gain {told.mean():.2f} dB, networks "
        f"{removed.mean():.2f} (a fifth left out); by more than 1 dB {better} are better and {worse} worse."
    )


def _gains_at(gains: np.ndarray, widths: np.ndarray) -> np.ndarray:
    """Gains on the grid of WIDTHS at other widths; those of a narrow blur grow as its square."""
    logs, known = np.log(np.maximum(widths, WIDTHS[1])), np.log([*WIDTHS[1:], BEYOND * WIDTHS[-1]])
    return np.minimum(np.square(widths / WIDTHS[1]), 1) * np.interp(logs, known, [*gains[1:], WORST])


if __name__ == "__main__":
    sys.exit(main())

"""Score this project on a local copy of a published data set, by the authors' protocol where it is known.

``python benchmarks/datasets.py NAME FOLDER`` prints a Markdown table; ``--limit`` takes the first sequences only,
``--out`` writes the results as images, ``--json`` the figures.  No data set comes with this project.

What the layouts and protocols rest on
--------------------------------------
atsyn-static (github.com/xg416/DATUM: DataLoaderTurbImageTest, test_DATUM_static.py): ``SEQ/turb/0.png`` … ``49.png``
    and ``SEQ/gt.jpg``.  Frames 15 to 34 are the input.  PSNR and SSIM of four output frames against gt, means over the
    frames, then over the sequences; one image for all frames has the same figure four times.
atsyn-dynamic (same repository: make_lmdb.py, test_DATUM_dynamic.py): ``turb/NAME.mp4`` and ``gt/NAME.mp4`` with
    ``test_info.json``, which gives each video a turb_level.  The first 120 frames are the input; PSNR and SSIM of each
    but the first and last two.  Means over the frames, then over the videos, also by level.  LPIPS is left out.
tmt-static (github.com/xg416/TMT: test_TMT_static.py): as atsyn-static, frames JPEG or PNG.  Frames 0 to 47 are the
    input in four windows of 12, which are restored each by itself.
turbulence-text (DATUM: inferece_DATUM_text.py): ``SEQ/data_0001.png`` … ``data_0100.png``, 440×440.  Frames 21 to 80
    are the input.  The authors recognise the text by networks that are not here: ``--out`` writes
    ``SEQ/result_0001.png`` for them.  Where a user puts the text into ``SEQ/words.txt``, the shares that tesseract
    reads in the result and in the temporal mean are printed, which are not the authors' metric.
otis (zenodo.org/records/161439): ``Fixed Patterns/PatternN/*.png`` and ``GT/PatternN_GT.png`` below each, known from
    three independent programs that read it, not from the authors.  The truth is aligned with the temporal mean by its
    authors.  PSNR, SSIM; the paper discusses metrics but fixes no protocol that could be verified here.
heat-chamber (github.com/VITA-Group/TurbNet links it): ``SCENE/turb/*.png`` and ``SCENE/gt.png``, known from one program
    of third parties; neither layout nor protocol could be verified.  PSNR, SSIM.
rlr-at (github.com/Shengqi77/RLR-AT, folder data/): ``SEQ/1.png`` … without truth.  The protocol could not be verified;
    sharpness and overshoot relative to the temporal mean are this project's own metrics.
clear (Bristol, N. Anantrasirichai): videos or folders of images, without truth; neither layout nor protocol could be
    verified.  As rlr-at.

SSIM is that of the authors of ATSyn and TMT: a Gaussian window of 11 pixels with σ = 1.5, mean over channels and over
the pixels whose window lies inside (TMT; torchmetrics, which ATSyn uses, pads and then cuts off the same border).
Nothing is aligned before PSNR and SSIM, as the authors do not.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from words import can_read, share_read

from turbrestore.core.arrays import FloatArray
from turbrestore.core.errors import DataError, InputNotFoundError, OutputError, TurbrestoreError
from turbrestore.io.images.image_files import read_image, write_image
from turbrestore.io.output import atomic_write
from turbrestore.io.video import VIDEO_SUFFIXES, open_frames
from turbrestore.metrics import appearance, psnr
from turbrestore.pipeline import restore
from turbrestore.steady.video import steady_frames

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif")
# Frames of a video that count, and those at either end that do not.
VIDEO_FRAMES, VIDEO_ENDS = 120, 2
TEXT_FRAMES = range(21, 81)

Figures = dict[str, float]


@dataclass(frozen=True, eq=False)
class Sample:
    """A sequence: its frames, its truth and text where there are any, and what it is averaged with.

    ``windows`` are the frames that are restored together, each (T, H, W[, 3]); ``truth`` is an image, or frames of a
    video; ``video`` says which.
    """

    name: str
    windows: Callable[[], Iterator[FloatArray]]
    truth: Callable[[], FloatArray] | None = None
    words: tuple[str, ...] = ()
    group: str = ""
    video: bool = False


def atsyn_static(folder: Path) -> Iterator[Sample]:
    """Sequences of ATSyn-static: the 20 frames in the middle of 50."""
    for sequence in _folders(folder, "turb", "gt.jpg"):
        yield Sample(sequence.name, _windows(sequence / "turb", [range(15, 35)]), _image(sequence / "gt.jpg"))


def tmt_static(folder: Path) -> Iterator[Sample]:
    """Sequences of the static data of TMT: four windows of 12 frames."""
    windows = [range(start, start + 12) for start in range(0, 48, 12)]
    for sequence in _folders(folder, "turb", "gt.jpg"):
        yield Sample(sequence.name, _windows(sequence / "turb", windows), _image(sequence / "gt.jpg"))


def atsyn_dynamic(folder: Path) -> Iterator[Sample]:
    """Videos of ATSyn-dynamic, grouped by the strength that ``test_info.json`` gives where it is there."""
    levels = _levels(folder / "test_info.json")
    for path in sorted((folder / "turb").glob("*.mp4")):
        truth = folder / "gt" / path.name
        level = levels.get(path.name, "")
        yield Sample(path.name, _video(path), partial(_frames, truth), group=level, video=True)


def turbulence_text(folder: Path) -> Iterator[Sample]:
    """Sequences of Turbulence Text: the 60 frames in the middle of 100."""
    for sequence in _folders(folder, "data_0001.png"):
        text = sequence / "words.txt"
        words = tuple(text.read_text().lower().split()) if text.is_file() else ()
        yield Sample(sequence.name, _windows(sequence, [TEXT_FRAMES], "data_{:04d}"), words=words)


def otis(folder: Path) -> Iterator[Sample]:
    """Patterns of OTIS, grey or colour."""
    patterns = folder / "Fixed Patterns"
    for sequence in _folders(patterns, "GT"):
        yield Sample(sequence.name, _all(sequence), _image(sequence / "GT" / f"{sequence.name}_GT.png"))


def heat_chamber(folder: Path) -> Iterator[Sample]:
    """Scenes of Heat Chamber."""
    for sequence in _folders(folder, "turb", "gt.png"):
        yield Sample(sequence.name, _all(sequence / "turb"), _image(sequence / "gt.png"))


def without_truth(folder: Path) -> Iterator[Sample]:
    """Videos and folders of images."""
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in VIDEO_SUFFIXES or (path.is_dir() and _images(path)):
            yield Sample(path.name, _all(path))


DATASETS: dict[str, Callable[[Path], Iterator[Sample]]] = {
    "atsyn-static": atsyn_static,
    "atsyn-dynamic": atsyn_dynamic,
    "tmt-static": tmt_static,
    "turbulence-text": turbulence_text,
    "otis": otis,
    "heat-chamber": heat_chamber,
    "rlr-at": without_truth,
    "clear": without_truth,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Score and print."""
    options = _options(arguments)
    try:
        figures = score_folder(options.name, options.folder, options.limit, options.out)
    except TurbrestoreError as error:
        print(f"datasets: {error}", file=sys.stderr)
        return error.exit_code
    print(table(options.name, figures), end="")
    if options.json is not None:
        atomic_write(options.json, (json.dumps(figures, indent=2) + "\n").encode(), overwrite=True)
    return 0


def score_folder(name: str, folder: Path, limit: int | None = None, out: Path | None = None) -> dict[str, Figures]:
    """Figures of every sequence, of groups, and their mean.

    Raises
    ------
    InputNotFoundError
        The folder does not exist.
    DataError
        It does not have the layout of the data set.
    """
    if not folder.is_dir():
        raise InputNotFoundError(f"{folder}: expected the folder of {name}, found none")
    samples = [*DATASETS[name](folder)][:limit]
    if not samples:
        raise DataError(f"{folder}: expected the layout of {name} as in benchmarks/datasets.py, found no sequence")
    written = (path for sample in samples for path in ((out / sample.name).glob("result_*.png") if out else ()))
    if (taken := next(written, None)) is not None:
        raise OutputError(f"{taken}: exists already; choose another folder for the results")
    results: dict[str, Figures] = {}
    for sample in samples:
        results[sample.name] = score(sample, out)
        print(f"{sample.name}: {results[sample.name]}", file=sys.stderr, flush=True)
    groups = dict.fromkeys(sample.group for sample in samples if sample.group)
    means = {f"mean, {group}": [results[s.name] for s in samples if s.group == group] for group in groups}
    return results | {title: _mean(found) for title, found in {**means, "mean": [*results.values()]}.items()}


def score(sample: Sample, out: Path | None = None) -> Figures:
    """Figures of one sequence, means over its windows and frames."""
    found = []
    for number, frames in enumerate(sample.windows()):
        if sample.video:
            kept = slice(VIDEO_ENDS, len(frames) - VIDEO_ENDS)
            images = [np.clip(steady.image, 0, 1) for steady in steady_frames(frames)][kept]
            truths = [*sample.truth()][kept] if sample.truth is not None else []
        else:
            images = [restore(frames).image]
            truths = [] if sample.truth is None else [sample.truth()]
        if out is not None:
            _write(out / sample.name, images, number)
        if truths:
            found += [{"psnr": psnr(*pair), "ssim": ssim(*pair)} for pair in map(_alike, images, truths)]
        elif sample.words and can_read():
            in_mean = share_read(frames.mean(axis=0), sample.words)
            found.append({"words": share_read(images[0], sample.words), "words in the mean": in_mean})
        else:
            seen = [appearance(image, frames.mean(axis=0)) for image in images]
            found += [{"sharpness": one.sharpness, "overshoot": one.overshoot} for one in seen]
    return _mean(found)


def ssim(image: FloatArray, truth: FloatArray) -> float:
    """Structural similarity of images of full scale 1, with the window and the border of the authors of TMT."""
    a, b = np.float64(image), np.float64(truth)
    kernel = cv2.getGaussianKernel(11, 1.5)

    def local(values: np.ndarray) -> np.ndarray:
        return cv2.sepFilter2D(values, -1, kernel, kernel)[5:-5, 5:-5]

    mean_a, mean_b = local(a), local(b)
    var_a, var_b = local(a * a) - mean_a**2, local(b * b) - mean_b**2
    covariance = local(a * b) - mean_a * mean_b
    c1, c2 = 0.01**2, 0.03**2
    found = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
    return float(np.mean(found / ((mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2))))


def table(name: str, figures: dict[str, Figures]) -> str:
    """Markdown of the figures of a data set."""
    columns = [*next(iter(figures.values()))]
    lines = [f"# turbrestore on {name}\n", f"| sequence | {' | '.join(columns)} |", f"|---|{'---:|' * len(columns)}"]
    lines += [
        f"| {title} | {' | '.join(f'{row[column]:.4f}' if column in row else '–' for column in columns)} |"
        for title, row in figures.items()
    ]
    return "\n".join(lines) + "\n"


def _mean(rows: Sequence[Figures]) -> Figures:
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: round(float(np.mean([row[name] for row in rows if name in row])), 4) for name in names}


def _alike(image: FloatArray, truth: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Colour and grey as the truth is, whose size the image must have."""
    if image.shape[:2] != truth.shape[:2]:
        raise DataError(f"truth: expected the size of the result {image.shape[:2]}, found {truth.shape[:2]}")
    if image.ndim == truth.ndim:
        return image, truth
    return (np.stack([image] * 3, axis=-1), truth) if truth.ndim == 3 else (image.mean(axis=-1), truth)


def _levels(path: Path) -> dict[str, str]:
    """Strength of the turbulence by video, as the authors list them; nothing where there is no list."""
    if not path.is_file():
        return {}
    try:
        listed = json.loads(path.read_text("utf-8")).values()
        return {entry["video_name"]: str(entry["turb_level"]) for entry in listed if isinstance(entry, dict)}
    except (ValueError, AttributeError, KeyError, TypeError) as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise DataError(f"{path}: expected videos with video_name and turb_level as JSON ({reason})") from error


def _folders(folder: Path, *needed: str) -> list[Path]:
    """Return folders that have everything that is needed."""
    found = sorted(folder.iterdir()) if folder.is_dir() else []
    return [path for path in found if path.is_dir() and all((path / name).exists() for name in needed)]


def _images(folder: Path) -> list[Path]:
    return [path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES]


def _windows(folder: Path, windows: list[range], form: str = "{:d}") -> Callable[[], Iterator[FloatArray]]:
    """Frames by their numbers, whichever format they have."""

    def read() -> Iterator[FloatArray]:
        known = {path.stem: path for path in _images(folder)}
        for numbers in windows:
            missing = [form.format(number) for number in numbers if form.format(number) not in known]
            if missing:
                asked = f"expected frames {numbers[0]} to {numbers[-1]}"
                raise DataError(f"{folder}: {asked}, found none called {missing[0]}")
            yield np.stack([read_image(known[form.format(number)]).image for number in numbers])

    return read


def _all(path: Path) -> Callable[[], Iterator[FloatArray]]:
    """All frames of a video or of a folder of images."""

    def read() -> Iterator[FloatArray]:
        yield open_frames(path).read()

    return read


def _video(path: Path) -> Callable[[], Iterator[FloatArray]]:
    def read() -> Iterator[FloatArray]:
        yield _frames(path)

    return read


def _frames(path: Path) -> FloatArray:
    return open_frames(path).select(frames=(0, min(VIDEO_FRAMES, open_frames(path).shape[0]), None)).read()


def _image(path: Path) -> Callable[[], FloatArray]:
    return lambda: read_image(path).image


def _write(folder: Path, images: Sequence[FloatArray], window: int) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for number, image in enumerate(images):
        write_image(folder / f"result_{window + number + 1:04d}.png", image, 8)


def _options(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=[*DATASETS])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--limit", type=int, metavar="N", help="take the first N sequences only")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write the results as images")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())

"""Files as programs and cameras write them: counts, FITS of pipelines, twins, HDR, tints, pictures that freeze.

    python benchmarks/usual_files.py

prints of every file the peak signal-to-noise ratio of the result and of the temporal mean of the frames that were
written, after the best gain and offset, the largest error of a mean colour in grey levels, and what is wrong, if
anything.
``robustness.py --groups recordings`` asks that nothing is.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np

from turbrestore.core.arrays import FloatArray
from turbrestore.footage.checks.content import check_content, clean_source
from turbrestore.io.containers.encoding import Encoding, write_container
from turbrestore.io.pixels import at_levels
from turbrestore.io.video import open_frames
from turbrestore.metrics import compare
from turbrestore.pipeline import restore
from turbrestore.synthesis.scenes import picture
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows

COUNT, SIDE = 16, 112
# Decibels by which a result may be worse than the mean, and grey levels of 255 by which a mean colour may be off.
SLACK, LEVELS = 0.2, 2.0
# Primaries of BT.2020, and HLG and PQ, in ITU-T H.273.
BT2020, HLG, PQ = 9, 18, 16
TO_BT2020 = np.array([[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]])
Y, X = np.mgrid[:SIDE, :SIDE]
SEEN = np.hypot(Y - SIDE / 2, X - SIDE / 2) < 0.55 * SIDE


@dataclass(frozen=True)
class Kind:
    """A kind of file.

    ``write`` puts frames in [0, 1] into a folder and returns what to open; the numbers of the file are ``gain`` times
    the frames and ``offset``.  ``remark`` is a part of what has to be said, ``frames`` counts those that are used.
    """

    name: str
    write: Callable[[Path, FloatArray], Path]
    gain: float = 1
    offset: float = 0
    remark: str = ""
    colour: bool = False
    frames: int = COUNT


def clip(name: str, seed: int) -> tuple[FloatArray, FloatArray]:
    """Scene and frames behind moving air."""
    rng = np.random.default_rng(seed)
    scene = 0.06 + 0.88 * picture(name, SIDE, SIDE)
    flows = smooth_flows(COUNT, SIDE, SIDE, rng, SmoothFlowParams(rms=1.0))
    flows -= flows.mean(axis=0)
    return scene, distort(scene, flows, rng, blur=0.8, noise=0.006)


def with_rays(counts: np.ndarray) -> np.ndarray:
    """Cosmic rays: three pixels a frame far beyond the scene."""
    rng, struck = np.random.default_rng(8), counts.copy()
    for frame in struck:
        frame[rng.integers(0, SIDE, 3), rng.integers(0, SIDE, 3)] = 60_000
    return struck


def saved(array: np.ndarray, folder: Path) -> Path:
    """Write an array."""
    np.save(folder / "clip.npy", array)
    return folder / "clip.npy"


def stacked(array: np.ndarray, folder: Path) -> Path:
    """Write a TIFF stack."""
    import tifffile

    tifffile.imwrite(folder / "clip.tif", array, photometric="minisblack")
    return folder / "clip.tif"


def as_8_bits(frames: FloatArray) -> np.ndarray:
    """Frames of a camera of 8 bits."""
    return np.rint(255 * np.clip(frames, 0, 1)).astype(np.uint8)


def images(folder: Path, frames: FloatArray, names: Callable[[int], str], *more: str) -> Path:
    """Write a folder of PNG images, and each in further formats."""
    for number, frame in enumerate(as_8_bits(frames)):
        for suffix in (".png", *more):
            cv2.imwrite(str(folder / f"{names(number)}{suffix}"), frame)
    return folder


def fits_units(folder: Path, *units: tuple[str, np.ndarray], packed: bool = False) -> Path:
    """Write images as extensions of one FITS file."""
    from astropy.io import fits

    kind = fits.CompImageHDU if packed else fits.ImageHDU
    path = folder / ("clip.fits.fz" if packed else "clip.fits")
    fits.HDUList([fits.PrimaryHDU(), *(kind(data, name=name) for name, data in units)]).writeto(path)
    return path


def fits_of_own_scale(folder: Path, frames: FloatArray) -> Path:
    """Write FITS files of 16 bits, each with a BSCALE and BZERO of its own."""
    from astropy.io import fits

    for number, frame in enumerate(frames):
        unit = fits.PrimaryHDU(2000 * frame + number)
        unit.scale("int16", "minmax")
        unit.writeto(folder / f"{number:02d}.fits")
    return folder


def without_times(folder: Path, frames: FloatArray) -> Path:
    """Write Matroska whose time stamps are all zero."""
    import av

    whole, path = folder / "whole.mkv", folder / "clip.mkv"
    write_container(whole, iter(frames), 25, encoding=Encoding("h264", 8))
    with av.open(str(whole)) as source, av.open(str(path), "w") as output:
        stream = output.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(source.streams.video[0]):
            if packet.size:
                packet.pts = packet.dts = 0
                packet.time_base, packet.stream = Fraction(1, 1000), stream
                output.mux(packet)
    whole.unlink()
    return path


def hdr(folder: Path, frames: FloatArray, transfer: int) -> Path:
    """Write frames as a phone does: light at 203 cd/m² for white, BT.2020, HLG or PQ."""
    light = 203 * np.clip(np.clip(frames, 0, 1) ** 2.2 @ TO_BT2020.T, 0, 1)
    if transfer == PQ:
        power = (light / 10000) ** 0.1593017578125
        codes = ((0.8359375 + 18.8515625 * power) / (1 + 18.6875 * power)) ** 78.84375
    else:
        luminance = np.maximum(light @ np.array([0.2627, 0.6780, 0.0593]), 1e-9)[..., None] / 1000
        scene = light / 1000 * luminance ** (1 / 1.2 - 1)
        logarithm = 0.17883277 * np.log(np.maximum(12 * scene - 0.28466892, 1e-9)) + 0.55991073
        codes = np.where(scene <= 1 / 12, np.sqrt(3 * scene), logarithm)
    path = folder / "clip.mp4"
    write_container(
        path, iter(codes.astype(np.float32)), 25, 10, encoding=Encoding("hevc", 6), colour=(BT2020, transfer)
    )
    return path


def filmed(folder: Path, frames: FloatArray, crf: int = 10) -> Path:
    """Write H.264."""
    write_container(
        folder / "clip.mp4", iter(np.clip(frames, 0, 1).astype(np.float32)), 25, encoding=Encoding("h264", crf)
    )
    return folder / "clip.mp4"


def tinted(frames: FloatArray) -> FloatArray:
    """White balance that hunts: red and blue wander against green."""
    phase = np.arange(COUNT)[:, None, None] / 2.5
    gains = np.stack([1 + 0.12 * np.sin(phase), 1 + 0 * phase, 1 - 0.1 * np.cos(phase)], axis=-1)
    return frames * 0.85 * gains / gains.mean(axis=0)


def frozen(frames: FloatArray) -> FloatArray:
    """Stop the picture for half of the time, at a frame that the air has bent."""
    result = frames.copy()
    result[4:12] = frames[4]
    return result


def write_dng(path: Path, mosaic: np.ndarray, neutral: tuple[float, float, float] = (0.5, 1, 0.6)) -> None:
    """Write a raw file of 12 bits, (H, W), of a sensor that begins with red and green and to which grey is neutral."""
    import tifffile

    def rational(*values: float) -> list[int]:
        return [part for value in values for part in (round(10000 * value), 10000)]

    tags = [
        (271, 2, 0, "Sensor", True),
        (272, 2, 0, "Sensor", True),
        (274, 3, 1, 1, True),
        (33421, 3, 2, (2, 2), True),
        (33422, 1, 4, bytes([0, 1, 1, 2]), True),
        (50706, 1, 4, bytes([1, 4, 0, 0]), True),
        (50708, 2, 0, "Sensor", True),
        (50717, 4, 1, 4095, True),
        (50721, 10, 9, rational(1, 0, 0, 0, 1, 0, 0, 0, 1), True),
        (50728, 5, 3, rational(*neutral), True),
        (50778, 3, 1, 21, True),
    ]
    tifffile.imwrite(path, mosaic.astype(np.uint16), photometric=32803, extratags=tags, metadata=None, software=None)


def raw_and_jpeg(folder: Path, frames: FloatArray) -> Path:
    """Write every shot as DNG and as JPEG."""
    for number, frame in enumerate(frames):
        light = 4095 * np.where(frame < 0.081, frame / 4.5, ((frame + 0.099) / 1.099) ** (1 / 0.45))
        # A neutral sensor: grey light gives (0.5, 1, 0.6).
        mosaic = light.copy()
        mosaic[::2, ::2] *= 0.5
        mosaic[1::2, 1::2] *= 0.6
        write_dng(folder / f"shot{number}.dng", np.rint(mosaic))
        cv2.imwrite(str(folder / f"shot{number}.jpg"), as_8_bits(frame))
    return folder


def noisy(frames: FloatArray) -> FloatArray:
    """Add the noise of a capture card."""
    return frames + 0.003 * np.random.default_rng(5).standard_normal(frames.shape).astype(np.float32)


KINDS = (
    Kind("int16 .npy", lambda p, f: saved((2500 * f).astype(np.int16), p), 2500, remark="are scaled"),
    Kind("int32 TIFF", lambda p, f: stacked((90_000 * f).astype(np.int32), p), 90_000, remark="are scaled"),
    Kind("float TIFF, some negative", lambda p, f: stacked(np.float32(900 * f - 60), p), 900, -60, "are scaled"),
    Kind("uint64 sums .npy", lambda p, f: saved((5000 * f).astype(np.uint64), p), 5000, remark="are scaled"),
    Kind("float .npy, cosmic rays", lambda p, f: saved(with_rays(np.float32(800 * f)), p), 800, remark="are clipped"),
    Kind("(H, W, T) .npy", lambda p, f: saved(np.moveaxis(as_8_bits(f), 0, -1), p), remark="(H, W, T)"),
    Kind("PNG and JPEG", lambda p, f: images(p, f, lambda k: f"IMG_{k}", ".jpg"), remark=".png is read"),
    Kind("decimal seconds", lambda p, f: images(p, f, lambda k: f"t{9.5 + k / 8:g}s")),
    Kind("time stamps of zero", without_times),
    Kind("DNG and JPEG", raw_and_jpeg, remark=".dng is read"),
    Kind("FITS, scale of each file", fits_of_own_scale, 2000, (COUNT - 1) / 2, "are scaled"),
    Kind("FITS, frame per extension", lambda p, f: fits_units(p, *(("", x) for x in f)), remark="extensions"),
    Kind("FITS, errors first", lambda p, f: fits_units(p, ("ERR", f**0.5), ("SCI", 900 * f)), 900, remark="are scaled"),
    Kind("FITS, tiles", lambda p, f: fits_units(p, ("", np.int16(3000 * f)), packed=True), 3000, remark="are scaled"),
    Kind("FITS, NaN border", lambda p, f: fits_units(p, ("", np.where(SEEN, f, np.nan))), remark="no frame"),
    Kind("HLG", lambda p, f: hdr(p, 0.8 * f, HLG), 0.8, remark="HLG", colour=True),
    Kind("PQ", lambda p, f: hdr(p, 0.8 * f, PQ), 0.8, remark="PQ", colour=True),
    Kind("white balance hunts", lambda p, f: filmed(p, tinted(f)), 0.85, remark="white balance", colour=True),
    Kind("frozen, noise", lambda p, f: saved(as_8_bits(noisy(frozen(f))), p), remark="duplicated", frames=COUNT - 7),
    Kind("frozen, H.264", lambda p, f: filmed(p, frozen(f), 20), remark="duplicated", frames=COUNT - 7),
)


@dataclass(frozen=True)
class Figures:
    """What became of one file."""

    name: str
    result: float
    mean: float
    colour: float
    faults: tuple[str, ...]


def figures() -> Iterator[Figures]:
    """Write, read and restore every kind of file, of two scenes."""
    for seed, (grey, colour) in enumerate((("coins", "coffee"), ("page", "cat"))):
        made = {False: clip(grey, 40 + seed), True: clip(colour, 50 + seed)}
        for kind in KINDS:
            with tempfile.TemporaryDirectory() as folder:
                yield examine(kind, (colour if kind.colour else grey), *made[kind.colour], Path(folder))


def examine(kind: Kind, name: str, scene: FloatArray, frames: FloatArray, folder: Path) -> Figures:
    """Compare the result with the scene, with the mean of the frames and with their colours."""
    source = open_frames(kind.write(folder, frames))
    cleaned = clean_source(source, check_content(source))
    found = restore(cleaned)
    remarks = " ".join((*cleaned.warnings, *(decision.subject for decision in found.decisions)))
    kept = frames if kind.frames == COUNT else np.delete(frames, slice(5, 12), axis=0)
    usual, image = kept.mean(axis=0), found.image
    if image.ndim > scene.ndim:
        image = image.mean(axis=2)
    margin = 20 if "NaN" in kind.name else 10
    inner = np.s_[margin:-margin, margin:-margin]
    result, mean = (compare(shown[inner], scene[inner]).psnr_fit for shown in (image, usual))
    numbers, expected = at_levels(image[inner], source.levels), kind.gain * usual[inner] + kind.offset
    off = 255 / kind.gain * float(np.abs(numbers.mean(axis=(0, 1)) - expected.mean(axis=(0, 1))).max())
    faults = [f"{len(cleaned)} frames, not {kind.frames}"] * (len(cleaned) != kind.frames)
    faults += [f"{result:.2f} dB, mean {mean:.2f}"] * (result < mean - SLACK)
    faults += [f"colour off by {off:.1f} grey levels"] * (off > LEVELS)
    faults += [f"no remark on {kind.remark!r}"] * (kind.remark not in remarks)
    return Figures(f"{name}, {kind.name}", result, mean, off, tuple(faults))


if __name__ == "__main__":
    for row in figures():
        wrong = "; ".join(row.faults) or "nothing is wrong"
        print(f"{row.name}: result {row.result:.2f}, mean {row.mean:.2f}, colour {row.colour:.2f}: {wrong}", flush=True)

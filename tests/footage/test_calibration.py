"""Dark and flat frames: a camera with known offsets and gains is undone."""

from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits

from conftest import make_sequence
from turbrestore.core.errors import DataError
from turbrestore.footage.checks.content import check_content, clean_source
from turbrestore.footage.sensor.calibration import calibrated, make_calibration
from turbrestore.io.images.image_files import read_image, write_image
from turbrestore.io.source import FrameSource
from turbrestore.io.video import open_frames, write_video
from turbrestore_cli.__main__ import main

RNG = np.random.default_rng(5)
SHAPE = (24, 30)
OFFSET = RNG.uniform(0.02, 0.06, SHAPE)
GAIN = RNG.uniform(0.7, 1.3, SHAPE)
SCENE = make_sequence(seed=3, count=4, size=64, noise=0).frames[:, 10:34, 8:38] * 0.6 + 0.1


def seen(light, dtype=np.uint16):
    """What the camera makes of light."""
    return np.uint16(np.rint((light * GAIN + OFFSET) * 65535)) if dtype == np.uint16 else light * GAIN + OFFSET


def sources(dtype=np.uint16):
    stacks = (seen(SCENE, dtype), seen(np.zeros((5, *SHAPE)), dtype), GAIN[None] * 0.5)
    return [FrameSource.from_array(stack, name) for stack, name in zip(stacks, ("clip", "dark", "flat"), strict=True)]


def truth():
    return SCENE * GAIN.mean()


@pytest.mark.parametrize("dtype", [np.uint16, np.float64])
def test_offsets_and_gains_are_undone(dtype):
    clip, dark, flat = sources(dtype)
    source = calibrated(clip, make_calibration(clip, dark, flat))
    np.testing.assert_allclose(source.read(), truth(), atol=3e-5)
    assert source.bit_depth == clip.bit_depth and source.shape == clip.shape
    np.testing.assert_array_equal(source.select(roi=(3, 2, 9, 8)).read(), source.read()[:, 2:10, 3:12])
    (remark,) = source.warnings
    assert "dark of dark (5 frames" in remark and "flat of flat (1 frame," in remark


def test_each_alone():
    clip, dark, flat = sources()
    np.testing.assert_allclose(calibrated(clip, make_calibration(clip, dark, None)).read(), SCENE * GAIN, atol=3e-5)
    raw = clip.read() / GAIN * GAIN.mean()
    np.testing.assert_allclose(
        calibrated(clip, make_calibration(clip, None, flat)).read(), np.minimum(raw, 1), atol=3e-5
    )


def test_hot_and_dead_pixels_are_filled_from_around():
    clip, dark, flat = (source.read().astype(np.float64) for source in sources())
    places = [(0, 0), (7, 9), (7, 10), (23, 29)]
    for row, column in places:
        dark[:, row, column] = clip[:, row, column] = 1
    flat[:, 12, 13] = clip[:, 12, 13] = 0
    named = [FrameSource.from_array(stack, name) for stack, name in zip((clip, dark, flat), "abc", strict=True)]
    calibration = make_calibration(*named)
    assert [tuple(place) for place in np.argwhere(calibration.bad)] == sorted([*places, (12, 13)])
    found = calibrated(named[0], calibration).read()
    assert np.abs(found - truth()).max() < 0.25 and np.isfinite(found).all()
    assert np.abs(found - truth())[:, ~calibration.bad].max() < 2e-3


def test_repairs_of_the_content_come_after():
    clip, dark, flat = sources(np.float64)
    values = np.array(list(clip.native()))
    values[2, 5, 6] = np.nan
    clip = FrameSource.from_array(values, "clip")
    source = calibrated(clip, make_calibration(clip, dark, flat))
    cleaned = clean_source(source, check_content(source))
    found = cleaned.read()
    assert any("NaN" in warning for warning in cleaned.warnings)
    assert np.abs(found - truth())[2, 5, 6] < 0.1
    np.testing.assert_allclose(np.delete(found, 2, 0), np.delete(truth(), 2, 0), atol=1e-5)


@pytest.mark.parametrize("kinds", [(np.uint16, np.float32), (np.float32, np.uint16), (np.float32, np.float32)])
def test_counts_in_fits_files_are_compared_as_counts(tmp_path, kinds):
    """A master dark of counts in floating point belongs to a clip of unsigned integers, and the other way round."""
    counts = [seen(SCENE), np.tile(seen(np.zeros(SHAPE)), (2, 1, 1))]
    for values, kind, name in zip(counts, kinds, ("clip", "dark"), strict=True):
        fits.PrimaryHDU(values.astype(kind)).writeto(tmp_path / f"{name}.fits")
    clip, dark = (open_frames(tmp_path / f"{name}.fits") for name in ("clip", "dark"))
    found = calibrated(clip, make_calibration(clip, dark, None)).read()
    white = 65535 if kinds[0] == np.uint16 else counts[0].max()
    np.testing.assert_allclose(found, SCENE * GAIN * 65535 / white, atol=5e-5)


@pytest.mark.parametrize("stored", ["as they are", "in the upper bits", "spread over the range"])
@pytest.mark.parametrize("wider", ["dark", "clip"])
def test_twelve_bits_in_files_of_sixteen(stored, wider):
    counts = {"clip": np.rint((SCENE * GAIN + OFFSET) * 4095), "dark": np.rint(np.tile(OFFSET * 4095, (5, 1, 1)))}
    step = {"as they are": 1, "in the upper bits": 16, "spread over the range": 65535 / 4095}[stored]
    made = {name: FrameSource.from_array(np.uint16(values), name) for name, values in counts.items()}
    made = {name: replace(source, full_scale=4095, bit_depth=12) for name, source in made.items()}
    made[wider] = FrameSource.from_array(np.uint16(np.rint(counts[wider] * step)), wider)
    source = calibrated(made["clip"], make_calibration(made["clip"], made["dark"], None))
    # Full scale of a clip is that of its file.
    brightness = 4095 / 65535 if wider == "clip" and stored == "as they are" else 1
    np.testing.assert_allclose(source.read(), SCENE * GAIN * brightness, atol=6e-4)


@pytest.mark.parametrize("case", ["the mean of darks", "eight bits", "no light"])
def test_darks_of_another_depth_that_may_mean_either_are_refused(case):
    rng = np.random.default_rng(0)
    clip = FrameSource.from_array(np.uint16(rng.integers(200, 3000, (4, *SHAPE))), "clip")
    clip = replace(clip, full_scale=4095, bit_depth=12)
    if case == "eight bits":
        clip = FrameSource.from_array(np.uint8(rng.integers(20, 200, (4, *SHAPE))), "clip")
    dark = np.uint16(rng.integers(0, 200, (5, *SHAPE)) * (case != "no light"))
    if case == "the mean of darks":
        dark = np.uint16(16 * dark.mean(axis=0, keepdims=True))
    with pytest.raises(DataError, match="convert one of the two"):
        make_calibration(clip, FrameSource.from_array(dark, "dark"), None)


def test_a_black_frame_does_not_tell_how_values_are_stored():
    frames = np.rint(np.tile(OFFSET * 4095, (5, 1, 1)))
    dark = replace(FrameSource.from_array(np.uint16(frames), "dark"), full_scale=4095, bit_depth=12)
    clip = np.uint16(np.concatenate([np.zeros((1, *SHAPE)), np.rint((SCENE * GAIN + OFFSET) * 4095)]))
    found = make_calibration(FrameSource.from_array(clip, "clip"), dark, None)
    np.testing.assert_allclose(found.dark, OFFSET * 4095 / 65535, atol=1e-5)


@pytest.mark.parametrize(
    ("dark", "flat", "words"),
    [
        (np.zeros((1, 4, 4)), None, "expected 30×24 grey as in clip, found 4×4 grey"),
        (
            np.zeros((1, *SHAPE), np.uint8),
            None,
            "some frames of values up to 255 as in a, or of those spread over 65535",
        ),
        (None, np.zeros((1, *SHAPE)), "a flat with light"),
        (None, np.tile(np.arange(30) > 9, (1, 24, 1)) * 1.0, "few hot or dead pixels"),
    ],
)
def test_what_does_not_fit_is_refused(dark, flat, words):
    dark, flat = (array if array is None else FrameSource.from_array(array, "a") for array in (dark, flat))
    with pytest.raises(DataError, match=words):
        make_calibration(sources()[0], dark, flat)


def test_options_of_the_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    frames = make_sequence(seed=3, count=6, size=64).frames
    gain = np.linspace(0.6, 1.0, 64, dtype=np.float32)
    write_video(tmp_path / "clip.ser", frames * gain * 0.9 + 0.05, 25, bit_depth=16)
    write_video(tmp_path / "plain.ser", frames * gain.mean() * 0.9, 25, bit_depth=16)
    write_video(tmp_path / "dark.ser", np.full((3, 64, 64), 0.05, np.float32), 25, bit_depth=16)
    write_image(tmp_path / "flat.png", np.tile(gain, (64, 1)), 16)
    quick = ["--centroid.iterations", "1", "--filter.inner-iterations", "1", "--sigma", "0", "--threads", "1"]
    assert main(["restore", "clip.ser", "a.png", "--dark", "dark.ser", "--flat", "flat.png", *quick]) == 0
    assert "dark of dark.ser (3 frames" in capsys.readouterr().err
    assert main(["restore", "plain.ser", "b.png", *quick]) == 0
    assert np.abs(read_image("a.png").image - read_image("b.png").image).mean() < 1e-3
    assert main(["restore", "clip.ser", "c.png", "--config", "a.png.toml"]) == 0
    assert (tmp_path / "c.png").read_bytes() == (tmp_path / "a.png").read_bytes()

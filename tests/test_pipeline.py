from dataclasses import replace

import numpy as np
import pytest

from conftest import make_sequence
from turbrestore.alternating import FilterParams
from turbrestore.centroid import CentroidParams
from turbrestore.deconvolution import DeconvolutionParams
from turbrestore.errors import ConfigurationError, DataError
from turbrestore.frame_source import FrameSource
from turbrestore.metrics import compare
from turbrestore.pipeline import RestoreParams, restore, training_share

QUICK = RestoreParams(centroid=CentroidParams(iterations=2))


@pytest.fixture(scope="module")
def blurred():
    return make_sequence(seed=11, count=24, size=128, blur=1.2)


@pytest.fixture(scope="module")
def restoration(blurred):
    return restore(blurred.frames, replace(QUICK, train=14, deconvolution=DeconvolutionParams(sigma=1.1)))


def test_every_stage_improves_on_the_one_before(blurred, restoration):
    mean, centroid, filtered, deconvolved = (
        compare(image, blurred.scene).psnr
        for image in (
            restoration.mean,
            restoration.centroid.image,
            restoration.filtered.image,
            restoration.deconvolution.image,
        )
    )
    assert mean + 1 < centroid
    assert centroid <= filtered
    assert filtered + 1 < deconvolved


def test_the_image_is_that_of_the_last_stage(restoration):
    assert restoration.image is restoration.deconvolution.image
    assert restoration.image.dtype == np.float32
    assert np.isfinite(restoration.image).all()
    assert 0 <= restoration.image.min() <= restoration.image.max() <= 1


def test_the_mean_is_that_of_all_frames(blurred, restoration):
    assert np.allclose(restoration.mean, blurred.frames.mean(axis=0), atol=1e-5)
    assert restoration.frame_count == 24


@pytest.mark.parametrize("until", ["centroid", "identify", "filter"])
def test_until_stops_there(blurred, until):
    short = restore(blurred.frames[:6], replace(QUICK, until=until))
    assert (short.dynamics is not None) == (until != "centroid")
    assert (short.filtered is not None) == (until == "filter")
    assert short.deconvolution is None
    expected = short.filtered.image if until == "filter" else short.centroid.image
    assert short.image is expected


def test_a_source_is_read_once_and_front_to_back(blurred):
    reads = []
    array = FrameSource.from_array(blurred.frames[:8])

    def pixels(numbers):
        for number in numbers:
            reads.append(number)
            yield from array.pixels(range(number, number + 1))

    restore(replace(array, pixels=pixels), replace(QUICK, train=4, until="filter"))
    assert reads == list(range(8))


def test_the_result_is_the_same_every_time(blurred):
    first, second = (restore(blurred.frames[:6], QUICK).image for _ in range(2))
    assert (first == second).all()


@pytest.mark.parametrize("count", [2, 3, 5])
def test_few_frames_still_give_an_image(count):
    frames = make_sequence(seed=12, count=count, size=64, rms=0.5).frames
    image = restore(frames).image
    assert image.shape == (64, 64)
    assert np.isfinite(image).all()


def test_colour_gives_colour(blurred):
    tint = np.array([1.0, 0.8, 0.5], np.float32)
    image = restore(blurred.frames[:5, ..., None] * tint, QUICK).image
    assert image.shape == (128, 128, 3)
    # Chroma follows: the ratio of the channels stays that of the scene.
    assert np.median(image[..., 2] / image[..., 0]) == pytest.approx(0.5, abs=0.02)


def test_sigma_zero_leaves_the_filtered_image(blurred):
    result = restore(blurred.frames[:6], replace(QUICK, deconvolution=DeconvolutionParams(sigma=0.0)))
    assert np.allclose(result.image, np.clip(result.filtered.image, 0, 1))


def test_paper_settings_run(blurred):
    params = replace(
        QUICK,
        train=10,
        centroid=CentroidParams(mode="single", iterations=2),
        filter=FilterParams(residual="drop", sharpness=0, block=1, prior_frames=10),
    )
    assert np.isfinite(restore(blurred.frames, params).image).all()


def test_progress_reaches_every_stage(blurred):
    seen = {}
    restore(blurred.frames[:6], QUICK, lambda stage, done, total: seen.__setitem__(stage, (done, total)))
    assert set(seen) == {"centroid", "filter", "deconvolve"}
    assert all(0 < done <= total for done, total in seen.values())
    assert seen["filter"][0] == seen["filter"][1]


def test_training_share():
    assert training_share(120, (64, 64), wanted=7) == 7
    assert training_share(2, (64, 64)) == 2
    assert 2 <= training_share(300, (4320, 7680, 3)) < 10


def test_bad_input_is_refused(blurred):
    with pytest.raises(DataError, match="at least 2 to restore an image from, found 1"):
        restore(blurred.frames[:1])
    with pytest.raises(DataError, match="at least 16×16 pixels, found 8×8"):
        restore(blurred.frames[:, :8, :8])
    with pytest.raises(DataError, match="some contrast"):
        restore(np.full((5, 32, 32), 0.5, np.float32))
    with pytest.raises(ConfigurationError, match="^train: expected at most the 6 frames"):
        restore(blurred.frames[:6], RestoreParams(train=7))
    with pytest.raises(ConfigurationError, match="^train: expected 2 frames"):
        RestoreParams(train=1)
    with pytest.raises(ConfigurationError, match="^until: expected one of"):
        RestoreParams(until="sharpen")
    broken = blurred.frames[:6].copy()
    broken[3, 5, 5] = np.nan
    with pytest.raises(DataError, match="NaN"):
        restore(broken)

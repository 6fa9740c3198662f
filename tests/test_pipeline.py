from dataclasses import replace

import cv2
import numpy as np
import pytest

from conftest import make_sequence
from turbrestore.blur.estimation import BlurEstimate
from turbrestore.core.errors import ConfigurationError, DataError
from turbrestore.deblurring.remove_blur import blur_to_remove
from turbrestore.deconvolution.deconvolve import DeconvolutionParams
from turbrestore.filtering.alternating import FilterParams
from turbrestore.io.source import FrameSource
from turbrestore.memory_plan import training_share
from turbrestore.metrics import compare
from turbrestore.pipeline import restore
from turbrestore.registration.centroid import CentroidParams
from turbrestore.settings import RestoreParams, preset

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


def test_a_source_is_read_front_to_back_and_once_for_all_stages(blurred):
    reads = []
    array = FrameSource.from_array(blurred.frames[:8])

    def pixels(numbers):
        for number in numbers:
            reads.append(number)
            yield from array.pixels(range(number, number + 1))

    restore(replace(array, pixels=pixels), replace(QUICK, train=4, until="filter"))
    # Before the filter all frames are read for the survey.
    assert reads == [*range(8), *range(8)]


def test_colour_gives_colour(blurred):
    tint = np.array([1.0, 0.8, 0.5], np.float32)
    image = restore(blurred.frames[:5, ..., None] * tint, QUICK).image
    assert image.shape == (128, 128, 3)
    # Chroma follows: the ratio of the channels stays that of the scene.
    lit = image[image[..., 0] > 0]
    assert len(lit) > 0.9 * 128**2
    assert np.median(lit[:, 2] / lit[:, 0]) == pytest.approx(0.5, abs=0.02)


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
    assert np.isfinite(restore(blurred.frames[:16, :64, :64], params).image).all()


def test_progress_reaches_every_stage(blurred):
    sharper = replace(QUICK, deconvolution=DeconvolutionParams(sigma=1.1))
    seen = {}
    restore(blurred.frames[:6], sharper, progress=lambda stage, done, total: seen.__setitem__(stage, (done, total)))
    assert set(seen) == {"read", "centroid", "filter", "deconvolve"}
    assert all(0 < done <= total for done, total in seen.values())
    assert seen["filter"][0] == seen["filter"][1]


def test_training_share():
    assert training_share(120, (64, 64), wanted=7) == 7
    assert training_share(2, (64, 64)) == 2
    assert training_share(40, (64, 64), half=True) == 20
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
    broken = blurred.frames[:6].copy()
    broken[3, 5, 5] = np.nan
    with pytest.raises(DataError, match="NaN"):
        restore(broken)


def estimate_of(sigma):
    return BlurEstimate(sigma, 0.1, 5 / 3, 0.01, 1, 1.0, np.zeros(0), np.zeros(0))


def test_half_of_the_uncertainty_is_left_in_and_an_image_that_says_nothing_is_left_alone():
    assert blur_to_remove(estimate_of(2.0), DeconvolutionParams())[0] == pytest.approx(1.95)
    nothing = replace(estimate_of(0.0), uncertainty=np.inf)
    assert blur_to_remove(nothing, DeconvolutionParams())[0] == 0


def test_lucky_imaging_takes_the_sharpest_frames_only():
    sequence = make_sequence(seed=31, count=20, size=96, blur=0.8)
    frames = sequence.frames.copy()
    poor = np.arange(20) % 5 != 0
    frames[poor] = [cv2.GaussianBlur(frame, (0, 0), 2.0) for frame in frames[poor]]
    lucky = restore(frames, replace(QUICK, keep_best=0.2, until="filter"))
    assert np.array_equal(lucky.filtered.shares > 0, ~poor)
    assert any(decision.choice == "4 of 20 frames count" for decision in lucky.decisions)
    everything = restore(frames, replace(QUICK, until="filter", filter=FilterParams(sharpness=0.0)))
    assert compare(lucky.image, sequence.scene).psnr > compare(everything.image, sequence.scene).psnr + 1


def test_a_cropped_border_is_what_the_frames_show(blurred):
    jitter = np.random.default_rng(0).integers(-5, 6, (24, 2))
    frames = np.stack(
        [frame[8 + dy : 120 + dy, 8 + dx : 120 + dx] for frame, (dx, dy) in zip(blurred.frames, jitter, strict=True)]
    )
    settings = replace(QUICK, train=14, deconvolution=DeconvolutionParams(sigma=1.0, method="wiener"))
    whole, cropped = (restore(frames, replace(settings, border=border)) for border in ("keep", "crop"))
    x, y, width, height = cropped.crop
    assert whole.crop == (0, 0, 112, 112)
    assert 90 <= width < 112
    assert 90 <= height < 112
    assert np.array_equal(cropped.image, whole.image[y : y + height, x : x + width])
    assert whole.decisions[-1].choice == "kept"
    assert cropped.decisions[-1].choice == f"cropped to {width}×{height} pixels from ({x}, {y})"


def test_every_stage_says_what_it_decided(restoration):
    subjects = [decision.subject for decision in restoration.decisions]
    stages = ["training", "centroid", "displacement", "flow model", "frames", "geometry", "blur", "guards", "border"]
    assert list(dict.fromkeys(subjects)) == stages


def test_decisions_are_told_in_the_order_in_which_they_are_recorded(blurred):
    told = []
    restoration = restore(blurred.frames[:6], replace(QUICK, until="filter"), on_decision=told.append)
    assert tuple(told) == restoration.decisions
    assert told


def test_presets_are_sets_of_settings():
    assert preset("standard") == RestoreParams()
    assert preset("fast").filter.inner_iterations == 1
    with pytest.raises(ConfigurationError, match="preset: expected one of fast, standard, paper, found 'best'"):
        preset("best")


def test_frames_that_train_are_not_all_frames_where_they_are_skipped(blurred):
    with pytest.raises(ConfigurationError, match="train: expected fewer than the 24 frames"):
        restore(blurred.frames, replace(preset("paper"), train=24))


def test_blank_frames_change_nothing():
    frames = make_sequence(5, count=12, size=64, scene="camera", noise=0.01).frames
    gappy = np.insert(frames, [0, 4, 4, 12], 0.02, axis=0)
    whole, left = restore(frames), restore(gappy)
    np.testing.assert_array_equal(left.image, whole.image)
    assert left.frame_count == 12
    assert left.decisions[0].choice == "frames 0, 5, 6, 15 left out"

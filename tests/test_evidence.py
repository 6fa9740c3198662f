"""What the training frames say about the filtered image: its noise, and whether it is deblurred."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from conftest import make_sequence
from turbrestore import evidence
from turbrestore.core.noise_spectrum import fit_noise_spectrum
from turbrestore.core.verdict import CheckKind
from turbrestore.deconvolution.deconvolve import DeconvolutionParams
from turbrestore.pipeline import restore
from turbrestore.registration.centroid import CentroidParams
from turbrestore.settings import RestoreParams
from turbrestore.synthesis.scenes import SCENES

QUICK = RestoreParams(centroid=CentroidParams(iterations=2), deconvolution=DeconvolutionParams(iterations=20))
FILTERED = replace(QUICK, until="filter")
SIZE, DEVIATION = 128, 0.03


def with_smooth_noise(frames, seed, rho=0.0):
    """Frames with smooth noise, alike from one to the next by a correlation ``rho``."""
    rng, state, noisy = np.random.default_rng(seed), None, []
    for frame in frames:
        fresh = cv2.GaussianBlur(rng.standard_normal(frame.shape), (0, 0), 1.0)
        fresh *= DEVIATION / fresh.std()
        state = fresh if state is None else rho * state + np.sqrt(1 - rho**2) * fresh
        noisy.append(frame + state)
    return np.clip(noisy, 0, 1).astype(np.float32)


def subjects(restoration):
    return [one.subject for one in restoration.decisions]


@pytest.fixture(scope="module")
def clean():
    return 0.1 + 0.8 * make_sequence(seed=5, count=24, size=SIZE, scene="camera", noise=0.0, rms=0.5).frames


@pytest.mark.parametrize(("rho", "least"), [(0.0, 0.75), (0.5, 0.7)])
def test_the_noise_of_the_filtered_image_is_that_by_which_two_clips_of_one_scene_differ(clean, rho, least):
    found = [restore(with_smooth_noise(clean, seed, rho), FILTERED) for seed in (1, 2)]
    difference = np.float32((found[0].filtered.image - found[1].filtered.image) / np.sqrt(2))
    true = fit_noise_spectrum([difference], found[0].filtered.image)
    for one in found:
        # Two clips also differ by how their flows follow the noise of each centroid, which one clip cannot tell.
        assert least < one.noise.deviation / true.deviation < 1.05


def test_a_border_that_few_frames_show_does_not_count_for_the_noise(clean):
    noisy = with_smooth_noise(clean, 1)
    usual = restore(noisy, FILTERED)
    variance = usual.filtered.variance.copy()
    variance[:8] *= 300
    halves = evidence.halve(noisy, usual.centroid.flows, noisy.shape[1:], len(noisy))
    rare = evidence.fused_noise(replace(usual.filtered, variance=variance), halves)
    assert rare.deviation == pytest.approx(usual.noise.deviation, rel=0.1)


def test_noise_that_frames_share_is_no_change_of_the_scene():
    still = np.repeat(SCENES["camera"](SIZE, SIZE)[None], 14, axis=0)
    found = restore(with_smooth_noise(0.1 + 0.8 * still, 3, rho=0.5), QUICK)
    assert not found.structure.changes and found.deconvolution is not None


@pytest.mark.parametrize("count", [2, 3, 4])
def test_few_frames_are_not_deblurred_and_their_noise_is_known(count):
    found = restore(make_sequence(seed=2, count=count, size=64, rms=0.5).frames, QUICK)
    assert found.image.shape == (64, 64) and np.isfinite(found.image).all()
    assert "few frames" in subjects(found) and found.deconvolution is None
    assert found.noise is not None
    check = next(one for one in found.verdict.checks if one.kind is CheckKind.FEW_FRAMES)
    assert "pixels only" in check.text and check.remedy == "use at least 8"


def test_a_long_clip_of_which_few_frames_train_is_deblurred():
    found = restore(make_sequence(seed=3, count=16, size=96, blur=1.5).frames, replace(QUICK, train=4))
    assert "few frames" not in subjects(found) and found.deconvolution is not None


def test_the_halves_are_deblurred_by_the_shape_of_blur_that_was_asked_for(monkeypatch):
    shapes, actual = set(), evidence.wiener_filtered

    def watched(image, sigma, exponent, noise):
        shapes.add(exponent)
        return actual(image, sigma, exponent, noise)

    monkeypatch.setattr(evidence, "wiener_filtered", watched)
    frames = make_sequence(seed=3, count=12, size=96, blur=1.5, noise=0.003).frames
    asked = replace(QUICK.deconvolution, exponent=1.8)
    found = restore(frames, replace(QUICK, deconvolution=asked))
    assert found.deconvolution.sigma > 0 and shapes == {1.8}


def test_what_the_noise_costs_is_told(clean):
    seconds = restore(clean[:8], QUICK).seconds
    assert {"noise", "agreement"} <= seconds.keys()


@pytest.mark.parametrize(("share", "sharpened"), [(0.4, True), (0.6, False)])
def test_an_image_on_most_of_whose_detail_the_frames_disagree_is_not_sharpened(clean, monkeypatch, share, sharpened):
    monkeypatch.setattr(evidence, "disputed_detail", lambda *_: share)
    found = restore(np.clip([cv2.GaussianBlur(frame, (0, 0), 1.5) for frame in clean], 0, 1), QUICK)
    removed = [one.choice for one in found.decisions if one.subject == "blur"]
    if sharpened:
        assert found.deconvolution.sigma > 0.5 and len(removed) == 1
        return
    assert found.deconvolution.sigma == found.posterior.removed == 0
    assert removed[1] == "none removed" and removed[0] != "none removed"
    np.testing.assert_array_equal(found.deconvolution.image, found.filtered.recentred().image)
    # The guards have not forbidden it.
    kinds = {check.kind for check in found.verdict.checks}
    assert CheckKind.LESS_THAN_MEASURED in kinds and CheckKind.NO_BLUR_REMOVED not in kinds

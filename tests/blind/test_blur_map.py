"""A blur that differs between parts of an image is found and removed; one that does not is taken as one."""

import threading
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial

import cv2
import numpy as np
import pytest

from turbrestore.blind.blur_map import _like, blur_map_steps, estimate_blur_map, sigma_map, varying_deconvolution_steps
from turbrestore.blind.guards import GuardParams
from turbrestore.blind.remove_blur import remove_blur
from turbrestore.blur.estimation import BlurCandidate, BlurEstimate, choose_blur, estimate_blur, find_candidates
from turbrestore.blur.marginal_likelihood import WIDTHS
from turbrestore.core.arrays import luminance
from turbrestore.deconvolution.deconvolve import DeconvolutionParams, deconvolve, deconvolve_steps
from turbrestore.metrics import psnr
from turbrestore.runtime.runtime import Runtime
from turbrestore.runtime.steps import finish
from turbrestore.synthesis.scenes import SCENES

SIDE = 384
WIENER = DeconvolutionParams(method="wiener", exponent=2.0)
# The first attempt passes.
FIRST = GuardParams(ringing=1.0)


@cache
def blurred(name, left, right):
    """Scene, image and true widths: ``left`` up to a quarter, then linearly to ``right`` at three quarters."""
    scene = luminance(SCENES[name](SIDE, SIDE))
    widths = np.interp(np.arange(SIDE), [SIDE / 4, 3 * SIDE / 4], [left, right]) * np.ones((SIDE, 1))
    steps = np.linspace(min(left, right), max(left, right), 15) if left != right else np.array([left])
    image = np.zeros_like(scene)
    for index, step in enumerate(steps):
        share = np.interp(widths, steps, np.eye(len(steps))[index]) if left != right else 1.0
        image += (cv2.GaussianBlur(scene, (0, 0), step) * share).astype(np.float32)
    noise = np.random.default_rng(0).normal(0, 0.003, scene.shape)
    return scene, (image + noise).astype(np.float32), widths.astype(np.float32)


@cache
def estimated(name, left, right):
    """Widths of the whole image and of its tiles."""
    _, image, _ = blurred(name, left, right)
    whole = estimate_blur(image, exponent=2.0)
    return whole, estimate_blur_map(image, whole)


@pytest.fixture(scope="module")
def brick():
    return blurred("brick", 0.8, 2.2)


@pytest.mark.long
def test_a_blur_that_grows_to_the_right_is_found_and_removed(brick):
    scene, image, widths = brick
    _, found = estimated("brick", 0.8, 2.2)
    assert found.varies
    assert (found.sigmas[:, 1] > 1.4 * found.sigmas[:, 0]).all()
    assert (found.sigmas[:, 1] < 1.3 * 2.2).all()
    result = remove_blur(image, image, WIENER)
    assert "a width for every pixel" in [decision.choice for decision in result.decisions]
    single = deconvolve(image, result.blur.removable, WIENER).image
    assert psnr(result.deconvolution.image, scene) > psnr(single, scene) + 0.5
    assert result.deconvolution.sigma == pytest.approx(float(widths.mean()), rel=0.35)


@pytest.mark.parametrize("name", ["chart", "camera"])
def test_a_blur_that_is_the_same_everywhere_is_taken_as_one(name):
    assert not estimated(name, 1.4, 1.4)[1].varies


@pytest.mark.long
@pytest.mark.parametrize(("name", "left", "right", "agree"), [("camera", 1.4, 1.4, True), ("brick", 0.8, 2.2, False)])
def test_uncertainties_are_computed_only_if_widths_may_differ(monkeypatch, name, left, right, agree):
    _, image, _ = blurred(name, left, right)
    whole, _ = estimated(name, left, right)
    asked = []
    monkeypatch.setattr(
        "turbrestore.blind.blur_map.choose_blur", lambda *words: asked.append(words) or choose_blur(*words)
    )
    found = estimate_blur_map(image, whole)
    assert (asked == []) == agree
    assert np.isinf(found.uncertainties).all() == agree
    monkeypatch.setattr("turbrestore.blind.blur_map._agree", lambda tiles: False)
    with_uncertainties = estimate_blur_map(image, whole)
    assert found.varies == with_uncertainties.varies == (not agree)
    assert found.sigmas == pytest.approx(with_uncertainties.sigmas, rel=0.3 if agree else 0)


def test_true_widths_beat_every_single_width(brick):
    scene, image, widths = brick
    by_pixel = finish(varying_deconvolution_steps(partial(deconvolve_steps, image, params=WIENER), widths))
    singles = [deconvolve(image, width, WIENER).image for width in (0.8, 1.2, 1.5, 1.8, 2.2)]
    assert psnr(by_pixel.image, scene) > max(psnr(single, scene) for single in singles) + 1
    assert by_pixel.sigma == pytest.approx(1.5, abs=0.02)


def test_images_in_strips_and_in_a_file_are_the_same(brick, tmp_path, monkeypatch):
    _, image, widths = brick
    colour = np.stack([image, image[::-1], image.T], axis=-1)
    results = []
    for rows, folder in ((1000, None), (100, tmp_path)):
        monkeypatch.setattr("turbrestore.blind.blur_map._STRIP_ROWS", rows)
        attempt, runtime = partial(deconvolve_steps, colour, params=WIENER), Runtime(scratch=folder)
        results.append(finish(varying_deconvolution_steps(attempt, widths, runtime)).image)
    assert np.array_equal(*results)
    assert isinstance(results[1], np.memmap)


def test_interpolation_keeps_plateaus_and_is_monotone():
    widths = sigma_map([[1.0, 2.0, 4.0]] * 2, (500, 760))
    assert widths.shape == (500, 760)
    assert widths[0, 0] == 1.0
    assert widths[0, -1] == 4.0
    assert (np.diff(widths, axis=1) >= 0).all()
    assert np.ptp(widths, axis=0).max() == 0


@pytest.mark.parametrize("above", ["flat", "ramp"])
def test_a_tile_without_texture_is_not_taken_for_sharp(above):
    scene = SCENES["chart"](480, 480)
    scene[:310] = 0.88 if above == "flat" else np.linspace(0.3, 0.8, 480)
    noise = np.random.default_rng(0).normal(0, 0.003, scene.shape)
    image = (cv2.GaussianBlur(scene, (0, 0), 1.5) + noise).astype(np.float32)
    whole = estimate_blur(image, exponent=2.0)
    found = estimate_blur_map(image, whole)
    assert not found.varies
    assert (found.sigmas[0] == whole.sigma).all()


def test_a_sharp_part_beside_a_blurred_one_stays_sharp():
    scene = SCENES["brick"](480, 480)
    blurred = cv2.GaussianBlur(scene, (0, 0), 2.0)
    image = np.where(np.arange(480) < 240, scene, blurred) + np.random.default_rng(0).normal(0, 0.003, scene.shape)
    found = estimate_blur_map(image, estimate_blur(image, exponent=2.0))
    assert found.varies
    assert found.sigmas[:, 0].max() < 0.9
    assert found.sigmas[:, 1].min() > 1.2


def test_codec_blocks_in_tiles_do_not_pass_for_a_narrow_blur():
    def one(reduction, sigma, uncertainty):
        estimate = BlurEstimate(
            sigma, uncertainty, 1.2, 0.01, reduction, 1.0, WIDTHS, np.array([1.0, 0.9, 0.8, 0.7, 0])
        )
        return BlurCandidate(estimate, np.zeros((8, 8), np.float32))

    # (reduction, width): the blocks are seen at full size.
    tile = one(1, 0.8, 0.1), one(2, 3.2, 0.4), one(4, 3.6, 0.5)
    for whole, comparable in ((1, (1, 2, 4)), (2, (1, 2, 4)), (4, (2, 4)), (8, (4,)), (16, (1, 2, 4))):
        assert tuple(found.estimate.reduction for found in _like(tile, one(whole, 3.7, 0.4).estimate)) == comparable


def test_small_images_have_no_tiles():
    small = np.random.default_rng(0).random((600, 300)).astype(np.float32)
    assert estimate_blur_map(small, estimate_blur(small)) is None


@pytest.fixture
def counted(monkeypatch):
    """Widths that are deconvolved by."""
    widths = []

    def steps(image, width, *rest):
        widths.append(width)
        return (yield from deconvolve_steps(image, width, *rest))

    monkeypatch.setattr("turbrestore.blind.remove_blur.deconvolve_steps", steps)
    return widths


@pytest.mark.long
@pytest.mark.parametrize(("right", "varies"), [(1.4, False), (2.6, True)])
def test_the_deconvolution_beside_the_widths_of_tiles_is_used_where_these_agree(counted, right, varies):
    _, image, _ = blurred("brick", 0.8 if varies else 1.4, right)
    result = remove_blur(image, image, WIENER, FIRST)
    tried = counted.copy()
    counted.clear()
    in_turn = remove_blur(image, image, WIENER, FIRST, runtime=Runtime(memory_limit=1e9))
    assert np.array_equal(result.deconvolution.image, in_turn.deconvolution.image)
    assert result.decisions == in_turn.decisions
    assert ("a width for every pixel" in [decision.choice for decision in result.decisions]) == varies
    # If the widths differ, the deconvolution by one width is discarded.
    assert len(tried) == (1 + len(counted) if varies else 1)


def test_widths_and_deconvolution_do_not_wait_for_each_other(monkeypatch):
    _, image, _ = blurred("brick", 1.4, 1.4)
    both = threading.Barrier(2, timeout=20)

    def waiting(function):
        def wait(*arguments):
            both.wait()
            return (yield from function(*arguments))

        return wait

    monkeypatch.setattr("turbrestore.blind.remove_blur.deconvolve_steps", waiting(deconvolve_steps))
    monkeypatch.setattr("turbrestore.blind.remove_blur.blur_map_steps", waiting(blur_map_steps))
    decisions = remove_blur(image, image, WIENER, FIRST).decisions
    assert "blur by tiles" in [decision.subject for decision in decisions]


def test_after_an_interrupt_the_remaining_tiles_are_left_out(monkeypatch):
    _, image, _ = blurred("brick", 1.4, 1.4)
    tiles, begun = [], threading.Event()

    def estimated(tile, **settings):
        tiles.append(tile)
        begun.set()
        interrupted.wait(20)
        return find_candidates(tile, **settings)

    def interrupt(*_):
        begun.wait(20)
        raise KeyboardInterrupt
        yield

    class Pool(ThreadPoolExecutor):
        def __exit__(self, *error):
            # Whoever works in it has been told to stop.
            interrupted.set()
            return super().__exit__(*error)

    interrupted = threading.Event()
    monkeypatch.setattr("turbrestore.blind.remove_blur.ThreadPoolExecutor", Pool)
    monkeypatch.setattr("turbrestore.blind.blur_map.find_candidates", estimated)
    monkeypatch.setattr("turbrestore.blind.remove_blur.deconvolve_steps", interrupt)
    with pytest.raises(KeyboardInterrupt):
        remove_blur(image, image, WIENER)
    assert len(tiles) == 1

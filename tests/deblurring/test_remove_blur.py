"""Blind deconvolution: which width is removed, what the guards do about it, and how that is explained."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from turbrestore.blur.psf import KOLMOGOROV, blur_otf
from turbrestore.deblurring.guards import GuardParams
from turbrestore.deblurring.remove_blur import guarded_steps, remove_blur_memory, remove_blur_steps
from turbrestore.deconvolution.deconvolve import DeconvolutionParams, deconvolve_steps
from turbrestore.deconvolution.primal_dual import EARLY
from turbrestore.metrics import psnr
from turbrestore.runtime.steps import finish
from turbrestore.synthesis.scenes import SCENES

WIENER = DeconvolutionParams(method="wiener")
# What a Wiener filter does to the fine detail of this small scene passes.
LENIENT = GuardParams(ringing=0.5)


@pytest.fixture(scope="module")
def camera():
    scene = SCENES["camera"](128, 128)
    spectrum = np.fft.rfft2(scene) * blur_otf(scene.shape, 1.6, KOLMOGOROV)
    noise = np.random.default_rng(0).normal(0, 0.002, scene.shape)
    return scene, (np.fft.irfft2(spectrum, scene.shape) + noise).astype(np.float32)


def test_a_blind_result_is_sharper_and_closer_to_the_scene(camera):
    scene, image = camera
    result = finish(remove_blur_steps(image, image, WIENER, LENIENT))
    assert result.blur.sigma == pytest.approx(1.6, rel=0.25)
    assert result.deconvolution.sigma == result.blur.removable == result.readings[0].sigma
    assert psnr(result.deconvolution.image, scene) > psnr(image, scene) + 1
    assert [decision.subject for decision in result.decisions] == ["blur", "guards"]
    assert result.decisions[1].choice == "passed"


def test_a_failed_guard_lowers_the_width(camera):
    _, image = camera
    free = finish(remove_blur_steps(image, image, WIENER, LENIENT))
    bound = free.readings[0].noise_gain * 0.9
    result = finish(remove_blur_steps(image, image, WIENER, replace(LENIENT, noise_gain=bound)))
    assert 0 < result.deconvolution.sigma < free.deconvolution.sigma
    assert [reading.passed for reading in result.readings][-2:] == [False, True]
    assert result.decisions[1].choice.startswith(f"blur lowered from {free.deconvolution.sigma:.2f} to")


def test_if_every_width_fails_nothing_is_removed(camera):
    _, image = camera
    result = finish(remove_blur_steps(image, image, WIENER, GuardParams(noise_gain=1.0, overshoot=0.0)))
    assert result.deconvolution.sigma == 0
    assert np.array_equal(result.deconvolution.image, image)
    assert "no blur removed" in result.decisions[1].choice


def test_guards_do_not_override_a_given_width(camera):
    _, image = camera
    result = finish(remove_blur_steps(image, image, replace(WIENER, sigma=4.0)))
    assert result.blur is None
    assert result.deconvolution.sigma == 4.0
    assert not result.readings[0].passed
    assert result.decisions[0].reason == "asked for"
    assert result.decisions[1].choice == "failed, kept because the width was given"


@pytest.mark.parametrize("name", ["chart", "camera", "brick", "grass", "words"])
def test_a_width_far_too_large_is_lowered(name):
    scene = SCENES[name](128, 128)
    spectrum = np.fft.rfft2(scene) * blur_otf(scene.shape, 2.0, 2.0)
    noise = np.random.default_rng(1).normal(0, 0.002, scene.shape)
    image = (np.fft.irfft2(spectrum, scene.shape) + noise).astype(np.float32)

    def attempt(width, refuse):
        return deconvolve_steps(image, width, replace(WIENER, exponent=2.0), refuse=refuse)

    result, readings = finish(guarded_steps(attempt, image, 4.4, GuardParams()))
    assert not readings[0].passed
    assert readings[-1].passed
    assert 0 < result.sigma == readings[-1].sigma < 4.4


def test_a_hopeless_attempt_ends_early_and_the_same_width_is_found(camera):
    _, image = camera
    exact = DeconvolutionParams(iterations=60, tolerance=0.0)

    def found_by(attempt):
        result, readings = finish(guarded_steps(attempt, image, 4.4, GuardParams()))
        return result, [reading.sigma for reading in readings]

    iterations = []

    def attempt(width, refuse, early=True):
        result = yield from deconvolve_steps(image, width, exact, refuse=refuse if early else None)
        iterations.append(result.iterations)
        return result

    result, widths = found_by(attempt)
    assert iterations[0] == EARLY
    assert iterations[-1] == 60
    whole, same = found_by(partial(attempt, early=False))
    assert widths == same
    np.testing.assert_array_equal(result.image, whole.image)


def test_every_iteration_of_every_attempt_is_a_step(camera):
    _, image = camera
    bound = GuardParams(noise_gain=1.0, overshoot=0.0)
    states = []
    result = finish(remove_blur_steps(image, image, replace(WIENER, iterations=3, tolerance=0), bound), states.append)
    assert len(result.readings) > 1
    assert [state.iteration for state in states] == [1, 2, 3] * len(result.readings)


def test_a_run_may_end_between_two_steps(camera):
    _, image = camera
    steps = remove_blur_steps(image, image, WIENER)
    assert next(steps).iteration == 1
    steps.close()


def test_the_image_is_split_where_tiles_are_asked_for(camera):
    _, image = camera
    wide = np.tile(image, (3, 4))
    fixed = replace(WIENER, sigma=1.6, iterations=60, tolerance=0)
    whole = finish(remove_blur_steps(wide, wide, fixed))
    assert remove_blur_memory(wide.shape, fixed, side=384) < remove_blur_memory(wide.shape, fixed)
    tiled = finish(remove_blur_steps(wide, wide, fixed, side=384))
    assert not np.array_equal(tiled.deconvolution.image, whole.deconvolution.image)
    assert np.abs(tiled.deconvolution.image - whole.deconvolution.image).max() < 0.02

"""The cost of a width against its definition, and the compiled loop against the plain one."""

import cv2
import numpy as np
import pytest

from turbrestore.blur.marginal_likelihood import (
    _TOLERANCE,
    descend,
    fit_scene,
    image_gradients,
    likeliest_width,
    width_costs,
)
from turbrestore.blur.psf import GAUSSIAN
from turbrestore.synthesis.scenes import SCENES


def blurred(name, sigma, noise, size):
    scene = cv2.GaussianBlur(SCENES[name](size, size), (0, 0), sigma)
    return (scene + np.random.default_rng(0).normal(0, noise, scene.shape)).astype(np.float32)


def test_without_blur_the_cost_is_the_evidence_of_independent_gradients():
    # Without blur, gradients are independent: γ = max(y² − λ, 0) in closed form, and L = mean of y²/(λ+γ) + log(λ+γ).
    gradients = image_gradients(SCENES["camera"](64, 64))
    noise, y = 0.02, gradients.planes.astype(float)
    total = np.maximum(y**2, 2 * noise**2)
    exact = np.mean(y**2 / total + np.log(total))
    scene, prior = gradients.planes, np.full_like(gradients.planes, float(np.mean(y**2)))
    costs = []
    for _ in range(12):
        scene, prior, cost = fit_scene(gradients, scene, prior, blur=(1e-3, GAUSSIAN), noise=noise)
        costs.append(cost)
    assert np.all(np.diff(costs) < 1e-5)
    # γ → 0 is approached slowly.
    assert exact <= costs[-1] < exact + 0.05


def test_the_scene_of_a_blur_solves_its_normal_equations():
    gradients = image_gradients(blurred("camera", 1.5, 0.01, size=48))
    y, noise, prior = gradients.planes, 0.01, np.full_like(gradients.planes, 1e-3)
    scene = y
    otf = np.exp(-2 * (np.pi * 1.5 * gradients.frequency) ** 2)

    def blur(v):
        return np.fft.ifft2(otf[..., None] * np.fft.fft2(v, axes=(0, 1)), axes=(0, 1)).real

    before = prior
    for _ in range(40):
        before = prior
        scene, prior, _ = fit_scene(gradients, scene, prior, blur=(1.5, GAUSSIAN), noise=noise)
    gradient = blur(y - blur(scene)) / (2 * noise**2) - scene / before
    assert np.abs(gradient).max() < 0.02 * np.abs(blur(y) / (2 * noise**2)).max()


@pytest.mark.parametrize("scene", ["chart", "camera", "brick"])
def test_stopping_early_changes_no_width(monkeypatch, scene):
    gradients, widths = image_gradients(blurred(scene, 1.0, 0.002, size=96)), []
    for tolerance in (0.0, _TOLERANCE, 1e-2):
        monkeypatch.setattr("turbrestore.blur.marginal_likelihood._TOLERANCE", tolerance)
        widths.append(likeliest_width(width_costs(gradients, GAUSSIAN, 0.005, 2)))
    assert widths[1] == pytest.approx(widths[0], abs=1e-3)
    assert widths[2] != pytest.approx(widths[0], abs=1e-2)


@pytest.mark.parametrize("rises", [1, 2, 3])
def test_the_search_stops_once_the_cost_has_risen_so_many_times(rises):
    costs = width_costs(image_gradients(blurred("chart", 1.0, 0.002, size=96)), GAUSSIAN, 0.005, rises)
    lowest = int(np.argmin(costs))
    assert 0 < lowest == len(costs) - 1 - rises
    assert np.all(np.diff(costs[lowest:]) > 0)


def test_the_compiled_step_agrees_with_the_plain_one():
    rng = np.random.default_rng(0)
    arrays = [rng.uniform(0.5, 1.5, 999).astype(np.float32) for _ in range(6)]
    direction, residual = arrays[2], arrays[5]
    direction[:] = arrays[1] * residual
    decrease = np.array([np.vdot(residual, direction)], np.float32)
    results = []
    for step in (descend, descend.py_func):
        copies = [array.copy() for array in (arrays[0], arrays[3], arrays[1], direction, arrays[4], residual, decrease)]
        step(*copies)
        results.append(copies[3:])
    for compiled, plain in zip(*results, strict=True):
        assert compiled == pytest.approx(plain, rel=1e-4, abs=1e-5)

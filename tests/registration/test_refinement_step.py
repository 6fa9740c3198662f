"""Gauss–Newton steps against least squares and known motion."""

import cv2
import numpy as np
import pytest

from turbrestore.metrics import endpoint_error
from turbrestore.registration import refinement_step
from turbrestore.registration.refinement_step import flow_refinement, project_residual, step
from turbrestore.registration.warp import warp
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, smooth_flows

INSIDE = np.s_[12:-12, 12:-12]


def texture(side=64, seed=0):
    noise = np.random.default_rng(seed).standard_normal((side, side)).astype(np.float32)
    return np.clip(128 + 32 * 7 * cv2.GaussianBlur(noise, (0, 0), 2.0), 0, 255)


def to_8_bits(image):
    return np.rint(image).clip(0, 255).astype(np.uint8)


def affine_flow(side, matrix, shift):
    y, x = np.mgrid[:side, :side] - (side - 1) / 2
    return (np.stack([x, y], -1) @ np.array(matrix).T + shift).astype(np.float32)


@pytest.mark.parametrize(
    "truth",
    [
        affine_flow(96, [[0.01, -0.02], [0.015, 0.005]], (0.4, -0.3)),
        smooth_flows(1, 96, 96, np.random.default_rng(1), SmoothFlowParams(rms=0.5, correlation_length=10.0))[0],
    ],
    ids=["affine", "smooth"],
)
def test_known_motion_is_recovered(truth):
    frame = texture(96)
    found = flow_refinement(to_8_bits(warp(frame, truth)))(to_8_bits(frame), np.zeros_like(truth))
    assert endpoint_error(found[INSIDE], truth[INSIDE]) < 0.1


def test_one_step_is_least_squares_in_the_window(monkeypatch):
    monkeypatch.setattr(refinement_step, "_STEPS", 1)
    reference, frame = to_8_bits(texture(40)), to_8_bits(texture(40, 1) // 8 + texture(40) * 7 / 8)
    start = affine_flow(40, [[0.01, 0], [0, 0.01]], (0.3, 0.2))
    found = flow_refinement(reference)(frame, start)
    g = np.stack([cv2.Scharr(np.float64(reference), -1, *axis) / 32 for axis in ((1, 0), (0, 1))], -1)
    e = warp(frame.astype(np.float32), start, "linear") - reference.astype(np.float64)
    kernel = cv2.getGaussianKernel(round(8 * 3.0 + 1) | 1, 3.0).ravel()
    half = len(kernel) // 2
    for row, column in ((20, 20), (14, 25)):
        part = np.s_[row - half : row + half + 1, column - half : column + half + 1]
        weight = np.sqrt(np.outer(kernel, kernel)).ravel()[:, None]
        design = np.concatenate([weight * g[part].reshape(-1, 2), np.eye(2)])
        target = np.concatenate([-weight[:, 0] * e[part].ravel(), np.zeros(2)])
        delta = np.linalg.lstsq(design, target, rcond=None)[0]
        assert np.abs(delta).max() < 1
        assert found[row, column] - start[row, column] == pytest.approx(delta, abs=2e-3)


def test_no_step_is_longer_than_a_pixel_and_flat_images_make_none():
    reference = to_8_bits(texture(48))
    jump = flow_refinement(reference)(to_8_bits(np.roll(texture(48), 7, 1)), np.zeros((48, 48, 2), np.float32))
    assert 1 < np.abs(jump).max() <= 2
    flat, start = np.full((48, 48), 128, np.uint8), affine_flow(48, np.eye(2) / 50, (0, 0))
    assert np.array_equal(flow_refinement(flat)(reference, start), start)


def test_what_a_frame_does_not_show_stays_where_it_is():
    reference, start = to_8_bits(texture(48)), np.full((48, 48, 2), (30, 0), np.float32)
    found = flow_refinement(reference)(to_8_bits(texture(48, 3)), start)
    assert np.array_equal(found[:, 31:], start[:, 31:])
    assert not np.array_equal(found[:, :12], start[:, :12])


def test_the_start_is_not_overwritten():
    start = np.zeros((48, 48, 2), np.float32)
    flow_refinement(to_8_bits(texture(48)))(to_8_bits(np.roll(texture(48), 1, 0)), start)
    assert not start.any()


def test_compiled_loops_do_what_their_text_says():
    rng, shape = np.random.default_rng(0), (17, 23)
    frame, reference = rng.integers(0, 256, (2, *shape)).astype(np.uint8)
    planes = rng.standard_normal((5, *shape)).astype(np.float32)
    flow = rng.normal(0, 4, (*shape, 2)).astype(np.float32)
    ours, theirs = np.empty((2, *shape), np.float32), np.empty((2, *shape), np.float32)
    project_residual(frame, reference, planes[0], planes[1], flow, ours)
    project_residual.py_func(frame, reference, planes[0], planes[1], flow, theirs)
    assert ours == pytest.approx(theirs, rel=1e-4, abs=1e-3)
    assert (ours == 0).any()
    moved, expected = flow.copy(), flow.copy()
    step(*planes, moved)
    step.py_func(*planes, expected)
    assert moved == pytest.approx(expected, rel=1e-5, abs=1e-5)

"""Gauss–Newton steps against least squares and known motion."""

import cv2
import numpy as np
import pytest

from turbrestore.metrics import endpoint_error
from turbrestore.registration.flow_methods import refinement_step
from turbrestore.registration.flow_methods.refinement_step import flow_refinement, project_residual, step
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
    refine, still = flow_refinement(to_8_bits(warp(frame, truth))), np.zeros((48, 48, 2), np.float32)
    found = cv2.resize(refine(to_8_bits(frame), still), (96, 96))
    assert endpoint_error(found[INSIDE], truth[INSIDE]) < 0.1


def test_a_frame_that_is_sharper_than_the_reference_misleads_steps_less_than_plain_least_squares(monkeypatch):
    truth = smooth_flows(1, 96, 96, np.random.default_rng(1), SmoothFlowParams(rms=0.5, correlation_length=10.0))[0]
    frame, errors = texture(96), []
    blurred = to_8_bits(cv2.GaussianBlur(warp(frame, truth), (0, 0), 2.0))
    for left in (refinement_step._LEFT, 100.0):
        monkeypatch.setattr(refinement_step, "_LEFT", left)
        found = cv2.resize(flow_refinement(blurred)(to_8_bits(frame), cv2.resize(truth, (48, 48))), (96, 96))
        errors.append(endpoint_error(found[INSIDE], truth[INSIDE]))
    assert errors[0] < 0.5 * errors[1]


def test_one_step_is_least_squares_in_the_window(monkeypatch):
    monkeypatch.setattr(refinement_step, "_STEPS", 1)
    reference, frame = to_8_bits(texture(40)), to_8_bits(texture(40, 1) // 8 + texture(40) * 7 / 8)
    fine = affine_flow(40, [[0.01, 0], [0, 0.01]], (0.3, 0.2))
    start = cv2.resize(fine, (20, 20), interpolation=cv2.INTER_AREA)
    found = flow_refinement(reference)(frame, start)
    g = np.stack([cv2.Scharr(np.float64(reference), -1, *axis) / 32 for axis in ((1, 0), (0, 1))], -1)
    e = warp(frame.astype(np.float32), cv2.resize(start, (40, 40)), "linear") - reference.astype(np.float64)
    # Nothing leads out of the frame here, so that every residual counts.
    damping = np.square(e).mean() / (4 * np.pi * 3.0**2 * 0.2**2)
    kernel = cv2.getGaussianKernel(15, 1.5).ravel()
    for row, column in ((10, 10), (8, 12)):
        part = np.s_[2 * (row - 7) : 2 * (row + 8), 2 * (column - 7) : 2 * (column + 8)]
        weight = np.sqrt(np.outer(kernel, kernel).repeat(2, 0).repeat(2, 1) / 4).ravel()[:, None]
        design = np.concatenate([weight * g[part].reshape(-1, 2), np.sqrt(damping) * np.eye(2)])
        target = np.concatenate([-weight[:, 0] * e[part].ravel(), np.zeros(2)])
        delta = np.linalg.lstsq(design, target, rcond=None)[0]
        assert np.abs(delta).max() < 1
        assert found[row, column] - start[row, column] == pytest.approx(delta, abs=5e-3)


def test_no_step_is_longer_than_a_pixel_and_flat_images_make_none(monkeypatch):
    monkeypatch.setattr(refinement_step, "_LEFT", 100.0)
    reference = to_8_bits(texture(48))
    jump = flow_refinement(reference)(to_8_bits(np.roll(texture(48), 7, 1)), np.zeros((24, 24, 2), np.float32))
    assert 1 < np.abs(jump).max() <= 2
    flat, start = np.full((48, 48), 128, np.uint8), affine_flow(24, np.eye(2) / 50, (0, 0))
    assert np.array_equal(flow_refinement(flat)(reference, start), start)


def test_what_a_frame_does_not_show_stays_where_it_is():
    reference, start = to_8_bits(texture(48)), np.full((24, 24, 2), (30, 0), np.float32)
    found = flow_refinement(reference)(to_8_bits(texture(48, 3)), start)
    assert np.array_equal(found[:, 16:], start[:, 16:])
    assert not np.array_equal(found[:, :6], start[:, :6])


def test_images_may_have_odd_sides():
    frame = texture(65)[:, :51]
    found = flow_refinement(to_8_bits(frame))(to_8_bits(frame), np.full((33, 26, 2), 0.3, np.float32))
    assert found.shape == (33, 26, 2)
    assert np.abs(found[4:-4, 4:-4]).mean() < 0.05


def test_compiled_loops_do_what_their_text_says():
    rng, shape = np.random.default_rng(0), (17, 23)
    frame, reference = rng.integers(0, 256, (2, *shape)).astype(np.uint8)
    g_x, g_y = rng.standard_normal((2, *shape)).astype(np.float32)
    flow = rng.normal(0, 4, (*shape, 2)).astype(np.float32)
    flow[:2] = 40
    ours, theirs = ((np.empty((2, 9, 12), np.float32), np.empty(9, np.float32)) for _ in range(2))
    project_residual(frame, reference, g_x, g_y, flow, *ours)
    project_residual.py_func(frame, reference, g_x, g_y, flow, *theirs)
    for one, other in zip(ours, theirs, strict=True):
        assert one == pytest.approx(other, rel=1e-4, abs=1e-3)
    assert not ours[0][:, 0].any()
    planes = rng.standard_normal((5, 9, 12)).astype(np.float32)
    moved = rng.normal(0, 4, (9, 12, 2)).astype(np.float32)
    expected = moved.copy()
    step(*planes, np.float32(9), moved)
    step.py_func(*planes, np.float32(9), expected)
    assert moved == pytest.approx(expected, rel=1e-4, abs=1e-4)

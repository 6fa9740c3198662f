"""The scheme of paper 3 against its equations, written out with the matrices as they are printed."""

from dataclasses import replace

import numpy as np
import pytest

from conftest import make_sequence
from turbrestore.core.errors import DataError
from turbrestore.dynamics.dynamic_texture import DynamicsParams, identify
from turbrestore.filtering.alternating import filter_frames, filter_steps
from turbrestore.filtering.filter_records import FilterParams
from turbrestore.registration.centroid import CentroidParams, find_centroid
from turbrestore.registration.flow import FlowParams, estimate_flow
from turbrestore.registration.warp import warp
from turbrestore.runtime.steps import finish
from turbrestore.settings import PRESETS

# Farneback's method takes no start, so that every flow depends on its two images alone.
FLOW = FlowParams(method="farneback")
TRAIN, SIDE, Z = 8, 64, 1e-3


def printed_filter(frames, image, model, params, accumulate=False, flow=FLOW):
    """Eqs. 14 to 19 in the order of the remark of section 4, with full matrices; Σ, S and Z are numbers, as there.

    With ``accumulate`` each update starts from the last one, and the image is first updated by the predicted flow
    (step 2); without, from the prediction, and step 2 has no effect.
    """
    C, A, Q, mean = model.C.astype(float), model.A, model.Q, model.mean_flow.reshape(-1)
    R = max(model.R, 1e-6)
    rho, Sigma, xi, P = image.astype(float), Z / params.prior_frames, model.states[:, -1], R * np.eye(len(A))

    def update_image(rho, Sigma, frame, xi):
        registered = warp(frame, (mean + C @ xi).reshape(model.mean_flow.shape))
        gain = Sigma / (Sigma + Z)
        return rho + gain * (registered - rho), (1 - gain) * Sigma  # (16)

    def update_flow(xi, P, frame, rho):
        measured = estimate_flow(rho.astype(np.float32), frame[None], flow)[0].reshape(-1) - mean
        M = np.linalg.inv(C.T @ C / R + np.linalg.inv(P)) @ C.T / R  # (19)
        return xi + M @ (measured - C @ xi), (np.eye(len(A)) - M @ C) @ P

    for frame in frames:
        xi, P, Sigma = A @ xi, A @ P @ A.T + Q, Sigma + params.image_drift  # (14)
        before, latest = (rho, Sigma, xi, P), rho
        if accumulate:
            rho, Sigma = update_image(rho, Sigma, frame, xi)
        for _ in range(params.inner_iterations):
            if accumulate:
                xi, P = update_flow(xi, P, frame, rho)
                rho, Sigma = update_image(rho, Sigma, frame, xi)
            else:
                xi, P = update_flow(*before[2:], frame, latest)
                rho, Sigma = update_image(*before[:2], frame, xi)
                latest = rho
    return rho, Sigma, xi, P


@pytest.fixture(scope="module")
def trained():
    sequence = make_sequence(seed=11, count=TRAIN + 40, size=SIDE, rms=0.8, persistence=0.8)
    centroid = find_centroid(sequence.frames[:TRAIN], CentroidParams(mode="single", iterations=3), FLOW)
    return sequence, centroid, identify(centroid.flows, DynamicsParams(rank=3))


@pytest.mark.parametrize(("count", "tolerance"), [(1, 1e-6), (40, 1e-3)])
@pytest.mark.parametrize("drift", [0.0, 1e-5])
def test_the_preset_is_the_printed_scheme(trained, count, tolerance, drift):
    sequence, centroid, model = trained
    params = replace(PRESETS["paper"].filter, image_noise=Z, image_drift=drift)
    frames = sequence.frames[: TRAIN + count]
    filtered = filter_frames(frames, centroid.image, model, params, FLOW, centroid.flows)
    rho, Sigma, xi, _ = printed_filter(frames[TRAIN:], centroid.image, model, params)
    assert np.abs(filtered.image - rho).max() < tolerance
    assert np.allclose(filtered.variance, Sigma, rtol=1e-4)
    assert np.allclose(filtered.flow_states[-1], xi, rtol=1e-3, atol=1e-2 * tolerance**0.5)
    assert not filtered.mean_flow.any()


def test_only_updates_that_accumulate_converge_to_the_frame(trained):
    """The paper warns of that: by its remark each update starts from the last one.  Here a frame counts once."""
    sequence, centroid, model = trained
    params = replace(PRESETS["paper"].filter, inner_iterations=12)
    frame = sequence.frames[TRAIN]
    distance = {}
    for accumulate in (False, True):
        rho, _, xi, _ = printed_filter(frame[None], centroid.image, model, params, accumulate)
        registered = warp(frame, model.mean_flow + (model.C @ xi.astype(np.float32)).reshape(SIDE, SIDE, 2))
        distance[accumulate] = np.abs(rho - registered).mean() / np.abs(centroid.image - registered).mean()
    assert distance[True] < 0.15
    assert distance[False] == pytest.approx(0.5, abs=0.05)


def test_joined_blocks_are_not_the_printed_scheme(trained):
    """Larger blocks measure flow from other images, by more than the tolerance above."""
    sequence, centroid, model = trained
    params = replace(PRESETS["paper"].filter, image_noise=Z)
    rho, *_ = printed_filter(sequence.frames[TRAIN:], centroid.image, model, params)
    blocks = replace(params, block=8)
    filtered = filter_frames(sequence.frames, centroid.image, model, blocks, FLOW, centroid.flows)
    assert np.abs(filtered.image - rho).max() > 1e-3


def test_training_frames_are_skipped_and_recorded(trained):
    sequence, centroid, model = trained
    params = FilterParams(training="skip", prior_frames=1.0)
    filtered = filter_frames(sequence.frames[: TRAIN + 3], centroid.image, model, params, FLOW, centroid.flows)
    assert np.isnan(filtered.sharpness[:TRAIN]).all()
    assert np.isfinite(filtered.sharpness[TRAIN:]).all()
    assert filtered.shares[:TRAIN].sum() == 0
    assert filtered.shares.sum() == pytest.approx(1)
    assert np.array_equal(filtered.flow_states[:TRAIN], model.states.T)


@pytest.mark.parametrize("block", [1, 4])
def test_a_resumed_run_is_that_of_one_run(trained, block):
    sequence, centroid, model = trained
    frames = sequence.frames[: TRAIN + 9]
    params = FilterParams(training="skip", prior_frames=1.0, block=block)
    whole = filter_frames(frames, centroid.image, model, params, FLOW, centroid.flows)
    steps = list(filter_steps(frames, centroid.image, model, params, FLOW, centroid.flows))
    assert steps[-1].flows_measured == 2 * len(frames) - TRAIN
    start = next(step.checkpoint for step in steps if step.checkpoint is not None)
    rest = filter_steps(frames, centroid.image, model, params, FLOW, centroid.flows, start=start)
    assert np.array_equal(finish(rest).image, whole.image)


def test_nothing_to_filter_after_the_training_is_refused(trained):
    sequence, centroid, model = trained
    params = FilterParams(training="skip")
    with pytest.raises(DataError, match="at least one after those with known flows, found none"):
        filter_frames(sequence.frames[:TRAIN], centroid.image, model, params, FLOW, centroid.flows)
    with pytest.raises(DataError, match="8 flows that the dynamics were identified from, found 4"):
        filter_frames(sequence.frames, centroid.image, model, params, FLOW, centroid.flows[:4])

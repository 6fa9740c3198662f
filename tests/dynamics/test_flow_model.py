from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from flow_systems import rotating_flows

from turbrestore.core.errors import DataError
from turbrestore.dynamics.dynamic_texture import DynamicsParams, identify
from turbrestore.dynamics.flow_model import (
    SUMMED,
    add_products,
    flow_of,
    mean_flow_error,
    predict_flow,
    project_deviation,
)
from turbrestore.dynamics.simulate import simulate, stable_system
from turbrestore.runtime.scratch import drop_pages, new_stack

STATM = Path("/proc/self/statm")


def test_full_rank_reconstructs_the_flows(noise_flows):
    dynamics = identify(noise_flows, DynamicsParams(rank=19))
    assert dynamics.rank == 19
    for k, flow in enumerate(noise_flows):
        np.testing.assert_allclose(flow_of(dynamics, dynamics.states[:, k]), flow, atol=2e-6)
        np.testing.assert_allclose(
            project_deviation(dynamics, flow - dynamics.mean_flow), dynamics.states[:, k], atol=1e-5
        )
    assert pytest.approx(0.0, abs=1e-10) == dynamics.R
    assert dynamics.energy_share == pytest.approx(1.0)


def test_inputs_are_left_alone(noise_flows):
    before = noise_flows.copy()
    dynamics = identify(noise_flows, DynamicsParams(rank=3))
    project_deviation(dynamics, noise_flows[0])
    np.testing.assert_array_equal(noise_flows, before)
    state = np.ones(3)
    A = dynamics.A.copy()
    predict_flow(dynamics, state)
    stable_system(dynamics, 0.5)
    simulate(dynamics, 3, np.random.default_rng(0), initial=state)
    np.testing.assert_array_equal(state, 1.0)
    np.testing.assert_array_equal(dynamics.A, A)


def test_unusable_states_are_a_clear_error(rng):
    dynamics = identify(rotating_flows())
    for call, words in (
        (lambda: flow_of(dynamics, np.zeros(3)), "state: expected shape"),
        (lambda: predict_flow(dynamics, [np.nan, 0.0]), "state: expected finite"),
        (lambda: simulate(dynamics, 3, rng, initial=np.zeros((2, 1))), "state: expected shape"),
    ):
        with pytest.raises(DataError, match=words):
            call()


@pytest.mark.parametrize("rank", [0, 5, 19])
def test_flow_variance_is_that_of_the_flows_whatever_the_rank(noise_flows, rank):
    found = identify(noise_flows, DynamicsParams(rank=rank)).flow_variance
    np.testing.assert_allclose(found, noise_flows.var(axis=0, ddof=1).mean(axis=-1), rtol=1e-4)


def test_a_state_is_the_same_from_a_file_and_piece_by_piece(rng, tmp_path, monkeypatch):
    flows = rng.normal(size=(20, 60, 70, 2)).astype(np.float32)
    whole = identify(flows, DynamicsParams(rank=7))
    mapped = new_stack(whole.C.shape[::-1], tmp_path).T
    mapped[:] = whole.C
    deviation = flows[3] - whole.mean_flow
    at_once = project_deviation(whole, deviation)
    monkeypatch.setattr("turbrestore.dynamics.flow_model.PART", 70)
    kept, filed = (project_deviation(model, deviation) for model in (whole, replace(whole, C=mapped)))
    np.testing.assert_array_equal(kept, filed)
    np.testing.assert_allclose(kept, at_once, atol=1e-5)


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("shape", [(2, 3), (16, SUMMED // 32), (31, 45)])
@pytest.mark.parametrize("rank", [0, 1, 7])
def test_a_flow_is_projected_as_the_plain_loop_does(rng, shape, rank, order):
    """On fewer products than are summed at once, on as many, and on more; modes in rows and in columns."""
    size = 2 * shape[0] * shape[1]
    modes = np.asarray(rng.normal(0, size**-0.5, (size, rank)), np.float32, order)
    dynamics = replace(identify(np.zeros((3, *shape, 2))), C=modes)
    flow, plain = rng.normal(0, 2, (*shape, 2)).astype(np.float32), np.zeros(rank)
    add_products.py_func(modes.T, flow.reshape(-1), 0, size, plain)
    found = project_deviation(dynamics, flow)
    assert found.dtype == np.float64
    assert found == pytest.approx(plain, abs=1e-4)
    assert found == pytest.approx(flow.reshape(-1).astype(np.float64) @ modes.astype(np.float64), abs=1e-4)


# This folder is tested on macOS and Windows too, and only Linux tells which pages of a mapped file are in memory.
@pytest.mark.skipif(not STATM.exists(), reason="memory is read from /proc")
@pytest.mark.parametrize(("count", "shape"), [(80, (256, 512)), (2, (2048, 2560))])
def test_a_state_takes_a_piece_of_the_modes_at_a_time(tmp_path, count, shape):
    modes = new_stack((count, 2 * shape[0] * shape[1]), tmp_path).T
    modes[:] = 1e-3
    drop_pages(modes)
    dynamics = replace(identify(np.zeros((3, 2, 2, 2))), C=modes)
    deviation = np.ones((*shape, 2), np.float32)
    before = resident()
    state = project_deviation(dynamics, deviation)
    # All of them are 84 MB.
    assert resident() - before < 40e6
    assert state == pytest.approx(np.full(count, 1e-3 * deviation.size), rel=1e-4)


def resident() -> int:
    """Bytes of this process that are in memory."""
    return int(STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def test_the_error_of_the_mean_flow_is_that_of_its_spread_over_many_clips(rng):
    """One state that is remembered from frame to frame, and the mean of each clip."""
    mode, count, memory = rng.standard_normal((4, 4, 2)), 60, 0.7
    mode /= np.sqrt((mode**2).sum(axis=-1).mean())

    def clip():
        state, flows = rng.standard_normal(), []
        for _ in range(count):
            state = memory * state + np.sqrt(1 - memory**2) * rng.standard_normal()
            flows.append(state * mode)
        return np.array(flows, np.float32)

    clips = [clip() for _ in range(200)]
    spread = np.sqrt(np.mean([(flows.mean(axis=0) ** 2).sum(axis=-1).mean() for flows in clips]))
    errors = [mean_flow_error(identify(flows, DynamicsParams(rank=1)), count) for flows in clips]
    assert np.median(errors) == pytest.approx(spread, rel=0.15)

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from torch_devices import NO_TORCH

from turbrestore.core.errors import ConfigurationError, DataError
from turbrestore.registration.flow_methods.tvl1 import TvL1Params, prepare_tvl1, tvl1_flows
from turbrestore.registration.flow_methods.tvl1_sweeps import (
    FlowProblem,
    SweepParams,
    add_differences,
    divergence,
    resize_dual,
    sweep,
    sweep_frame,
)
from turbrestore.registration.warp import warp
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, smooth_flows

SIZE = 96
DEVICES = ["cpu", pytest.param("cpu:0", marks=NO_TORCH)]
INNER = slice(8, -8)


def texture(seed=0, size=SIZE):
    """Grey levels with 32 to a standard deviation."""
    rng = np.random.default_rng(seed)
    return 128 + smooth_flows(1, size, size, rng, SmoothFlowParams(rms=32.0, correlation_length=2.0))[0, ..., 0]


def pairs(count, rms=1.5, seed=0, noise=0.5):
    """A reference, frames, and the flows to them; frames differ in what they show."""
    rng = np.random.default_rng(seed)
    flows = smooth_flows(count, SIZE, SIZE, rng, SmoothFlowParams(rms=rms, persistence=0.5))
    reference = texture(seed)
    # The frame is sampled by the inverse to first order, and the truth is measured against it.
    frames = np.stack([warp(reference, -flow) for flow in flows])
    return reference, frames + rng.normal(0, noise, frames.shape).astype(np.float32), flows


def problem_of(seed, shape=(9, 11), count=1):
    """Random data term, flow and admissible dual variable."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, 2 * np.pi, (count, *shape))
    direction = np.stack([np.cos(angle), np.sin(angle)], 1)
    problem = FlowProblem(direction, rng.normal(0, 2, (count, *shape)), rng.uniform(0, 3, (count, *shape)))
    return problem, rng.normal(0, 1, (count, 2, *shape)), np.zeros((count, 2, 2, *shape))


def energy(problem, flow, huber):
    """Σ λ|ρ| + h_α(∇u), with differences taken by hand."""
    data = problem.bound * np.abs(problem.offset + (problem.direction * flow).sum(1))
    dx = np.diff(flow, axis=-1, append=flow[..., -1:])
    dy = np.diff(flow, axis=-2, append=flow[..., -1:, :])
    length = np.sqrt(dx**2 + dy**2)
    return data.sum() + np.where(length <= huber, length**2 / (2 * huber), length - huber / 2).sum()


both_ways = pytest.mark.parametrize("way", ["loop", pytest.param("torch", marks=NO_TORCH)])


def sweep_by(way, problem, flow, dual, params):
    """Sweep by the compiled loop, or by torch."""
    if way == "loop":
        return sweep(problem, flow, dual, params)
    import torch

    problem = FlowProblem(*map(torch.from_numpy, (problem.direction, problem.offset, problem.bound)))
    return sweep(problem, torch.from_numpy(flow), torch.from_numpy(dual), params).numpy()


class TestSweeps:
    @pytest.mark.parametrize("shape", [(1, 1), (1, 7), (6, 1), (8, 13)])
    def test_divergence_is_the_negative_adjoint_of_the_differences(self, shape):
        rng = np.random.default_rng(1)
        u, px, py = rng.standard_normal((3, *shape))
        px[:, -1] = py[-1] = 0
        gx, gy, out = np.zeros(shape), np.zeros(shape), np.empty(shape)
        add_differences(u, gx, gy)
        divergence(px, py, out)
        assert (gx * px + gy * py).sum() == pytest.approx(-(u * out).sum(), abs=1e-12)

    def test_step_sizes_respect_the_norm_of_the_gradient(self):
        # The largest eigenvalue of −div ∇ tends to 8 from below.
        u, out = np.random.default_rng(0).standard_normal((40, 40)), np.empty((40, 40))
        for _ in range(200):
            gx, gy = np.zeros_like(u), np.zeros_like(u)
            add_differences(u / np.linalg.norm(u), gx, gy)
            divergence(gx, gy, out)
            u = -out
        params = SweepParams(1, 0.7, 0.3)
        assert 0.97 < params.step * params.dual_step * np.linalg.norm(u) < 1

    @both_ways
    @given(st.floats(0, 6.28), st.floats(-5, 5), st.floats(0, 4), st.floats(0.1, 2), st.floats(-3, 3), st.floats(-3, 3))
    @settings(max_examples=60, deadline=None)
    def test_primal_step_is_the_proximal_map(self, way, angle, offset, bound, step, a, b):
        direction = np.array([np.cos(angle), np.sin(angle)])
        one = np.ones((1, 1, 1))
        problem = FlowProblem(direction[None, :, None, None], offset * one, bound * one)
        start = np.array([a, b])
        # A single pixel has no differences: the sweep is the proximal map alone.
        dual, params = np.zeros((1, 2, 2, 1, 1)), SweepParams(1, step, 0)
        found = sweep_by(way, problem, start[None, :, None, None].copy(), dual, params)

        def objective(v):
            return bound * np.abs(offset + v @ direction) + ((v - start) ** 2).sum(-1) / (2 * step)

        # Off the gradient only the distance counts, so the minimum lies on it.
        along = np.linspace(-step * bound, step * bound, 2001)[:, None]
        best = objective(start - along * direction).min()
        assert objective(found[0, :, 0, 0]) <= best + 1e-12

    @both_ways
    def test_sweeps_do_what_plain_loops_do(self, way):
        problem, flow, dual = problem_of(2)
        params = SweepParams(7, 0.6, 0.2)
        slow_flow, slow_dual = slow_sweeps(problem, flow[0], dual[0], params)
        found = sweep_by(way, problem, flow.copy(), dual, params)
        assert np.abs(found[0] - slow_flow).max() < 1e-12
        assert np.abs(dual[0] - slow_dual).max() < 1e-12

    @pytest.mark.parametrize("huber", [0.0, 0.3])
    @pytest.mark.parametrize("shape", [(1, 1), (1, 7), (9, 1), (2, 2), (31, 45)])
    def test_the_compiled_loop_does_what_it_says(self, shape, huber):
        """From any dual variable that vanishes across the border."""
        rng = np.random.default_rng(23)
        angle, offset, bound = rng.uniform(0, 6, (3, *shape)).astype(np.float32)
        direction = np.stack([np.cos(angle), np.sin(angle)])
        start, dual = (
            rng.normal(0, s, size).astype(np.float32) for s, size in ((1, (2, *shape)), (0.5, (2, 2, *shape)))
        )
        dual[0, :, :, -1] = dual[1, :, -1, :] = 0
        params = SweepParams(15, 0.7, huber)
        steps = np.array([params.step, params.dual_step, params.shrink, params.count], np.float32)
        results = []
        for loop in (sweep_frame, sweep_frame.py_func):
            flow, p = start.copy(), dual.copy()
            loop(direction, 2 * offset - 6, bound / 3, flow, flow.copy(), p, steps)
            results.append((flow, p))
        for fast, slow in zip(*results, strict=True):
            assert fast.dtype == slow.dtype == np.float32
            assert fast == pytest.approx(slow, abs=2e-5)
        assert np.abs(results[0][0] - start).max() > 0.1

    @both_ways
    def test_dual_variable_stays_admissible(self, way):
        problem, flow, dual = problem_of(3)
        sweep_by(way, problem, flow, dual, SweepParams(20, 0.7, 0.1))
        assert np.hypot(dual[:, 0], dual[:, 1]).max() <= 1 + 1e-12
        assert not dual[:, 0, :, :, -1].any()
        assert not dual[:, 1, :, -1, :].any()

    def test_dual_variable_on_another_grid_moves_nothing_across_the_border(self):
        dual = np.random.default_rng(5).uniform(-0.7, 0.7, (1, 2, 2, 8, 9)).astype(np.float32)
        finer = resize_dual(dual, (15, 18))
        out = np.empty((1, 2, 15, 18), np.float32)
        divergence(finer[:, 0], finer[:, 1], out)
        assert np.abs(out.sum((-1, -2))).max() < 1e-4
        assert np.hypot(finer[:, 0], finer[:, 1]).max() < 1

    @both_ways
    def test_energy_falls_to_the_minimum(self, way):
        problem, flow, _ = problem_of(4, (7, 8))
        huber = 0.3
        energies = []
        for count in (0, 10, 40, 160, 3000):
            u, p = flow.copy(), np.zeros((1, 2, 2, 7, 8))
            energies.append(energy(problem, sweep_by(way, problem, u, p, SweepParams(count, 0.7, huber)), huber))
        assert all(a > b for a, b in pairwise(energies))

        def smoothed(values):
            """Energy with |ρ| rounded off within 1e-4, and its gradient."""
            u = values.reshape(flow.shape)
            rho = problem.offset + (problem.direction * u).sum(1)
            rounded = np.sqrt(rho**2 + 1e-8)
            p, div = np.zeros((2, *u.shape)), np.empty_like(u)
            add_differences(u, *p)
            divergence(*(p / np.maximum(np.hypot(*p), huber)), div)
            slope = (problem.bound * rho / rounded)[:, None] * problem.direction - div
            return energy(problem, u, huber) + (problem.bound * (rounded - np.abs(rho))).sum(), slope.ravel()

        other = minimize(smoothed, flow.ravel(), jac=True, method="L-BFGS-B", options={"maxiter": 20_000})
        assert energies[-1] <= other.fun
        assert energies[-1] == pytest.approx(other.fun, rel=5e-3)


def slow_sweeps(problem, u, p, params):
    """The two steps of a sweep, pixel by pixel."""
    (_, height, width), u, p = u.shape, u.copy(), p.copy()
    ahead = u.copy()
    pixels = [(i, j) for i in range(height) for j in range(width)]
    for _ in range(params.count):
        for k in range(2):
            for i, j in pixels:
                x = ahead[k, i, j + 1] - ahead[k, i, j] if j + 1 < width else 0.0
                y = ahead[k, i + 1, j] - ahead[k, i, j] if i + 1 < height else 0.0
                q = (p[:, k, i, j] + params.dual_step * np.array([x, y])) / (1 + params.dual_step * params.huber)
                p[:, k, i, j] = q / max(1.0, np.hypot(*q))
        before = u.copy()
        for i, j in pixels:
            v = before[:, i, j].copy()
            for k in range(2):
                v[k] += params.step * (p[0, k, i, j] - (p[0, k, i, j - 1] if j else 0))
                v[k] += params.step * (p[1, k, i, j] - (p[1, k, i - 1, j] if i else 0))
            d = problem.direction[0, :, i, j]
            most = params.step * problem.bound[0, i, j]
            u[:, i, j] = v - np.clip(problem.offset[0, i, j] + d @ v, -most, most) * d
        ahead = 2 * u - before
    return u, p


def median_length(flow):
    return float(np.median(np.linalg.norm(flow, axis=-1)))


class TestMotion:
    @pytest.mark.parametrize("shift", [(0.3, -0.2), (2.5, 1.0), (-6.0, 4.0)])
    def test_constant_motion(self, shift):
        flow = np.full((SIZE, SIZE, 2), shift, np.float32)
        frame = texture(3)
        params = TvL1Params(tolerance=0.01, warps=10)
        found = tvl1_flows(frame[None], prepare_tvl1(warp(frame, flow), params)).flows[0]
        assert np.abs(found - flow)[12:-12, 12:-12].max() < 0.01

    @pytest.mark.parametrize("matrix", [((0.02, 0), (0, 0.02)), ((0, -0.03), (0.03, 0)), ((0, 0.02), (0, 0))])
    def test_affine_motion(self, matrix):
        grid = np.stack(np.mgrid[:SIZE, :SIZE][::-1], -1) - (SIZE - 1) / 2
        flow = (grid @ np.transpose(matrix) + 0.5).astype(np.float32)
        frame = texture(4)
        # Smoothness is at odds with any gradient of the flow: little of it here.
        params = TvL1Params(attachment=0.5, huber=1.0)
        found = tvl1_flows(frame[None], prepare_tvl1(warp(frame, flow), params)).flows[0]
        error = np.linalg.norm(found - flow, axis=-1)[INNER, INNER]
        assert error.mean() < 0.03
        assert error.max() < 0.15

    def test_smooth_motion_is_followed_better_than_by_total_variation(self):
        frame, truth = texture(5), smooth_flows(1, SIZE, SIZE, np.random.default_rng(5))[0]
        errors = [
            np.linalg.norm(
                tvl1_flows(frame[None], prepare_tvl1(warp(frame, truth), TvL1Params(huber=h))).flows[0] - truth, axis=-1
            )[INNER, INNER].mean()
            for h in (0.3, 0.0)
        ]
        assert errors[0] < 0.8 * errors[1]
        assert errors[0] < 0.1

    def test_outliers_are_forgiven(self):
        frame, truth = texture(6), smooth_flows(1, SIZE, SIZE, np.random.default_rng(6), SmoothFlowParams(rms=1.0))[0]
        reference = warp(frame, truth)
        spoilt = frame.copy()
        rng = np.random.default_rng(0)
        spoilt[tuple(rng.integers(0, SIZE, (2, 200)))] = 255
        found = tvl1_flows(spoilt[None], prepare_tvl1(reference)).flows[0]
        assert np.median(np.linalg.norm(found - truth, axis=-1)) < 0.1

    def test_beyond_the_frame_there_is_no_data(self):
        flow = np.full((SIZE, SIZE, 2), (9.0, 0.0), np.float32)
        scene = texture(7, 128)
        found = tvl1_flows(scene[None, :96, 7:103], prepare_tvl1(scene[:96, 16:112])).flows[0]
        # The last nine columns of the reference are not in the frame and move with their neighbours.
        assert np.abs(found - flow)[12:-12, 4:].max() < 0.5


class TestEnd:
    def test_settled_flow_is_near_that_of_many_iterations(self):
        reference, frames, _ = pairs(2, seed=9, noise=8)
        found = tvl1_flows(frames, prepare_tvl1(reference))
        params = TvL1Params(warps=15, sweeps=60, tolerance=0)
        long = tvl1_flows(frames, prepare_tvl1(reference, params))
        assert found.settled.all()
        assert (found.warps < TvL1Params().warps).all()
        assert not long.settled.any()
        assert (long.warps == 15).all()
        distances = [median_length(a - b) for a, b in zip(found.flows, long.flows, strict=True)]
        assert max(distances) < 0.5 * TvL1Params().tolerance

    def test_smaller_tolerance_comes_nearer(self):
        reference, frames, _ = pairs(1, seed=10, rms=2.5, noise=4)
        ends = [
            tvl1_flows(frames, prepare_tvl1(reference, TvL1Params(warps=40, sweeps=5, tolerance=t)))
            for t in (0.5, 0.1, 0.02, 0.0)
        ]
        distances = [median_length(end.flows - ends[-1].flows) for end in ends]
        assert distances[0] > distances[1] > distances[2]
        assert distances[2] < 0.05
        assert ends[0].warps[0] < ends[1].warps[0] < ends[2].warps[0] < 40

    def test_any_start_ends_in_the_same_flow(self):
        reference, frames, truth = pairs(2, seed=11)
        params = TvL1Params(warps=20, tolerance=0.01)
        cold = tvl1_flows(frames, prepare_tvl1(reference, params)).flows
        for levels, start in ((5, truth), (5, np.zeros_like(truth) + 1), (2, truth * 0.8)):
            warm = tvl1_flows(frames, prepare_tvl1(reference, params), start, levels)
            assert median_length(warm.flows - cold) < 0.02

    def test_good_start_replaces_the_pyramid(self):
        frame, flow = texture(12), np.full((SIZE, SIZE, 2), (8.0, -5.0), np.float32)
        referred = prepare_tvl1(warp(frame, flow))
        cold = tvl1_flows(frame[None], referred, levels=1)
        warm = tvl1_flows(frame[None], referred, flow[None] + 0.4, levels=1)
        assert median_length((cold.flows[0] - flow)[12:-12, 12:-12]) > 2
        assert median_length((warm.flows[0] - flow)[12:-12, 12:-12]) < 0.05
        assert warm.settled.all()

    @pytest.mark.parametrize("levels", [1, 2, 9])
    def test_levels_left_out_are_those_of_a_smaller_pyramid(self, levels):
        reference, frames, truth = pairs(2, seed=12)
        fewer = tvl1_flows(frames, prepare_tvl1(reference), truth, levels).flows
        small = tvl1_flows(frames, prepare_tvl1(reference, TvL1Params(levels=levels)), truth).flows
        assert fewer.tobytes() == small.tobytes()

    def test_no_level_is_refused(self):
        reference, frames, _ = pairs(1)
        with pytest.raises(ConfigurationError, match="^levels: expected"):
            tvl1_flows(frames, prepare_tvl1(reference), levels=0)


class TestManyToOne:
    @pytest.mark.parametrize("device", DEVICES)
    def test_flow_of_a_frame_does_not_depend_on_the_batch(self, device):
        reference, frames, _ = pairs(4, seed=13, rms=2.5, noise=16)
        frames[1] = reference
        referred = prepare_tvl1(reference, device=device)
        together = tvl1_flows(frames, referred)
        alone = [tvl1_flows(frame[None], referred) for frame in frames]
        assert np.abs(together.flows - np.concatenate([one.flows for one in alone])).max() < 0.01
        assert together.warps.tolist() == [int(one.warps[0]) for one in alone]
        # Frames of a batch settle one by one.
        assert len(set(together.warps)) > 1

    @pytest.mark.parametrize("device", DEVICES)
    def test_nothing_that_is_handed_in_changes(self, device):
        reference, frames, start = pairs(2, seed=16)
        copies = reference.copy(), frames.copy(), start.copy()
        for levels in (1, 3):
            referred = prepare_tvl1(reference, TvL1Params(levels=levels), device)
            first = tvl1_flows(frames, referred, start).flows
            assert (tvl1_flows(frames, referred, start).flows == first).all()
        assert all((a == b).all() for a, b in zip(copies, (reference, frames, start), strict=True))


def test_colour_is_measured_on_luminance():
    reference, frames, _ = pairs(1, seed=17)
    grey = tvl1_flows(frames, prepare_tvl1(reference)).flows
    colour = tvl1_flows(np.repeat(frames[..., None], 3, 3), prepare_tvl1(np.repeat(reference[..., None], 3, 2))).flows
    assert np.abs(grey - colour).max() < 0.02


@pytest.mark.parametrize("size", [(16, 16), (17, 61)])
def test_small_images(size):
    image = texture()[: size[0], : size[1]]
    found = tvl1_flows(image[None], prepare_tvl1(image))
    assert found.flows.shape == (1, *size, 2)
    assert np.abs(found.flows).max() < 1e-4


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda: prepare_tvl1(np.zeros((15, 40))), "reference: expected at least 16×16 pixels, found 40×15"),
        (lambda: tvl1_flows(np.zeros((2, 20, 20)), prepare_tvl1(np.zeros((20, 21)))), r"frames: expected \(20, 21\)"),
        (
            lambda: tvl1_flows(np.zeros((2, 20, 20)), prepare_tvl1(np.zeros((20, 20))), np.zeros((1, 20, 20, 2))),
            r"start: expected shape \(2, 20, 20, 2\)",
        ),
    ],
)
def test_shapes_that_do_not_agree(act, message):
    with pytest.raises(DataError, match=f"^{message}"):
        act()

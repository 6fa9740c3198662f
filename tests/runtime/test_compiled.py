"""Compiled loops against the operations of NumPy and OpenCV that stand in for them, and life without a compiler."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from turbrestore.core.errors import DataError
from turbrestore.dynamics.dynamic_texture import identify
from turbrestore.dynamics.flow_model import SUMMED, add_products, project_deviation
from turbrestore.filtering.frame_noise import _folded, judge_frame, mark_folds, measure_frame_noise, weigh_pixels
from turbrestore.filtering.kalman import PixelGaussian
from turbrestore.filtering.pixel_fusion import PixelFusion, take_in_pixels
from turbrestore.registration.confidence import draw_pixels, flow_confidence, lower_pixels, regularise_flow
from turbrestore.registration.tvl1_sweeps import FlowProblem, SweepParams, sweep, sweep_frame
from turbrestore.registration.warp import sample_spline, warp
from turbrestore.runtime import jit as compiling

USERS = (
    "filtering.frame_noise",
    "filtering.pixel_fusion",
    "registration.warp",
    "registration.confidence",
    "dynamics.flow_model",
    "registration.tvl1_sweeps",
)
rng = np.random.default_rng(0)
needs_compiler = pytest.mark.skipif(not compiling.can_compile(), reason="Numba is not installed: nothing to compare")


@pytest.fixture
def plain(monkeypatch):
    """Call a function as where Numba is not installed."""

    def call(function):
        with monkeypatch.context() as patch:
            for user in USERS:
                patch.setattr(f"turbrestore.{user}.compiled", lambda loops: None)
            return function()

    return call


def both(plain, function):
    return function(), plain(function)


@needs_compiler
@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (2, 2), (9, 1), (31, 45), (12, 20, 3)])
def test_a_spline_is_sampled_alike(plain, shape):
    image = rng.random(shape, np.float32)
    flow = rng.normal(0, 3, (*shape[:2], 2)).astype(np.float32)
    fast, slow = both(plain, lambda: warp(image, flow))
    assert fast.dtype == slow.dtype == np.float32
    assert fast == pytest.approx(slow, abs=2e-5)


def model_of(frames, flows):
    image = frames.mean(axis=0)
    return measure_frame_noise(list(frames), flows, image, np.ones(image.shape, np.float32))


@needs_compiler
@pytest.mark.parametrize("amplitude", [0.0, 0.5, 6.0])
def test_a_frame_is_judged_alike(plain, amplitude):
    """With no motion, with little, and with maps that fold and leave the frame."""
    frames = rng.random((6, 40, 50), np.float32)
    frames[2, 10:20, 10:20] += 3
    flows = (amplitude * rng.normal(size=(6, 40, 50, 2))).astype(np.float32)
    model = model_of(frames, np.zeros_like(flows))
    for frame, flow in zip(frames, flows, strict=True):
        (fast, sharp), (slow, plainly) = both(plain, lambda f=frame, w=flow: judge_frame(f, w, model, 2.0))
        assert np.log(fast) == pytest.approx(np.log(slow), abs=1e-3)
        assert sharp == plainly


@needs_compiler
@pytest.mark.parametrize("contrast", [0.0, 0.01, 0.5])
@pytest.mark.parametrize("shape", [(16, 16), (33, 50)])
def test_a_flow_is_drawn_alike(plain, shape, contrast):
    """Without texture, with little, and with much; edges among it, whose tensors have no inverse."""
    random = np.random.default_rng(21)
    image = 0.5 + contrast * random.uniform(-1, 1, shape).astype(np.float32)
    image[:, shape[1] // 2 :] = 0.5
    image[:, -5:] += np.float32(contrast)
    flow, confidence = random.normal(0, 2, (*shape, 2)).astype(np.float32), flow_confidence(image)
    tensors = [tensor.copy() for tensor in confidence.tensors]
    for noise in (0.0, 0.02):
        fast, slow = both(plain, lambda n=noise: regularise_flow(flow, confidence, n))
        assert fast.dtype == slow.dtype == np.float32
        assert fast == pytest.approx(slow, abs=2e-4)
        assert np.abs(fast - slow).mean() < 1e-5
        assert (np.abs(slow).max() > 0.01) == (contrast > 0)
    # Threads share them.
    assert all(map(np.array_equal, confidence.tensors, tensors))


@needs_compiler
@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("shape", [(16, 16), (33, 50)])
def test_tensors_are_lowered_alike(plain, shape, noise):
    """Of flat ground, whose tensors vanish, of an edge, which has one eigenvalue, and of noise, which has two."""
    random = np.random.default_rng(24)
    image = np.full(shape, 0.5, np.float32)
    image[:, shape[1] // 2 :] += random.normal(0, noise, (shape[0], shape[1] - shape[1] // 2)).astype(np.float32)
    image[:, -5:] += 0.3
    fast, slow = both(plain, lambda: flow_confidence(image).tensors)
    for one, other in zip(fast, slow, strict=True):
        assert one.dtype == other.dtype == np.float32
        assert one == pytest.approx(other, rel=1e-4, abs=1e-6 * float(np.abs(slow[0]).max()))
    assert np.ptp(slow[0][0]) > 1e-3


@needs_compiler
@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("shape", [(2, 3), (16, SUMMED // 32), (31, 45)])
@pytest.mark.parametrize("rank", [0, 1, 7])
def test_a_flow_is_projected_alike(plain, shape, rank, order):
    """On fewer products than are summed at once, on as many, and on more; modes in rows and in columns."""
    random, size = np.random.default_rng(22), 2 * shape[0] * shape[1]
    modes = np.asarray(random.normal(0, size**-0.5, (size, rank)), np.float32, order)
    dynamics = replace(identify(np.zeros((3, *shape, 2))), C=modes)
    flow = random.normal(0, 2, (*shape, 2)).astype(np.float32)
    fast, slow = both(plain, lambda: project_deviation(dynamics, flow))
    exact = flow.reshape(-1).astype(np.float64) @ modes.astype(np.float64)
    assert fast.dtype == slow.dtype == np.float64
    assert fast == pytest.approx(exact, abs=1e-4)
    assert slow == pytest.approx(exact, abs=1e-4)


@needs_compiler
@pytest.mark.parametrize("huber", [0.0, 0.3])
@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (9, 1), (2, 2), (31, 45)])
def test_flows_are_swept_alike(plain, shape, huber):
    """The same flow and dual variable, from any that vanishes across the border; each frame of a batch by itself."""
    random = np.random.default_rng(23)
    angle, offset, bound = random.uniform(0, 6, (3, 2, *shape)).astype(np.float32)
    problem = FlowProblem(np.stack([np.cos(angle), np.sin(angle)], 1), 2 * offset - 6, bound / 3)
    start, pull = random.normal(0, 1, (2, 2, *shape)), random.normal(0, 0.5, (2, 2, 2, *shape))
    pull[:, 0, :, :, -1] = pull[:, 1, :, -1, :] = 0

    def swept():
        dual = pull.astype(np.float32)
        return sweep(problem, start.astype(np.float32), dual, SweepParams(15, 0.7, huber), np), dual

    (fast, fast_dual), (slow, slow_dual) = both(plain, swept)
    assert fast.dtype == slow.dtype == np.float32
    assert fast == pytest.approx(slow, abs=2e-5)
    assert fast_dual == pytest.approx(slow_dual, abs=2e-5)
    assert np.abs(slow - start).max() > 0.1


@needs_compiler
def test_folds_are_found_where_the_jacobian_vanishes(plain):
    flow = rng.normal(0, 3.0, (33, 21, 2)).astype(np.float32)
    fast, slow = both(plain, lambda: _folded(flow))
    assert 0 < slow.sum() < slow.size
    assert np.array_equal(fast, slow)


@needs_compiler
@pytest.mark.parametrize(
    "loops",
    [
        add_products,
        draw_pixels,
        lower_pixels,
        mark_folds,
        sample_spline,
        sweep_frame,
        take_in_pixels,
        weigh_pixels,
    ],
    ids=lambda one: one.__name__,
)
def test_loops_are_compiled(loops):
    assert compiling.compiled(loops) is not None


def test_a_compiler_that_cannot_be_loaded_is_none(monkeypatch):
    def refuse(name):
        raise ImportError("Numba needs NumPy 2.4 or less")

    monkeypatch.setattr(compiling, "find_spec", lambda name: object())
    monkeypatch.setattr(compiling.importlib, "import_module", refuse)
    assert not compiling.can_compile.__wrapped__()
    monkeypatch.setattr(compiling, "can_compile", lambda: False)
    assert compiling.compiled.__wrapped__(mark_folds) is None


def test_folds_run_without_a_compiler_too():
    flow, folded = np.zeros((4, 5, 2), np.float32), np.empty((2, 3), bool)
    flow[:, 2:, 0] = -4
    mark_folds(flow, folded)
    assert folded.tolist() == [[True, True, False]] * 2


@needs_compiler
@pytest.mark.parametrize("colour", [False, True])
@pytest.mark.parametrize("drift", [0.0, 1e-3])
def test_a_frame_is_taken_in_alike(plain, colour, drift):
    shape = (17, 23, 3) if colour else (17, 23)
    prior = PixelGaussian(rng.random(shape, np.float32), np.full((17, 23), 0.01, np.float32))
    before = prior.mean.copy(), prior.variance.copy()
    frames = rng.random((3, *shape), np.float32)
    noises = [0.02, *rng.uniform(1e-3, 1, (2, 17, 23)).astype(np.float32)]

    def fused():
        fusion = PixelFusion(prior, drift)
        figures = [fusion.take_in(*pair) for pair in zip(frames, noises, strict=True)]
        return fusion.image, figures

    (fast, fast_figures), (slow, slow_figures) = both(plain, fused)
    assert fast.mean == pytest.approx(slow.mean, abs=1e-6)
    assert fast.variance == pytest.approx(slow.variance, rel=1e-5)
    assert np.array(fast_figures) == pytest.approx(np.array(slow_figures), rel=1e-5)
    assert np.array_equal(prior.mean, before[0])
    assert np.array_equal(prior.variance, before[1])


@pytest.mark.parametrize("unusable", [np.nan, np.inf])
def test_what_cannot_be_taken_in_is_refused_alike(plain, unusable):
    prior, usable = PixelGaussian(np.zeros((4, 5), np.float32), np.ones((4, 5))), np.ones((4, 5), np.float32)
    broken = usable.copy()
    broken[2, 3] = unusable
    for frame, noise in ((broken, usable), (usable, broken), (usable, 0 * usable), (usable, -usable)):
        for call in (lambda function: function(), plain):
            with pytest.raises(DataError, match="^noise_variance: expected values above 0"):
                call(lambda f=frame, z=noise: PixelFusion(prior, 0.0).take_in(f, z))
    with pytest.raises(DataError, match="^frame: expected shape"):
        PixelFusion(prior, 0.0).take_in(usable[:3], usable)


def test_without_the_compiler_everything_runs():
    """The import is blocked in a process of its own, as a missing package would."""
    code = (
        "import turbrestore.runtime.jit as c; c.find_spec = lambda name: None\n"
        "import numpy as np; from turbrestore.pipeline import restore\n"
        "from turbrestore.synthesis.scenes import resolution_chart\n"
        "assert not c.can_compile() and c.compiled(abs) is None\n"
        "frames = np.stack([np.roll(resolution_chart(64, 64), k % 3, 1) for k in range(6)])\n"
        "assert np.isfinite(restore(frames).image).all()\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr

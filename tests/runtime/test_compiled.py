"""Compiled loops against the operations of NumPy and OpenCV that stand in for them, and life without a compiler."""

import subprocess
import sys

import cv2
import numpy as np
import pytest

from turbrestore.blur.estimation import descend_loops, estimate_blur
from turbrestore.blur.psf import KOLMOGOROV, blur_otf, laplacian_symbol
from turbrestore.deconvolution.conjugate_gradient import (
    ConjugateGradients,
    _apply,
    _move,
    _turn,
    apply_loops,
    move_loops,
    turn_loops,
)
from turbrestore.deconvolution.nonlocal_penalty import (
    NonlocalPenalty,
    _project,
    _rise,
    add_differences,
    add_squares,
    draw_back,
    project_loops,
    rise_loops,
)
from turbrestore.deconvolution.nonlocal_tv import NonlocalParams, add_sums, nonlocal_weights, search_offsets
from turbrestore.deconvolution.patch_pairs import join_choices, pairs_of_band
from turbrestore.deconvolution.patch_search import BAND_ROWS, OUTSIDE, PatchSearch, choose_offsets, search_bands
from turbrestore.deconvolution.primal_dual import _divide, _follow, divide_loops, follow_loops
from turbrestore.deconvolution.problem import Problem
from turbrestore.deconvolution.strip_grid import StripGrid
from turbrestore.registration.confidence import draw_pixels, flow_confidence, lower_pixels, regularise_flow
from turbrestore.registration.tvl1_sweeps import FlowProblem, SweepParams, sweep, sweep_frame
from turbrestore.registration.warp import sample_spline, warp
from turbrestore.runtime import jit as compiling
from turbrestore.synthesis.scenes import SCENES

USERS = (
    "blur.estimation",
    "deconvolution.nonlocal_penalty",
    "deconvolution.nonlocal_tv",
    "deconvolution.patch_search",
    "registration.warp",
    "deconvolution.paired_transform",
    "deconvolution.patch_pairs",
    "deconvolution.primal_dual",
    "registration.confidence",
    "registration.tvl1_sweeps",
    "deconvolution.conjugate_gradient",
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
@pytest.mark.parametrize(
    "loops",
    [
        add_differences,
        add_squares,
        add_sums,
        apply_loops,
        choose_offsets,
        descend_loops,
        draw_back,
        draw_pixels,
        follow_loops,
        join_choices,
        lower_pixels,
        move_loops,
        sample_spline,
        sweep_frame,
        turn_loops,
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
    assert compiling.compiled.__wrapped__(sample_spline) is None


def test_what_follows_an_iteration_is_alike():
    """Both without a compiler: the loop itself, and NumPy."""
    arrays = list(rng.normal(size=(8, 50)).astype(np.float32))
    arrays[4] = rng.integers(0, 2, 50).astype(np.float32)
    steps = np.float32([30.0, 0.7, 1.8])
    fast, slow = [array.copy() for array in arrays], [array.copy() for array in arrays]
    follow_loops(*fast, steps)
    _follow(*slow, steps)
    for one, other in zip(fast[:6], slow[:6], strict=True):
        assert one == pytest.approx(other, abs=1e-4)


@pytest.mark.parametrize("real", [False, True])
def test_what_a_step_divides_by_is_alike(real):
    """Both without a compiler, as above."""
    parts = rng.normal(size=(2, 3, 7, 5)).astype(np.float32)
    numbers = parts[0] + 1j * parts[1]
    transfer = parts[0, 2] if real else numbers[2]
    fast, slow = numbers[:2].copy(), numbers[:2].copy()
    divide_loops(*fast, transfer, np.float32([2, 30]))
    _divide(*slow, transfer, np.float32([2, 30]))
    assert fast == pytest.approx(slow, abs=1e-5)
    assert np.abs(fast - numbers[:2]).max() > 0.1


@pytest.mark.parametrize("real", [False, True])
@pytest.mark.parametrize(
    ("part", "loops", "plain"), [(0, turn_loops, _turn), (1, apply_loops, _apply), (2, move_loops, _move)]
)
def test_parts_of_a_step_of_conjugate_gradients_are_alike(part, loops, plain, real):
    """Both without a compiler, as above."""
    parts = rng.normal(size=(2, 7, 6, 5)).astype(np.float32)
    spectra, shares, share = parts[0] + 1j * parts[1], rng.random(5), np.float32([0.7])
    positive, transfer = rng.random((6, 5), np.float32), parts[0, 6] if real else spectra[6]

    def arguments():
        one, two, three, four = (spectrum.copy() for spectrum in spectra[:4])
        total = np.array([2.0])
        return (
            (one, two, positive, transfer, share, three),
            (one, two, positive, transfer, share, shares, total),
            (one, two, three, four, positive, share, shares, total),
        )[part]

    fast, slow, before = arguments(), arguments(), arguments()
    loops(*fast)
    plain(*slow)
    changed = [not np.array_equal(one, other) for one, other in zip(fast, before, strict=True)]
    assert sum(changed) == 2 + (part == 2)
    for one, other in zip(fast, slow, strict=True):
        assert one == pytest.approx(other, abs=1e-4)


@needs_compiler
@pytest.mark.parametrize("real", [False, True])
def test_conjugate_gradients_step_alike(plain, real):
    """An image of several strips and blocks, of which not all is seen."""
    image = rng.random((30, 41), np.float32)
    seen, transfer = (rng.random(image.shape) > 0.2).astype(np.float32), blur_otf(image.shape, 1.3, KOLMOGOROV)
    if not real:
        transfer = (transfer * np.exp(0.3j)).astype(np.complex64)
        transfer[[0, 0, 15, 15], [0, -1, 0, -1]] = 0.5

    def solve():
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("turbrestore.deconvolution.strip_grid._ONE_STRIP", 1)
            patch.setattr("turbrestore.deconvolution.strip_grid._STRIP", 200)
            grid = StripGrid(image.shape)
            problem = Problem(image, seen, grid.in_blocks(transfer), 30.0, grid)
            solver = ConjugateGradients(grid.in_blocks(laplacian_symbol(*image.shape)))
            state = solver.start(problem)
            for _ in range(6):
                state = solver.step(problem, state)
            return state.image, state.decrease

    (fast, left), (slow, rest) = both(plain, solve)
    assert fast == pytest.approx(slow, abs=1e-5)
    assert left == pytest.approx(rest, rel=1e-2)


@pytest.mark.parametrize(("loops", "plain", "images"), [(rise_loops, _rise, 2), (project_loops, _project, 4)])
def test_passes_over_images_of_a_dual_step_are_alike(loops, plain, images):
    """Both without a compiler, as above."""
    fast = rng.random((images, 50), np.float32) * 3
    slow, before = fast.copy(), fast.copy()
    loops(*fast, np.float32([0.7, 1.8]))
    plain(*slow, np.float32([0.7, 1.8]))
    assert fast == pytest.approx(slow, abs=1e-6)
    assert np.abs(fast - before).max() > 0.1


@needs_compiler
@pytest.mark.parametrize("shape", [(1, 9), (30, 41), (BAND_ROWS + 3, 12)])
@pytest.mark.parametrize("chosen", [(4, 10), (0, 3), (8, 0), (0, 32)])
def test_offsets_are_chosen_alike(plain, shape, chosen):
    """In the image, at its border, and where so many offsets are chosen that some lie beyond the border."""
    window = np.float32([[0.25], [0.5], [0.25]])
    guide, search = rng.random(shape, np.float32), PatchSearch(window, search_offsets(7), *chosen)
    nearest, mask = search.nearest, search.rank_mask

    def choices():
        return np.concatenate([keys for _, keys in search_bands(guide, search)])

    fast, slow = both(plain, choices)
    assert fast.shape == slow.shape == (guide.size, sum(chosen))
    assert np.array_equal(fast[:, :nearest] & mask, slow[:, :nearest] & mask)
    for part in (np.s_[:, :nearest], np.s_[:, nearest:]):
        distances = [(np.sort(keys[part], axis=1) & ~mask).view(np.float32) for keys in (fast, slow)]
        assert distances[0] == pytest.approx(distances[1], rel=1e-4)
    # Which they are, but where two are about as far.
    same = (np.sort(fast & mask, axis=1) == np.sort(slow & mask, axis=1)).all(axis=1)
    assert same.mean() > 0.98


@needs_compiler
@pytest.mark.parametrize("shape", [(1, 9), (5, 1), (4, 9), (9, 9), (30, 41)])
@pytest.mark.parametrize("chosen", [(4, 6), (0, 1), (8, 0), (0, 20)])
def test_pairs_are_joined_alike(plain, shape, chosen):
    """In a band that is the image, in one with rows below it, and where equal patches make pairs chosen twice."""
    search, width = PatchSearch(np.ones((1, 1), np.float32), search_offsets(7), *chosen), shape[1]
    for guide in (rng.random(shape, np.float32), np.zeros(shape, np.float32)):
        [(_, keys)] = search_bands(guide, search)
        # The same pair has two distances that differ by rounding, as with larger patches.
        keys[keys < OUTSIDE] += rng.integers(0, 3, np.count_nonzero(keys < OUTSIDE), np.int32) * (search.rank_mask + 1)
        for top, stop in {(0, shape[0]), (0, 1), (shape[0] // 3, shape[0] // 2 + 1)}:
            band = keys[top * width : stop * width], keys[stop * width :]
            fast, slow = both(plain, lambda band=band: pairs_of_band(*band, width, search))
            assert len(fast.heads) == fast.degrees.sum()
            for one, other in zip(fast, slow, strict=True):
                assert one.dtype == other.dtype
                assert np.array_equal(one, other)


@needs_compiler
def test_pairs_of_the_widest_images_have_their_numbers(plain):
    """Each pixel takes the 5100th offset: numbers of pairs need 33 bits and more."""
    search = PatchSearch(np.ones((1, 1), np.float32), search_offsets(101), nearest=1, best=0)
    farthest = int(np.abs(search.offsets @ [51, 1]).argmax())
    keys = np.full((64 * 30_000, 1), 1 << 30 | farthest, np.int32)
    fast, slow = both(plain, lambda: pairs_of_band(keys, keys[:0], 30_000, search))
    assert fast.heads.size > 0
    for one, other in zip(fast, slow, strict=True):
        assert np.array_equal(one, other)


@needs_compiler
def test_a_blur_is_estimated_alike(plain):
    image = cv2.GaussianBlur(SCENES["camera"](96, 96), (0, 0), 1.3)
    fast, slow = both(plain, lambda: estimate_blur(image, exponent=2.0))
    assert fast.blurred
    assert fast.sigma == pytest.approx(slow.sigma, abs=1e-3)
    assert fast.costs == pytest.approx(slow.costs, abs=1e-3)


@needs_compiler
def test_the_dual_variable_moves_alike(plain):
    guide = rng.random((30, 28), np.float32)
    graph = nonlocal_weights(guide, NonlocalParams(search=7, patch=3))
    penalty, images = NonlocalPenalty(graph, StripGrid(graph.shape)), rng.random((4, 30, 28), np.float32)

    def ascended():
        dual, pulls = penalty.dual(guide), np.empty_like(images)
        for image, pull in zip(images, pulls, strict=True):
            penalty.ascend(dual, image.copy(), 3.0, 1.4, pull)
        return dual.values, pulls, [penalty.value(image) for image in images]

    bounds = both(plain, lambda: nonlocal_weights(guide, NonlocalParams(search=7, patch=3)).norm_squared)
    assert bounds[0] == pytest.approx(bounds[1], rel=1e-5)
    (fast, fast_pulls, fast_values), (slow, slow_pulls, slow_values) = both(plain, ascended)
    assert np.abs(fast).max() > 0.1
    assert fast == pytest.approx(slow, abs=1e-5)
    assert fast_pulls == pytest.approx(slow_pulls, abs=1e-5)
    assert fast_values == pytest.approx(slow_values, rel=1e-5)


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

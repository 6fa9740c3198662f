"""Compiled loops against the operations of NumPy and OpenCV that stand in for them, and life without a compiler."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from turbrestore.blur.psf import KOLMOGOROV, blur_otf, laplacian_symbol
from turbrestore.core.errors import DataError
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
from turbrestore.dynamics.dynamic_texture import identify
from turbrestore.dynamics.flow_model import SUMMED, add_products, project_deviation
from turbrestore.filtering.frame_noise import _folded, judge_frame, mark_folds, measure_frame_noise, weigh_pixels
from turbrestore.filtering.kalman import PixelGaussian
from turbrestore.filtering.pixel_fusion import PixelFusion, take_in_pixels
from turbrestore.runtime import jit as compiling

USERS = (
    "filtering.frame_noise",
    "deconvolution.nonlocal_penalty",
    "deconvolution.nonlocal_tv",
    "deconvolution.patch_search",
    "filtering.pixel_fusion",
    "deconvolution.paired_transform",
    "deconvolution.patch_pairs",
    "deconvolution.primal_dual",
    "dynamics.flow_model",
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
def test_folds_are_found_where_the_jacobian_vanishes(plain):
    flow = rng.normal(0, 3.0, (33, 21, 2)).astype(np.float32)
    fast, slow = both(plain, lambda: _folded(flow))
    assert 0 < slow.sum() < slow.size
    assert np.array_equal(fast, slow)


@needs_compiler
@pytest.mark.parametrize(
    "loops",
    [
        add_differences,
        add_squares,
        add_products,
        add_sums,
        apply_loops,
        choose_offsets,
        draw_back,
        follow_loops,
        join_choices,
        mark_folds,
        move_loops,
        take_in_pixels,
        turn_loops,
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

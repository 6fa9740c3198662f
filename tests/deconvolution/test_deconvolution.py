"""Solvers against dense algebra, brute force and the Euler–Lagrange equations; the border; settings."""

import dataclasses
import itertools

import cv2
import numpy as np
import pytest
from blurred_images import camera, in_strips, psnr
from regulariser import Regulariser
from scipy import fft, optimize
from small_problems import dense, dense_blur, small_problem

from turbrestore.blur.estimation import BlurEstimate
from turbrestore.blur.psf import gaussian_otf, gaussian_psf
from turbrestore.core.errors import ConfigurationError, DataError
from turbrestore.deconvolution import primal_dual
from turbrestore.deconvolution.deconvolution_memory import Room
from turbrestore.deconvolution.deconvolve import (
    BOUNDARIES,
    METHODS,
    DeconvolutionParams,
    automatic_fidelity,
    deconvolve,
)
from turbrestore.deconvolution.nonlocal_penalty import NonlocalPenalty
from turbrestore.deconvolution.nonlocal_tv import (
    NonlocalParams,
    nonlocal_gradient,
    nonlocal_magnitude,
    nonlocal_weights,
)
from turbrestore.deconvolution.primal_dual import PrimalDual, PrimalDualState
from turbrestore.deconvolution.problem import Problem
from turbrestore.deconvolution.strip_grid import StripGrid
from turbrestore.deconvolution.tv import LocalPenalty, local_divergence, local_gradient
from turbrestore.synthesis.scenes import SCENES

TV = Regulariser(
    local_gradient,
    lambda p: -local_divergence(p),
    lambda p: p / np.maximum(np.sqrt((p**2).sum(axis=0)), 1),
    lambda u: float(np.sqrt((local_gradient(u) ** 2).sum(axis=0)).sum()),
    8.0,
)


def nonlocal_penalty(guide: np.ndarray, h: float = 0.5) -> NonlocalPenalty:
    graph = nonlocal_weights(guide, NonlocalParams(patch=3, search=5, best=4, h=h))
    return NonlocalPenalty(graph, StripGrid(graph.shape))


def solve(solver: PrimalDual, problem: Problem, iterations: int) -> np.ndarray:
    state = solver.start(problem, problem.observed)
    for _ in range(iterations):
        state = solver.step(problem, state)
    return state.image


# --- operators -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(1, 5), (7, 6)])
def test_local_divergence_is_the_negative_adjoint_of_the_gradient(shape):
    rng = np.random.default_rng(0)
    u, v = rng.normal(size=shape).astype(np.float32), rng.normal(size=(2, *shape)).astype(np.float32)
    assert np.vdot(local_gradient(u), v) == pytest.approx(-np.vdot(u, local_divergence(v)), abs=1e-4)


@pytest.mark.parametrize("shape", [(1, 5), (7, 6), (40, 41)])
def test_rows_of_differences_are_those_of_the_whole(shape):
    u, v = np.random.default_rng(0).normal(size=shape), np.random.default_rng(1).normal(size=(2, *shape))
    for start in range(shape[0]):
        for stop in range(start + 1, shape[0] + 1):
            rows = slice(start, stop)
            assert np.array_equal(local_gradient(u, rows), local_gradient(u)[:, rows])
            assert np.array_equal(local_divergence(v, rows), local_divergence(v)[rows])
    assert local_gradient(u) == pytest.approx(np.stack([np.roll(u, -1, axis) - u for axis in (0, 1)]), abs=1e-6)


@pytest.mark.parametrize("in_file", [False, True])
def test_total_variation_in_strips_is_that_of_its_operators(monkeypatch, tmp_path, in_file):
    monkeypatch.setattr("turbrestore.deconvolution.strip_grid._ONE_STRIP", 1)
    monkeypatch.setattr("turbrestore.deconvolution.strip_grid._STRIP", 100)
    rng, found = np.random.default_rng(2), LocalPenalty(StripGrid((23, 14), None, tmp_path if in_file else None))
    image = rng.random((23, 14)).astype(np.float32)
    assert found.value(image) == pytest.approx(TV.value(image), rel=1e-5)
    assert found.norm_squared == TV.norm_squared
    dual, reference, (pull, expected) = found.dual(image), TV.dual(image), np.empty((2, 23, 14), np.float32)
    for _ in range(4):
        image = rng.normal(size=(23, 14)).astype(np.float32)
        found.ascend(dual, image.copy(), 0.7, 1.4, pull)
        TV.ascend(reference, image, 0.7, 1.4, expected)
        assert dual == pytest.approx(reference, abs=1e-5)
        assert pull == pytest.approx(expected, abs=1e-5)


def test_blur_matches_opencv_inside():
    image = np.random.default_rng(3).random((40, 44)).astype(np.float32)
    blurred = fft.irfft2(gaussian_otf(image.shape, 1.2) * fft.rfft2(image), s=image.shape)
    expected = cv2.GaussianBlur(image, (13, 13), 1.2)
    assert np.abs(blurred - expected)[8:-8, 8:-8].max() < 2e-3


# --- primal-dual -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("margin", [0, 2])
@pytest.mark.parametrize("number", [1, 7, 1000])
def test_one_step_is_that_of_dense_algebra(margin, number):
    problem = small_problem(4, 30.0, margin=margin)
    rng = np.random.default_rng(5)
    u, q = rng.normal(size=(2, 8, 8)).astype(np.float32)
    p = TV.project(rng.normal(size=(2, 8, 8)).astype(np.float32))
    blur, gradient = dense_blur(problem), dense(TV.gradient, (8, 8))
    blurred = (blur @ u.ravel()).reshape(8, 8).astype(np.float32)
    # A step changes all of it in place.
    state = PrimalDualState(u.copy(), blurred, q.copy(), p.copy(), TV.adjoint(p), number)
    after = PrimalDual(TV).step(problem, state)

    def unrelaxed(new: np.ndarray, old: np.ndarray) -> np.ndarray:
        return (old + (new - old) / primal_dual.RELAXATION).ravel()

    share = max(1 / number, primal_dual.LEAST_DATA_STEP)
    tau, t = primal_dual.PRIMAL_STEP / np.sqrt(TV.norm_squared), 30.0 * share
    metric = np.eye(64) / tau + t * blur.T @ blur
    expected = u.ravel() - np.linalg.solve(metric, gradient.T @ p.ravel() + blur.T @ q.ravel())
    assert unrelaxed(after.image, u) == pytest.approx(expected, abs=1e-5)
    assert after.blurred.ravel() == pytest.approx(blur @ after.image.ravel(), abs=1e-5)
    # Moreau: the proximal step of th* is what the one of h/t, a weighted mean of pixels, leaves.
    ahead, seen, f = q.ravel() + t * blur @ (2 * expected - u.ravel()), problem.seen.ravel(), problem.observed.ravel()
    nearest = (30.0 * seen * f + ahead) / (30.0 * seen + t)
    assert unrelaxed(after.pressure, q) == pytest.approx(ahead - t * nearest, abs=2e-4)
    ascent = (p.ravel() + gradient @ (2 * expected - u.ravel()) / (tau * TV.norm_squared)).reshape(2, 8, 8)
    assert unrelaxed(after.dual, p) == pytest.approx(TV.project(ascent.astype(np.float32)).ravel(), abs=1e-4)
    assert after.pull == pytest.approx(TV.adjoint(after.dual), abs=1e-5)
    assert after.number == number + 1


def test_the_start_is_that_of_dense_algebra():
    problem, u = small_problem(4, 30.0, margin=2), np.random.default_rng(5).random((8, 8)).astype(np.float32)
    start, blurred = PrimalDual(TV).start(problem, u), dense_blur(problem) @ u.ravel()
    s = 1 / (primal_dual.PRIMAL_STEP * np.sqrt(TV.norm_squared))
    assert start.blurred.ravel() == pytest.approx(blurred, abs=1e-5)
    assert start.pressure == pytest.approx(30.0 * problem.seen * (start.blurred - problem.observed), abs=1e-4)
    assert start.dual == pytest.approx(TV.project(s * TV.gradient(u)), abs=1e-5)
    assert start.pull == pytest.approx(TV.adjoint(start.dual), abs=1e-5)


def test_where_all_is_seen_the_first_step_solves_the_data_term_exactly():
    problem = small_problem(4, 30.0, margin=0)
    start = PrimalDual(TV).start(problem, np.random.default_rng(5).random((8, 8)).astype(np.float32))
    pull, blur = start.pull.copy(), dense_blur(problem)
    tau = primal_dual.PRIMAL_STEP / np.sqrt(TV.norm_squared)
    target = (start.image - tau * pull).ravel()
    # Least squares: ‖(v − target)/√τ‖² + ‖√λ(Bv − f)‖².
    system = np.concatenate([np.eye(64) / np.sqrt(tau), np.sqrt(30.0) * blur])
    right = np.concatenate([target / np.sqrt(tau), np.sqrt(30.0) * problem.observed.ravel()])
    before = start.image.copy()
    found = PrimalDual(TV).step(problem, start).image
    relaxed = before + (found - before) / primal_dual.RELAXATION
    assert relaxed.ravel() == pytest.approx(np.linalg.lstsq(system, right, rcond=None)[0], abs=1e-5)


@pytest.mark.parametrize("margin", [0, 2])
@pytest.mark.parametrize("penalty", ["tv", "nltv"])
def test_optimum_matches_brute_force(penalty, margin):
    problem = small_problem(6, 20.0, margin=margin)
    regulariser = TV if penalty == "tv" else nonlocal_penalty(problem.observed)
    found = solve(PrimalDual(regulariser), problem, 3000)
    blur = dense_blur(problem)
    if penalty == "tv":
        edges = dense(regulariser.gradient, (8, 8)).reshape(2, 64, 64)
        owners = np.stack([np.arange(64)] * 2)
    else:
        graph = nonlocal_weights(problem.observed, NonlocalParams(patch=3, search=5, best=4, h=0.5))
        edges = dense(lambda u: nonlocal_gradient(graph, u), (8, 8)).reshape(2, -1, 64)
        owners = np.stack([graph.tails, graph.heads])
    matrix, owners, seen = edges.reshape(-1, 64), owners.ravel(), problem.seen.ravel()

    def smoothed(u: np.ndarray) -> tuple[float, np.ndarray]:
        residual = seen * (blur @ u - problem.observed.ravel())
        gradient = matrix @ u
        magnitude = np.sqrt(np.bincount(owners, gradient**2, minlength=64) + 1e-8)
        slope = 20.0 * blur.T @ residual + matrix.T @ (gradient / magnitude[owners])
        return 10.0 * residual @ residual + magnitude.sum(), slope

    best = optimize.minimize(
        smoothed, problem.observed.ravel(), jac=True, method="L-BFGS-B", options={"maxiter": 5000, "ftol": 1e-15}
    )
    energy = problem.misfit(found) + regulariser.value(found)
    assert energy == pytest.approx(best.fun, rel=2e-3)
    assert np.abs((found.ravel() - best.x)[seen > 0]).max() < 0.02


def test_optimum_solves_the_euler_lagrange_equation_of_the_paper():
    """``λ k*∗(k∗u − f) + L[u] = 0`` (eq. 24) at pixels where |∇_w u| > 0, there and at their neighbours."""
    problem = small_problem(7, 60.0, shape=(12, 12), margin=0)
    graph = nonlocal_weights(problem.observed, NonlocalParams(patch=3, search=5, best=4, h=0.5))
    regulariser = nonlocal_penalty(problem.observed)
    u = solve(PrimalDual(regulariser), problem, 6000)
    magnitude = nonlocal_magnitude(graph, nonlocal_gradient(graph, u)).ravel().astype(np.float64)
    assert np.mean(magnitude > 0.01) > 0.5
    w = np.zeros((144, 144))
    w[graph.tails, graph.heads] = graph.weights
    w += w.T
    flat = u.ravel().astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1 / magnitude
        curvature = -((flat[None] - flat[:, None]) * (inverse[:, None] + inverse[None]) * w).sum(axis=1)
    blur = dense_blur(problem)
    data_slope = 60.0 * blur.T @ (blur @ flat - problem.observed.ravel())
    # Where a neighbour's gradient vanishes, L is a set and the equation an inclusion.
    regular = (magnitude > 0.01) & ~((w > 0) & (magnitude <= 0.01)[None]).any(axis=1)
    assert regular.sum() > 20
    assert np.abs(curvature[regular]).mean() > 0.5
    assert np.abs(data_slope + curvature)[regular].max() < 0.02


# --- memory and threads ----------------------------------------------------------------------------------------------


def test_pairs_in_a_file_give_the_same_image(monkeypatch, tmp_path):
    monkeypatch.setattr("turbrestore.deconvolution.nonlocal_tv.STRIP_PIXELS", 700)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "nowhere"))
    held = []
    monkeypatch.setattr("turbrestore.deconvolution.nonlocal_penalty.drop_pages", held.append)
    _, blurred = camera(72, 1.5, 0.002)
    colour = blurred[..., None] * np.array([0.9, 0.6, 0.3], np.float32)
    params = DeconvolutionParams(iterations=12, channels="each")
    whole = deconvolve(colour, 1.5, params)
    assert not any(isinstance(values.base, np.memmap) for values in held)
    parts = deconvolve(colour, 1.5, dataclasses.replace(params, memory=1e7), scratch=tmp_path)
    assert any(isinstance(values.base, np.memmap) and values.shape[0] == 2 for values in held)
    assert np.abs(parts.image - whole.image).max() < 1e-5
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize("method", METHODS)
def test_strips_give_the_image_of_the_whole(monkeypatch, method, boundary):
    _, blurred = camera(72, 1.5, 0.002)
    # A guide that is sharpened differs by rounding, and may have other neighbours.
    params = DeconvolutionParams(method=method, iterations=40, boundary=boundary, sharpen_guide=False)
    whole = deconvolve(blurred, 1.5, params)
    in_strips(monkeypatch)
    strips = deconvolve(blurred, 1.5, params)
    assert np.abs(strips.image - whole.image).max() < 1e-5
    assert strips.iterations == whole.iterations
    assert strips.objective == pytest.approx(whole.objective, rel=1e-4)
    assert strips.changes == pytest.approx(whole.changes, rel=1e-3, abs=1e-5)


@pytest.mark.parametrize("channels", ["luminance", "each"])
@pytest.mark.parametrize("method", METHODS)
def test_images_in_files_are_the_same_bytes(monkeypatch, tmp_path, method, channels):
    in_strips(monkeypatch)
    _, blurred = camera(72, 1.5, 0.002)
    colour = blurred[..., None] * np.array([0.9, 0.6, 0.3], np.float32)
    params = DeconvolutionParams(method=method, iterations=15, channels=channels)
    whole = deconvolve(colour, 1.5, params, colour)
    parts = deconvolve(colour, 1.5, dataclasses.replace(params, memory=1.0), colour, scratch=tmp_path)
    assert isinstance(parts.image, np.memmap) and not isinstance(whole.image, np.memmap)
    assert parts.image.tobytes() == whole.image.tobytes()
    for name in ("recorded", "objective", "changes"):
        assert np.array_equal(getattr(parts, name), getattr(whole, name))


@pytest.mark.parametrize("method", METHODS)
def test_threads_that_share_images_in_files_give_the_same_bytes(monkeypatch, tmp_path, method):
    in_strips(monkeypatch)
    _, blurred = camera(72, 1.5, 0.002)
    colour, images = blurred[..., None] * np.array([0.9, 0.6, 0.3], np.float32), []
    params = DeconvolutionParams(method=method, iterations=8, channels="each")
    for room in (Room(1, False), Room(4, False), Room(4, True, True)):
        monkeypatch.setattr("turbrestore.deconvolution.deconvolve.DeconvolutionWork.room", lambda *_, room=room: room)
        images.append(deconvolve(colour, 1.5, params, scratch=tmp_path).image.tobytes())
    assert len(set(images)) == 1


@pytest.mark.parametrize("method", METHODS)
def test_the_same_bytes_whatever_the_number_of_threads(monkeypatch, method):
    in_strips(monkeypatch)
    _, blurred = camera(72, 1.5, 0.002)
    images = []
    for threads in (1, 2, 5):
        for module in ("deconvolution.deconvolve", "deconvolution.nonlocal_tv", "runtime.threads"):
            monkeypatch.setattr(f"turbrestore.{module}.available_cores", lambda threads=threads: threads)
        images.append(deconvolve(blurred, 1.5, DeconvolutionParams(method=method, iterations=10)).image.tobytes())
    assert len(set(images)) == 1


# --- the whole stage -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("side", [16, 24])
@pytest.mark.parametrize("method", ["nltv", "tv"])
def test_a_start_that_is_solved_at_once_is_not_divided_by_nothing(method, side):
    params = DeconvolutionParams(method=method, boundary="periodic", iterations=20)
    for name, width, noise in itertools.product(("camera", "brick", "grass"), (0.5, 1.0, 2.5), (0.0, 0.01)):
        scene = SCENES[name](side, side) + np.random.default_rng(0).normal(0, noise, (side, side))
        assert np.isfinite(deconvolve(scene, width, params).image).all()


@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize("method", METHODS)
def test_a_constant_image_stays_what_it_is(method, boundary):
    flat = np.full((20, 24), 0.37, np.float32)
    result = deconvolve(flat, 1.5, DeconvolutionParams(method=method, boundary=boundary))
    assert result.image == pytest.approx(0.37, abs=1e-4)


@pytest.mark.parametrize("method", METHODS)
def test_without_blur_the_image_is_left_alone(method):
    image = np.random.default_rng(11).normal(0.5, 0.5, (12, 12, 3)).astype(np.float32)
    for nothing in (0, np.ones((1, 1))):
        result = deconvolve(image, nothing, DeconvolutionParams(method=method))
        assert np.array_equal(result.image, image)
        assert (result.sigma, result.iterations, result.converged) == (0, 0, True)


@pytest.mark.parametrize(("method", "gain"), [("nltv", 3.5), ("tv", 3.5), ("wiener", 3.0), ("tikhonov", 2.5)])
def test_every_method_restores_a_photograph(method, gain):
    truth, blurred = camera(96, 1.5, 0.002)
    result = deconvolve(blurred, 1.5, DeconvolutionParams(method=method))
    assert psnr(result.image, truth) > psnr(blurred, truth) + gain
    assert result.noise == pytest.approx(0.002, rel=0.3)
    assert result.fidelity == pytest.approx(automatic_fidelity(method, blurred, result.noise))
    assert len(result.recorded) == len(result.objective) == len(result.changes)
    assert result.recorded[-1] == result.iterations


@pytest.mark.parametrize("method", ["nltv", "tv", "wiener"])
def test_the_border_is_restored_as_well_as_the_interior(method):
    sigma = 1.5
    truth, blurred = camera(96, sigma, 0.002)
    border = np.ones(truth.shape, bool)
    border[6:-6, 6:-6] = False
    errors = {}
    for boundary in BOUNDARIES:
        result = deconvolve(blurred, sigma, DeconvolutionParams(method=method, boundary=boundary))
        squares = (result.image - truth) ** 2
        errors[boundary] = np.sqrt(squares[border].mean()), np.sqrt(squares[~border].mean())
    at_border, inside = errors["unknown"]
    before = np.sqrt(((blurred - truth) ** 2)[border].mean())
    assert at_border < 1.5 * inside
    assert at_border < 0.75 * before
    assert at_border < 0.5 * errors["periodic"][0]


def test_fidelity_trades_noise_for_sharpness():
    _, blurred = camera(48, 1.0, 0.01)
    soft, hard = (
        deconvolve(blurred, 1.0, DeconvolutionParams(method="tv", fidelity=f)).image for f in (100.0, 10000.0)
    )
    assert TV.value(hard) > 1.5 * TV.value(soft)


@pytest.mark.parametrize("method", METHODS)
def test_automatic_fidelity_is_near_the_best(method):
    truth, blurred = camera(80, 1.5, 0.008)
    automatic = deconvolve(blurred, 1.5, DeconvolutionParams(method=method))
    scores = [
        psnr(deconvolve(blurred, 1.5, DeconvolutionParams(method=method, fidelity=automatic.fidelity * f)).image, truth)
        for f in (0.1, 0.3, 3.0, 10.0)
    ]
    assert psnr(automatic.image, truth) > max(scores) - 0.4


def test_a_sampled_psf_does_as_its_gaussian():
    _, blurred = camera(48, 1.5, 0.002)
    params = DeconvolutionParams(method="tv")
    by_sigma, by_psf = deconvolve(blurred, 1.5, params), deconvolve(blurred, gaussian_psf(1.5), params)
    assert by_psf.sigma == pytest.approx(1.5, rel=0.01)
    assert np.abs(by_psf.image - by_sigma.image).mean() < 2e-3


def test_an_asymmetric_psf_moves_the_image_back():
    truth, _ = camera(48, 1.5, 0.0)
    psf = np.zeros((3, 5))
    psf[1, 4], psf[1, 2] = 0.6, 0.4
    blurred = cv2.filter2D(truth, -1, psf[::-1, ::-1], borderType=cv2.BORDER_REFLECT)
    result = deconvolve(blurred, psf, DeconvolutionParams(method="tv", fidelity=3000.0))
    assert psnr(result.image, truth) > psnr(blurred, truth) + 8


def test_channels():
    grey, blurred = camera(48, 1.5, 0.0)
    gain = np.array([0.9, 0.6, 0.3], np.float32)
    params = DeconvolutionParams(method="wiener", fidelity=300.0, tolerance=1e-6)
    each = deconvolve(blurred[..., None] * gain, 1.5, dataclasses.replace(params, channels="each"))
    for channel in range(3):
        alone = deconvolve(blurred * gain[channel], 1.5, params)
        assert each.image[..., channel] == pytest.approx(alone.image, abs=2e-3)
    kept = deconvolve(blurred[..., None] * gain + 0.05, 1.5, params)
    # The differences between channels, which are chroma, are those of the input.
    chroma = (kept.image - kept.image[..., :1]) - (blurred[..., None] * (gain - gain[0]))
    unclipped = ((kept.image > 0) & (kept.image < 1)).all(axis=-1)
    assert np.abs(chroma[unclipped]).max() < 1e-5
    assert psnr(kept.image, grey[..., None] * gain + 0.05) > psnr(blurred[..., None] * gain, grey[..., None] * gain)


def test_weights_come_from_the_guide():
    truth, blurred = camera(48, 1.5, 0.002)
    params = DeconvolutionParams(iterations=60)
    own = deconvolve(blurred, 1.5, params)
    same = deconvolve(blurred, 1.5, params, guide=np.repeat(blurred[..., None], 3, axis=2))
    # Nothing resembles anything in a guide of noise: other weights, another image.
    other = deconvolve(blurred, 1.5, params, guide=np.random.default_rng(12).random(blurred.shape))
    assert same.image == pytest.approx(own.image, abs=5e-3)
    assert np.abs(other.image - own.image).mean() > 5 * np.abs(same.image - own.image).mean()
    blurry = deconvolve(blurred, 1.5, dataclasses.replace(params, sharpen_guide=False))
    assert psnr(blurry.image, truth) > psnr(blurred, truth) + 2


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (3, 2), (5, 5, 3)])
@pytest.mark.parametrize("method", METHODS)
def test_tiny_images(method, shape):
    image = np.random.default_rng(13).random(shape).astype(np.float32)
    result = deconvolve(image, 1.0, DeconvolutionParams(method=method, iterations=20, channels="each"))
    assert result.image.shape == shape
    assert np.isfinite(result.image).all()
    assert result.image.min() >= 0
    assert result.image.max() <= 1


def test_progress_counts_iterations_and_inputs_stay():
    _, blurred = camera(32, 1.0, 0.0)
    colour = np.repeat(blurred[..., None], 3, axis=2)
    before, counted = colour.copy(), []
    result = deconvolve(colour, 1.0, DeconvolutionParams(channels="each"), progress=counted.append)
    assert sum(counted) == result.iterations
    assert np.array_equal(colour, before)


@pytest.mark.parametrize(
    "settings",
    [
        {"method": "magic"},
        {"boundary": "mirror"},
        {"channels": "red"},
        {"sigma": -1.0},
        {"fidelity": 0.0},
        {"fidelity": np.inf},
        {"iterations": 0},
        {"tolerance": -1.0},
        {"memory": 0.0},
    ],
)
def test_impossible_settings_are_refused(settings):
    with pytest.raises(ConfigurationError, match=f"{next(iter(settings))}: expected"):
        DeconvolutionParams(**settings)


def test_unusable_inputs_are_refused():
    image = np.zeros((8, 8), np.float32)
    with pytest.raises(ConfigurationError, match="sigma_or_psf"):
        deconvolve(image, -1.0)
    with pytest.raises(DataError, match="psf"):
        deconvolve(image, np.ones((2, 2)))
    with pytest.raises(DataError, match="guide: expected the size"):
        deconvolve(image, 1.0, guide=np.zeros((8, 9)))
    with pytest.raises(DataError, match="image"):
        deconvolve(np.full((8, 8), np.nan), 1.0)


def test_an_estimate_stands_for_its_removable_width_and_its_shape():
    image = np.random.default_rng(20).random((48, 48)).astype(np.float32)
    nothing = np.zeros(0)
    estimate = BlurEstimate(1.2, 0.4, 5 / 3, 0.01, 1, 1.0, nothing, nothing)
    by_estimate = deconvolve(image, estimate, DeconvolutionParams(iterations=5))
    by_width = deconvolve(image, 1.0, DeconvolutionParams(iterations=5, exponent=5 / 3))
    assert np.array_equal(by_estimate.image, by_width.image)
    gaussian = DeconvolutionParams(iterations=5, exponent=2.0)
    assert np.array_equal(deconvolve(image, estimate, gaussian).image, deconvolve(image, 1.0, gaussian).image)

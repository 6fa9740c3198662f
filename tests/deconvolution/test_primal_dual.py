"""Primal-dual splitting against dense algebra, brute force and the Euler–Lagrange equation of the paper."""

import dataclasses

import cv2
import numpy as np
import pair_operators as pairs
import pytest
from scipy import fft, optimize
from small_problems import dense, dense_blur, small_problem

from turbrestore.blur.psf import blur_otf
from turbrestore.deconvolution import primal_dual
from turbrestore.deconvolution.nonlocal_prior.nonlocal_tv import NonlocalPenalty
from turbrestore.deconvolution.nonlocal_prior.nonlocal_weights import NonlocalParams, nonlocal_weights
from turbrestore.deconvolution.primal_dual import PrimalDual, PrimalDualState
from turbrestore.deconvolution.problem import Problem
from turbrestore.deconvolution.tv import LocalPenalty, local_divergence, local_gradient

TV = LocalPenalty()


def gradient(u: np.ndarray) -> np.ndarray:
    return local_gradient(u)


def adjoint(p: np.ndarray) -> np.ndarray:
    return -local_divergence(p)


def project(p: np.ndarray) -> np.ndarray:
    return p / np.maximum(np.sqrt((p**2).sum(axis=0)), 1)


def nonlocal_graph(guide: np.ndarray):
    return nonlocal_weights(guide, NonlocalParams(patch=3, search=5, best=4, h=0.5))


def solve(solver: PrimalDual, problem: Problem, iterations: int) -> np.ndarray:
    state = solver.start(problem, problem.observed)
    for _ in range(iterations):
        state = solver.step(problem, state)
    return state.image


def test_blur_matches_opencv_inside():
    image = np.random.default_rng(3).random((40, 44)).astype(np.float32)
    blurred = fft.irfft2(blur_otf(image.shape, 1.2) * fft.rfft2(image), s=image.shape)
    expected = cv2.GaussianBlur(image, (13, 13), 1.2)
    assert np.abs(blurred - expected)[8:-8, 8:-8].max() < 2e-3


@pytest.mark.parametrize("margin", [0, 2])
@pytest.mark.parametrize("number", [1, 7, 1000])
def test_one_step_is_that_of_dense_algebra(margin, number):
    problem = small_problem(4, 30.0, margin=margin)
    rng = np.random.default_rng(5)
    # Pixels whose noise differs.
    problem = dataclasses.replace(problem, seen=problem.seen * rng.uniform(0.3, 3, (8, 8)).astype(np.float32))
    u, q = rng.normal(size=(2, 8, 8)).astype(np.float32)
    p = project(rng.normal(size=(2, 8, 8)).astype(np.float32))
    blur, differences = dense_blur(problem), dense(gradient, (8, 8))
    blurred = (blur @ u.ravel()).reshape(8, 8).astype(np.float32)
    state = PrimalDualState(u, blurred, q, p.copy(), adjoint(p), number)
    after = PrimalDual(TV).step(problem, state)

    def unrelaxed(new: np.ndarray, old: np.ndarray) -> np.ndarray:
        return (old + (new - old) / primal_dual.RELAXATION).ravel()

    early = primal_dual.EARLY_DATA_STEP if number <= primal_dual.EARLY else primal_dual.LEAST_DATA_STEP
    share = max(1 / number, early)
    tau, t = primal_dual.PRIMAL_STEP / np.sqrt(TV.norm_squared), 30.0 * share
    metric = np.eye(64) / tau + t * blur.T @ blur
    expected = u.ravel() - np.linalg.solve(metric, differences.T @ p.ravel() + blur.T @ q.ravel())
    assert unrelaxed(after.image, u) == pytest.approx(expected, abs=1e-5)
    assert after.blurred.ravel() == pytest.approx(blur @ after.image.ravel(), abs=1e-5)
    # Moreau: the proximal step of th* is what the one of h/t, a weighted mean of pixels, leaves.
    ahead, seen, f = q.ravel() + t * blur @ (2 * expected - u.ravel()), problem.seen.ravel(), problem.observed.ravel()
    nearest = (30.0 * seen * f + ahead) / (30.0 * seen + t)
    assert unrelaxed(after.data_dual, q) == pytest.approx(ahead - t * nearest, abs=2e-4)
    ascent = (p.ravel() + differences @ (2 * expected - u.ravel()) / (tau * TV.norm_squared)).reshape(2, 8, 8)
    assert unrelaxed(after.penalty_dual, p) == pytest.approx(project(ascent.astype(np.float32)).ravel(), abs=1e-4)
    assert after.adjoint == pytest.approx(adjoint(after.penalty_dual), abs=1e-5)
    assert after.number == number + 1


def test_the_start_is_that_of_dense_algebra():
    problem, u = small_problem(4, 30.0, margin=2), np.random.default_rng(5).random((8, 8)).astype(np.float32)
    start, blurred = PrimalDual(TV).start(problem, u), dense_blur(problem) @ u.ravel()
    s = 1 / (primal_dual.PRIMAL_STEP * np.sqrt(TV.norm_squared))
    assert start.blurred.ravel() == pytest.approx(blurred, abs=1e-5)
    assert start.data_dual == pytest.approx(30.0 * problem.seen * (start.blurred - problem.observed), abs=1e-4)
    assert start.penalty_dual == pytest.approx(project(s * gradient(u)), abs=1e-5)
    assert start.adjoint == pytest.approx(adjoint(start.penalty_dual), abs=1e-5)


def test_where_all_is_seen_the_first_step_solves_the_data_term_exactly():
    problem = small_problem(4, 30.0, margin=0)
    start = PrimalDual(TV).start(problem, np.random.default_rng(5).random((8, 8)).astype(np.float32))
    slope, blur = start.adjoint.copy(), dense_blur(problem)
    tau = primal_dual.PRIMAL_STEP / np.sqrt(TV.norm_squared)
    target = (start.image - tau * slope).ravel()
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
    graph = nonlocal_graph(problem.observed)
    regulariser = TV if penalty == "tv" else NonlocalPenalty(graph)
    found = solve(PrimalDual(regulariser), problem, 3000)
    blur = dense_blur(problem)
    if penalty == "tv":
        edges = dense(gradient, (8, 8)).reshape(2, 64, 64)
        owners = np.stack([np.arange(64)] * 2)
    else:
        edges = dense(lambda u: pairs.gradient(graph, u), (8, 8)).reshape(2, -1, 64)
        owners = np.stack([pairs.tails(graph), graph.heads])
    matrix, owners, seen = edges.reshape(-1, 64), owners.ravel(), problem.seen.ravel()

    def smoothed(u: np.ndarray) -> tuple[float, np.ndarray]:
        residual = seen * (blur @ u - problem.observed.ravel())
        differences = matrix @ u
        magnitude = np.sqrt(np.bincount(owners, differences**2, minlength=64) + 1e-8)
        slope = 20.0 * blur.T @ residual + matrix.T @ (differences / magnitude[owners])
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
    graph = nonlocal_graph(problem.observed)
    u = solve(PrimalDual(NonlocalPenalty(graph)), problem, 6000)
    magnitude = pairs.magnitude(graph, pairs.gradient(graph, u)).ravel().astype(np.float64)
    assert np.mean(magnitude > 0.01) > 0.5
    w = pairs.weight_matrix(graph)
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

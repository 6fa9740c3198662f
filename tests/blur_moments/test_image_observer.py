"""Observers on the whole image against general solvers; erratum 9 of the papers."""

from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares, minimize

from turbrestore.blur_moments.experiments.scenarios import mirror_setup, record, wavefront_setup
from turbrestore.blur_moments.moments import BlurModel
from turbrestore.blur_moments.sensor import GaussianKernel, LineSensor, expose
from turbrestore.blur_moments.state_estimation.image_observer import ImageFilter
from turbrestore.blur_moments.state_estimation.observers import run_observer, steady_kalman
from turbrestore.filtering.estimates import Gaussian

WAVES = wavefront_setup()
MODEL = WAVES.model
MIRROR = mirror_setup().model
START = Gaussian(np.zeros(2), steady_kalman(MODEL)[1])


def path_of(motion, state, inputs):
    return motion.path_and_jacobian(state, inputs)[0]


def image_of(model, state, inputs):
    return model.image_and_jacobian(state, inputs)[0]


class TestImageFilter:
    def test_map_is_the_minimum_that_scipy_finds(self):
        recording = record(replace(WAVES, frames=1), [1])
        frame, inputs = recording.frames[0, 0], recording.inputs[0, 0]
        after, innovation = ImageFilter().step(MODEL, START, frame, inputs)
        root, deviation = np.linalg.inv(np.linalg.cholesky(START.cov)), np.sqrt(0.1 / 0.02)

        def residuals(x):
            image = image_of(MODEL, x, inputs)
            return np.concatenate([(frame - image) / deviation, root @ x])

        best = min(
            (
                least_squares(residuals, s, x_scale=[0.1, 0.03], diff_step=1e-3)
                for s in np.vstack([np.zeros(2), 0.2 * np.eye(2), -0.2 * np.eye(2)])
            ),
            key=lambda fit: fit.cost,
        )
        spread = np.sqrt(np.diag(after.cov))
        np.testing.assert_allclose((after.mean - best.x) / spread, 0, atol=0.05)
        np.testing.assert_allclose(innovation.normalised_squared, 2 * best.cost, rtol=1e-3)

    def test_map_weighs_a_frame_against_a_prior_that_contradicts_it(self):
        rng, truth, mean = np.random.default_rng(2), np.array([0.5, 8.0]), np.array([0.42, 4.5])
        prior, inputs, sensor = Gaussian(mean, np.diag([0.02, 1.0]) ** 2), np.zeros(450), MIRROR.sensor
        deviation = sensor.deviation
        frame = expose(path_of(MIRROR.motion, truth, inputs), sensor.kernel, sensor.pixels)
        frame = frame + deviation * rng.standard_normal(frame.shape)
        after, _ = ImageFilter().step(MIRROR, prior, frame, inputs)

        def cost(x):
            misfit = (frame - image_of(MIRROR, x, inputs)) / deviation
            return misfit @ misfit + ((x - mean) ** 2 / np.diag(prior.cov)).sum()

        best = minimize(cost, mean, method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-9}).x
        spread = np.sqrt(np.diag(after.cov))
        np.testing.assert_allclose((after.mean - best) / spread, 0, atol=0.06)
        assert (np.abs(after.mean - mean) > 2 * spread).any()

    def test_search_converges_from_around_the_truth(self):
        quiet = BlurModel(MIRROR.motion, LineSensor(MIRROR.sensor.kernel, MIRROR.sensor.pixels, noise=1e-4))
        truth, inputs = np.array([0.8, 10.0]), np.zeros((50, 450))
        frame = expose(path_of(quiet.motion, truth, inputs[0]), quiet.sensor.kernel, quiet.sensor.pixels)
        starts = truth + np.random.default_rng(0).normal(size=(50, 2)) * [0.15, 5.0]
        prior = Gaussian(starts, np.diag([0.3, 10.0]) ** 2)
        after, _ = ImageFilter("two").step(quiet, prior, np.tile(frame, (50, 1)), inputs)
        np.testing.assert_allclose(after.mean, np.tile(truth, (50, 1)), rtol=0.01)

    def test_without_a_prior_the_covariance_is_that_of_the_frame(self):
        recording = record(replace(mirror_setup(), frames=1), [3])
        start = Gaussian(recording.states[0, 0, :2], np.diag([0.1, 3.0]) ** 2)
        after, _ = ImageFilter("two").step(MIRROR, start, recording.frames[0, 0], recording.inputs[0, 0])
        derivative = MIRROR.image_and_jacobian(after.mean, recording.inputs[0, 0])[1] / MIRROR.sensor.deviation
        np.testing.assert_allclose(after.cov, np.linalg.inv(derivative @ derivative.T), rtol=1e-4)

    def test_infinity_norm_comes_close_to_the_minimum(self):
        recording = record(replace(mirror_setup(), frames=1), [3])
        frame, inputs, truth = recording.frames[0, 0], recording.inputs[0, 0], recording.states[0, 0, :2]
        start = Gaussian(truth, np.diag([0.1, 3.0]) ** 2)
        after, _ = ImageFilter("infinity").step(MIRROR, start, frame, inputs)

        def largest(x):
            return np.abs(frame - image_of(MIRROR, x, inputs)).max()

        best = minimize(largest, truth, method="Nelder-Mead").fun
        assert largest(after.mean) < 1.03 * best

    def test_starts_find_the_other_sign(self, monkeypatch):
        quiet = BlurModel(MIRROR.motion, LineSensor(MIRROR.sensor.kernel, MIRROR.sensor.pixels, noise=1e-4))
        truth, inputs = np.array([0.8, 10.0]), np.zeros(450)
        frame = expose(path_of(quiet.motion, truth, inputs), quiet.sensor.kernel, quiet.sensor.pixels)
        prior = Gaussian(-truth, np.diag([0.3, 10.0]) ** 2)
        several, _ = ImageFilter("two").step(quiet, prior, frame, inputs)
        starts = "turbrestore.blur_moments.state_estimation.image_observer._starts"
        monkeypatch.setattr(starts, lambda mean, cov: mean[:, None, :])
        alone, _ = ImageFilter("two").step(quiet, prior, frame, inputs)
        assert np.abs(alone.mean - truth)[0] > 0.1
        np.testing.assert_allclose(several.mean, truth, rtol=0.02)

    def test_plant_is_learnt(self):
        setup = replace(mirror_setup(deviation=7.0), frames=15)
        recording = record(setup, range(4))
        cov = np.diag([0.3, 10.0, 0.4, 0.15, 0.35]) ** 2
        model = BlurModel(setup.truth, MIRROR.sensor)
        start = Gaussian(np.zeros((4, 5)), cov)
        results = run_observer(ImageFilter(), model, start, recording.frames, recording.inputs)
        away = results[-1][0].mean[:, 2:] - recording.states[-1, :, 2:]
        assert np.sqrt(np.mean(away**2)) < 0.4 * np.sqrt(np.mean(recording.states[-1, :, 2:] ** 2))

    def test_erratum_9_both_norms_of_paper_2(self):
        # A kernel that differs from the model's leaves a misfit where the light is.
        truth, inputs = np.array([0.8, 10.0]), np.random.default_rng(0).normal(size=450)
        frame = expose(path_of(MIRROR.motion, truth, inputs), GaussianKernel(0.16), MIRROR.sensor.pixels)
        start = Gaussian(truth + np.array([0.05, 2.0]), np.diag([0.3, 10.0]) ** 2)
        found = {n: ImageFilter(n).step(MIRROR, start, frame, inputs)[0].mean for n in ("two", "infinity")}
        misfits = {n: frame - image_of(MIRROR, x, inputs) for n, x in found.items()}
        assert np.linalg.norm(misfits["two"]) < np.linalg.norm(misfits["infinity"])
        assert np.abs(misfits["infinity"]).max() < np.abs(misfits["two"]).max()

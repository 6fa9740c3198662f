"""Lifting and the Jacobians of the moments; errata 7 and 8 of the blur-moments papers."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from turbrestore.blur_moments.moments import BlurModel, image_moments, predicted_moments
from turbrestore.blur_moments.sensor import ExposureTiming, GaussianKernel, LineSensor, PixelGrid, expose
from turbrestore.blur_moments.state_estimation.lifting import FastSystem, discretise, is_observable, lift
from turbrestore.core.errors import ConfigurationError, DataError
from turbrestore.filtering.estimates import Gaussian

TIMING = ExposureTiming(1e-3, 0.1, 0.35, 0.45, 0.09)
PAPER_2 = np.array([[0.0, -1156.0], [1.0, -13.6]]), np.array([1156.0, 0.0]), np.array([0.0, 1.0])


def path_of(motion, state, inputs):
    return motion.path_and_jacobian(state, inputs)[0]


def simulate(system, state, inputs):
    """Outputs and final state, one fast step after the other."""
    outputs = []
    for u in inputs:
        outputs.append(system.C @ state)
        state = system.A @ state + system.B * u
    return np.array(outputs), state


def random_system(seed, n=3):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n))
    A *= 0.95 / np.abs(np.linalg.eigvals(A)).max()
    return FastSystem(A, rng.normal(size=n), rng.normal(size=n)), rng


class TestLift:
    @given(st.integers(0, 1000))
    @settings(max_examples=25, deadline=None)
    def test_equals_the_simulation(self, seed):
        system, rng = random_system(seed)
        timing = ExposureTiming(1.0, 5.0, 3.0, 9.0)
        lifted = lift(system, timing, np.eye(3))
        state, inputs = rng.normal(size=3), rng.normal(size=9)
        outputs, end = simulate(system, state, inputs)
        np.testing.assert_allclose(path_of(lifted, state, inputs), outputs[:5], atol=1e-9)
        np.testing.assert_allclose(lifted.A @ state + lifted.B @ inputs, end, atol=1e-9)
        np.testing.assert_allclose(lifted.C @ state + lifted.D @ inputs, outputs[:5].mean(), atol=1e-9)
        ahead = lifted.advance(Gaussian(state, np.eye(3)), inputs)
        np.testing.assert_allclose(ahead.mean, end, atol=1e-9)
        np.testing.assert_allclose(ahead.cov, lifted.A @ lifted.A.T + np.eye(3), atol=1e-9)
        fast, slopes = lifted.path_and_jacobian(state, inputs, 9)
        np.testing.assert_allclose(fast, outputs, atol=1e-9)
        np.testing.assert_array_equal(slopes, lifted.free)

    def test_erratum_7_printed_matrices_and_where_the_input_enters(self):
        A, B = discretise([[0, 1], [-20, -30]], [0, 20], 1e-3)
        np.testing.assert_allclose(A, [[1.0000, 0.0010], [-0.0197, 0.9704]], atol=5e-5)
        assert B[1] == pytest.approx(0.0197, abs=5e-5)
        system = FastSystem(A, B, [1.0, 0.0])
        lifted = lift(system, ExposureTiming(1e-3, 0.2, 0.0, 0.2), np.eye(2))
        inputs = np.random.default_rng(0).normal(size=401)
        j, N = 2, 200
        _, end = simulate(system, np.zeros(2), inputs[(j - 1) * N : j * N])
        corrected = sum(np.linalg.matrix_power(A, i) @ B * inputs[j * N - 1 - i] for i in range(N))
        printed = sum(np.linalg.matrix_power(A, i) @ B * inputs[j * N - i] for i in range(N))
        np.testing.assert_allclose(corrected, end, atol=1e-12)
        np.testing.assert_allclose(lifted.B @ inputs[N : 2 * N], end, atol=1e-12)
        assert np.linalg.norm(printed - end) > 0.05 * np.linalg.norm(end)

    def test_erratum_8_the_printed_mirror_is_continuous(self):
        A, B, C = PAPER_2
        np.testing.assert_allclose(np.sort_complex(np.linalg.eigvals(A)), [-6.8 - 33.3131j, -6.8 + 33.3131j], atol=1e-3)
        assert C @ np.linalg.solve(-A, B) == pytest.approx(1.0)
        with pytest.raises(ConfigurationError, match="^A: expected a stable system"):
            FastSystem(A, B, C)
        held_A, held_B = discretise(A, B, 1e-3)
        np.testing.assert_allclose(held_A, [[0.99942, -1.14795], [0.00099304, 0.98592]], rtol=1e-5)
        np.testing.assert_allclose(held_B, [1.15578, 0.00057533], rtol=1e-5)

    def test_erratum_8_printed_output_matrices(self):
        A, B = discretise(PAPER_2[0], PAPER_2[1], 1e-3)
        C, N_e = PAPER_2[2], 100
        system = FastSystem(A, B, C)
        lifted = lift(system, TIMING, np.eye(2))
        powers = [C @ np.linalg.matrix_power(A, i) for i in range(N_e + 1)]
        printed_C = sum(powers[:N_e])
        np.testing.assert_allclose(printed_C / N_e, lifted.C, atol=1e-12)
        assert np.linalg.norm(printed_C - lifted.C) > 50 * np.linalg.norm(lifted.C)
        # The printed sums up to N_e − 1 − n belong to the steps 1 … N_e, not to 0 … N_e − 1.
        printed_D = np.array([sum(powers[: N_e - n]) @ B for n in range(N_e)]) / N_e
        corrected_D = np.array([sum(powers[: N_e - 1 - n], np.zeros(2)) @ B for n in range(N_e)]) / N_e
        np.testing.assert_allclose(lifted.D[:N_e], corrected_D, atol=1e-12)
        assert not lifted.D[N_e:].any()
        inputs = np.random.default_rng(1).normal(size=450) + 1.0
        outputs, _ = simulate(system, np.zeros(2), inputs)
        assert lifted.D @ inputs == pytest.approx(outputs[:N_e].mean())
        assert printed_D @ inputs[:N_e] == pytest.approx(outputs[1 : N_e + 1].mean())
        assert abs(printed_D @ inputs[:N_e] - outputs[:N_e].mean()) > 1e-3

    def test_observability_is_not_inherited(self):
        # A slow step of half a period makes A_s a multiple of the identity.
        frequency = np.pi / 0.45
        A, B = discretise([[0.0, 1.0], [-(frequency**2), 0.0]], [0.0, 1.0], 1e-3)
        system = FastSystem(A, B, [1.0, 0.0])
        assert is_observable(A, system.C)
        with pytest.raises(ConfigurationError, match="not observable"):
            lift(system, TIMING, np.eye(2))
        assert is_observable(lift(system, ExposureTiming(1e-3, 0.1, 0.2, 0.3), np.eye(2)).A, system.C)

    def test_mirror_that_forgets_within_a_step_is_observable(self):
        A, B = discretise(PAPER_2[0], PAPER_2[1], 1e-3)
        lifted = lift(FastSystem(A, B, PAPER_2[2]), TIMING, np.eye(2))
        assert np.abs(np.linalg.eigvals(lifted.A)).max() < 0.05

    @pytest.mark.parametrize(
        ("make", "named"),
        [
            (lambda: FastSystem([[1.01]], [1.0], [1.0]), "A"),
            (lambda: FastSystem([[0.5, 0.0]], [1.0], [1.0]), "system"),
            (lambda: FastSystem([[np.nan]], [1.0], [1.0]), "system"),
            (lambda: FastSystem(np.zeros((0, 0)), [], []), "system"),
            (lambda: discretise([[np.nan]], [1.0], 1e-3), "system"),
            (lambda: discretise([1.0], 1.0, 1e-3), "system"),
            (lambda: lift(FastSystem([[0.5]], [1.0], [0.0]), TIMING, [[1.0]]), "system"),
            (lambda: lift(FastSystem([[0.5]], [1.0], [1.0]), TIMING, [1.0]), "Q"),
            (lambda: discretise([[1.0]], [1.0], 0.0), "period"),
        ],
    )
    def test_bad_input_is_named_in_one_line(self, make, named):
        with pytest.raises(ConfigurationError, match=f"^{named}: expected [^\n]*$"):
            make()

    @pytest.mark.parametrize(
        ("order", "inputs", "named"),
        [(2, [1.0, 2.0], "input"), (2, [1.0, np.nan, 1.0], "input"), (3, [0] * 3, "state")],
    )
    def test_inputs_and_states_of_another_system(self, order, inputs, named):
        motion = lift(random_system(0, n=2)[0], ExposureTiming(1.0, 2.0, 1.0, 3.0), np.eye(2))
        with pytest.raises(DataError, match=f"^{named}: expected [^\n]*$"):
            BlurModel(motion, None).check_inputs(Gaussian(np.zeros(order), np.eye(order)), inputs)


class TestJacobians:
    @pytest.mark.parametrize("basis", ["monomial", "legendre"])
    def test_of_the_moments(self, basis):
        system, rng = random_system(3)
        lifted = lift(system, ExposureTiming(1.0, 6.0, 1.0, 7.0), np.eye(3))
        pixels = PixelGrid(-2.0, 2.5, 90)
        model = BlurModel(lifted, LineSensor(GaussianKernel(0.4, 0.1), pixels, noise=0.1))
        state, inputs = 0.3 * rng.normal(size=3), 0.1 * rng.normal(size=7)
        orders = (1, 2, 3, 4)

        def moments(mean):
            return predicted_moments(model, mean, inputs, orders, basis)[0]

        h, H, _ = predicted_moments(model, state, inputs, orders, basis)
        image = expose(path_of(lifted, state, inputs), model.sensor.kernel, pixels)
        np.testing.assert_allclose(h, image_moments(image, pixels, 4, basis)[1:], atol=0.005)
        for k in range(3):
            shift = 1e-5 * np.eye(3)[k]
            slope = (moments(state + shift) - moments(state - shift)) / 2e-5
            np.testing.assert_allclose(H[:, k], slope, atol=1e-7 * np.abs(slope).max())

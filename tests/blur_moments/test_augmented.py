"""The oscillator whose plant is part of its state, against the lifted system and differences."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from turbrestore.blur_moments.sensor import ExposureTiming
from turbrestore.blur_moments.state_estimation.augmented import Oscillator, OscillatorMotion
from turbrestore.blur_moments.state_estimation.lifting import FastSystem, discretise, lift
from turbrestore.core.errors import ConfigurationError
from turbrestore.filtering.estimates import Gaussian

TIMING = ExposureTiming(1e-3, 0.1, 0.35, 0.45, 0.09)


def path_of(motion, state, inputs):
    return motion.path_and_jacobian(state, inputs)[0]


class TestOscillator:
    @pytest.mark.parametrize("damping", [0.2, 0.999, 1.0, 3.0])
    def test_equals_the_lifted_system(self, damping):
        gain, omega = 1.2, 30.0
        motion = OscillatorMotion(Oscillator(1.0, 34.0, 0.2), TIMING, np.zeros((5, 5)))
        logs = np.log([gain, omega / 34.0, damping / 0.2])
        A, B = discretise([[0, 1], [-(omega**2), -2 * damping * omega]], [0, gain * omega**2], 1e-3)
        lifted = lift(FastSystem(A, B, [1.0, 0.0]), TIMING, np.eye(2))
        state, inputs = np.array([0.3, 4.0]), np.random.default_rng(0).normal(size=450)
        whole = np.concatenate([state, logs])
        # Critical damping is replaced by one that differs by 1e-6 of ω².
        np.testing.assert_allclose(path_of(motion, whole, inputs), path_of(lifted, state, inputs), atol=1e-5)
        still = Gaussian(whole, np.zeros((5, 5)))
        end = motion.advance(still, inputs).mean
        np.testing.assert_allclose(end[:2], lifted.A @ state + lifted.B @ inputs, atol=1e-4)
        np.testing.assert_allclose(end[2:], logs)
        fast, expected = (
            system.path_and_jacobian(start, inputs, 450)[0] for system, start in ((motion, whole), (lifted, state))
        )
        np.testing.assert_allclose(fast, expected, atol=1e-5)

    @given(st.integers(0, 1000))
    @settings(max_examples=20, deadline=None)
    def test_jacobians(self, seed):
        rng = np.random.default_rng(seed)
        motion = OscillatorMotion(Oscillator(1.0, 34.0, 0.2), TIMING, np.zeros((5, 5)))
        state = np.array([0.5, 8.0, 0.5, 0.3, 1.5]) * rng.uniform(-1, 1, 5)
        inputs = rng.normal(size=450)
        _, slopes = motion.path_and_jacobian(state, inputs)
        numeric, ends = [], []
        for shift in 1e-5 * np.eye(5):
            sides = [state + shift, state - shift]
            numeric.append((path_of(motion, sides[0], inputs) - path_of(motion, sides[1], inputs)) / 2e-5)
            moved = [motion.advance(Gaussian(side, np.eye(5)), inputs).mean for side in sides]
            ends.append((moved[0] - moved[1]) / 2e-5)
        scale = np.abs(slopes).max()
        np.testing.assert_allclose(slopes, np.stack(numeric, -1), atol=1e-6 * scale)
        F = np.stack(ends, -1)
        cov = motion.advance(Gaussian(state, np.eye(5)), inputs).cov
        np.testing.assert_allclose(cov, F @ F.T, atol=1e-6 * np.abs(cov).max())

    def test_batches(self):
        rng = np.random.default_rng(1)
        motion = OscillatorMotion(Oscillator(1.0, 34.0, 0.2), TIMING, 1e-3 * np.eye(5))
        states, inputs = 0.1 * rng.normal(size=(4, 5)), rng.normal(size=(4, 450))
        paths = path_of(motion, states, inputs)
        np.testing.assert_allclose(paths[2], path_of(motion, states[2], inputs[2]), atol=1e-12)
        one = motion.advance(Gaussian(states[2], np.eye(5)), inputs[2])
        all_of_them = motion.advance(Gaussian(states, np.eye(5)), inputs)
        np.testing.assert_allclose(all_of_them.cov[2], one.cov, atol=1e-9)

    @pytest.mark.parametrize(
        ("make", "named"),
        [
            (lambda: Oscillator(1.0, 34.0, 0.0), "damping"),
            (lambda: OscillatorMotion(Oscillator(1.0, 34.0, 0.2), TIMING, np.eye(2)), "Q"),
        ],
    )
    def test_bad_input_is_named_in_one_line(self, make, named):
        with pytest.raises(ConfigurationError, match=f"^{named}: expected [^\n]*$"):
            make()

"""Simulated recordings of both set-ups."""

import numpy as np
import pytest

from turbrestore.blur_moments.experiments.scenarios import (
    MirrorParams,
    WavefrontParams,
    largest_deviation,
    mirror_oscillator,
    record_mirror,
    record_wavefront,
    wavefront_model,
)
from turbrestore.blur_moments.sensor import expose
from turbrestore.blur_moments.state_estimation.augmented import Oscillator
from turbrestore.core.errors import ConfigurationError


class TestRecordings:
    def test_runs_are_functions_of_their_seed(self):
        params = WavefrontParams(frames=3, burn_in=0)
        alone, among = record_wavefront([5], params), record_wavefront([1, 5, 9], params)
        # Products of matrices may round differently in a batch of another size.
        np.testing.assert_allclose(alone.frames[:, 0], among.frames[:, 1], atol=1e-12)
        assert not np.allclose(among.frames[:, 0], among.frames[:, 1])
        again = record_mirror([5], MirrorParams(frames=2, burn_in=0))
        np.testing.assert_array_equal(again.frames, record_mirror([5], MirrorParams(frames=2, burn_in=0)).frames)

    def test_frames_are_exposures_of_the_outputs(self):
        quiet = WavefrontParams(frames=2, burn_in=0, noise=1e-12)
        recording, model = record_wavefront([3], quiet), wavefront_model(quiet)
        image = expose(recording.outputs[1, 0], model.sensor.kernel, model.sensor.pixels)
        np.testing.assert_allclose(recording.frames[1, 0], image, atol=1e-3)

    def test_plants_stay_within_their_bounds(self):
        params = MirrorParams(frames=1, burn_in=0, deviation=5.0)
        plants = record_mirror(range(40), params).states[0, :, 2:]
        found = np.array([largest_deviation(plant, mirror_oscillator().nominal) for plant in plants])
        assert found.max() <= 5.0
        assert found.max() > 4.0

    def test_deviation_of_a_plant(self):
        nominal = Oscillator(1.0, 34.0, 0.2)
        assert largest_deviation(np.log([2.0, 1.0, 1.0]), nominal) == pytest.approx(6.02, abs=0.01)
        # Twice the damping halves the response at resonance; at 5.4 Hz one of the compared frequencies comes close.
        assert largest_deviation(np.log([1.0, 1.0, 2.0]), nominal) == pytest.approx(6.02, abs=0.1)
        assert largest_deviation(np.zeros(3), nominal) == 0


@pytest.mark.parametrize(
    "make",
    [
        lambda: WavefrontParams(frames=10, burn_in=10),
        lambda: WavefrontParams(slope_disturbance=0.0),
        lambda: WavefrontParams(pixels=4),
        lambda: WavefrontParams(noise=0.0),
        lambda: WavefrontParams(kernel_width=1e-6),
        lambda: WavefrontParams(low_tone=float("nan")),
        lambda: MirrorParams(amplitude=float("inf")),
        lambda: MirrorParams(deviation=8.0),
        lambda: MirrorParams(rate_disturbance=float("nan")),
    ],
)
def test_settings_that_make_no_sense(make):
    with pytest.raises(ConfigurationError, match="^[a-z_]+: expected [^\n]*$"):
        make()

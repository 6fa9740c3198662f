"""Simulated recordings of both set-ups."""

from dataclasses import replace

import numpy as np
import pytest

from turbrestore.blur_moments.experiments.scenarios import largest_deviation, mirror_setup, record, wavefront_setup
from turbrestore.blur_moments.sensor import LineSensor, expose
from turbrestore.blur_moments.state_estimation.augmented import Oscillator
from turbrestore.core.errors import ConfigurationError


def test_runs_are_functions_of_their_seed():
    setup = replace(wavefront_setup(), frames=3)
    alone, among = record(setup, [5]), record(setup, [1, 5, 9])
    # Products of matrices may round differently in a batch of another size.
    np.testing.assert_allclose(alone.frames[:, 0], among.frames[:, 1], atol=1e-12)
    assert not np.allclose(among.frames[:, 0], among.frames[:, 1])
    np.testing.assert_array_equal(alone.frames, record(setup, [5]).frames)


def test_frames_are_exposures_of_the_outputs():
    setup = replace(wavefront_setup(), frames=2)
    sensor = LineSensor(setup.model.sensor.kernel, setup.model.sensor.pixels, noise=1e-12)
    recording = record(replace(setup, model=replace(setup.model, sensor=sensor)), [3])
    image = expose(recording.outputs[1, 0], sensor.kernel, sensor.pixels)
    np.testing.assert_allclose(recording.frames[1, 0], image, atol=1e-3)


def test_plants_stay_within_their_bounds():
    setup = replace(mirror_setup(5.0), frames=1)
    plants = record(setup, range(40)).states[0, :, 2:]
    found = np.array([largest_deviation(plant, setup.truth.nominal) for plant in plants])
    assert found.max() <= 5.0
    assert found.max() > 4.0
    assert not record(replace(mirror_setup(), frames=1), [3]).states[0, :, 2:].any()


def test_deviation_of_a_plant():
    nominal = Oscillator(1.0, 34.0, 0.2)
    assert largest_deviation(np.log([2.0, 1.0, 1.0]), nominal) == pytest.approx(6.02, abs=0.01)
    # Twice the damping halves the response at resonance; at 5.4 Hz one of the compared frequencies comes close.
    assert largest_deviation(np.log([1.0, 1.0, 2.0]), nominal) == pytest.approx(6.02, abs=0.1)
    assert largest_deviation(np.zeros(3), nominal) == 0


def test_settings_that_make_no_sense():
    for make in (lambda: wavefront_setup(0.0), lambda: wavefront_setup(float("nan")), lambda: mirror_setup(8.0)):
        with pytest.raises(ConfigurationError, match="^[a-z_]+: expected [^\n]*$"):
            make()

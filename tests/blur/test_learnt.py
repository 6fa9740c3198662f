"""Networks that tell the blur to remove: their evaluation, what they read, and what follows from the gains."""

import re
from importlib.resources import files

import cv2
import numpy as np
import pytest

from turbrestore.blur.learnt import FACTORS, LearntBlur, learnt_blur
from turbrestore.blur.posterior import BlurWitnesses, estimate_posterior, measure_witnesses
from turbrestore.blur.witnesses.two_tones import TwoTones
from turbrestore.core.noise_spectrum import white_noise
from turbrestore.synthesis.scenes import SCENES

FEATURES, INNER, NETWORKS = 5, 4, 3


def networks_of(log_width, spread, gains):
    """Networks that say the same whatever they read; gains (factors)."""
    out = np.concatenate([[log_width, spread], gains])
    shapes = {"1": (INNER, FEATURES), "2": (INNER, INNER), "3": (len(out), INNER)}
    weights = {f"w{layer}": np.zeros((NETWORKS, *shape)) for layer, shape in shapes.items()}
    weights |= {"b1": np.zeros((NETWORKS, INNER)), "b2": np.zeros((NETWORKS, INNER)), "b3": np.tile(out, (NETWORKS, 1))}
    return weights | {"middle": np.zeros(FEATURES), "scale": np.ones(FEATURES)}


def peak_at(factor, height=2.0):
    return np.where(FACTORS > 0, height - 8 * np.log(np.maximum(FACTORS, 0.1) / factor) ** 2, 0.0)


def blur_of(weights, low=1.0, usual=1.0, alone=1.0):
    """What networks say where these are two quantiles of the posterior and the width by the image alone."""
    return learnt_blur(np.zeros(FEATURES), np.array([low, usual, 2 * usual]), alone, weights)


def test_the_widest_blur_of_the_largest_gain_is_chosen_up_to_its_width():
    # Gains between widths are linear: the parabola has fallen by 0.111 dB at 0.9, by 0.398 at 1, so by 0.2 at 0.931.
    for factor, width, expected in ((0.8, 2.0, 0.931), (0.8, 0.82, 0.82), (1.35, 1.0, 1.35)):
        found = blur_of(networks_of(np.log(width), np.log(0.2), peak_at(factor)), low=1.0, usual=1.7, alone=50.0)
        assert found.median == pytest.approx(1.7 * expected, rel=0.012)
        np.testing.assert_allclose(found.width, 1.7 * width * np.exp(0.2 * np.array([-1, 0, 1])))


def test_a_gain_that_peaks_between_the_widths_tried_is_not_missed():
    gains = np.interp(FACTORS, [0.8, 0.9, 1.0, 1.15, 1.35], [0, 3.5, 5, 1, -3], left=0)
    assert blur_of(networks_of(0.0, -1.0, gains)).median == pytest.approx(1.0, rel=0.01)


@pytest.mark.parametrize(
    ("low", "alone", "removed"),
    [
        (0.64, 0.3, 0.8),
        (0.64, 0.9, 0.9),
        (0.64, 50.0, 1.0),
        (0.64, 0.0, 0.8),
        (1.44, 0.3, 1.0),
        (1.44, 0.0, 1.0),
        (1.44, 50.0, 1.2),
    ],
)
def test_the_median_of_three_widths_is_removed(low, alone, removed):
    found = blur_of(networks_of(0.0, -1.0, peak_at(1.0)), low, 1.0, alone)
    assert found.median == pytest.approx(removed, rel=0.01)


def test_the_narrower_width_is_removed_where_the_median_loses():
    # Beyond a factor of 1.1 a loss is expected.  The image is wide, so the median is the wider of the other two.
    gains = np.interp(FACTORS, [0, 1, 1.1, 1.2], [0, 1, 0, -1])
    found = blur_of(networks_of(0.0, -1.0, gains), low=1.44, alone=1.3)
    assert found.median == found.cautious == pytest.approx(1.0, rel=0.01)
    only_wide = np.interp(FACTORS, [0, 0.9, 1, 1.1, 1.2], [0, -1, 1, 0, -1])
    assert blur_of(networks_of(0.0, -1.0, only_wide), low=0.64, alone=0.0).median == 0.0


def test_nothing_is_removed_where_a_loss_is_expected():
    # The mean of 1 and 0.36 is 0.6, where the parabola has fallen by 8 ln² 0.6 = 2.1 dB.
    for height, low, removed in ((2.2, 0.36, 0.6), (1.9, 0.36, 0.0), (1.9, 1.0, 1.0), (-0.2, 1.0, 0.0)):
        found = blur_of(networks_of(0.0, -1.0, peak_at(1.0, height)), low=low, alone=0.3)
        assert found.median == pytest.approx(removed, rel=0.03)


def test_where_all_widths_gain_alike_the_measured_one_is_removed():
    assert blur_of(networks_of(0.0, -1.0, np.zeros(len(FACTORS)))).median == pytest.approx(1.0, rel=0.02)


def test_scatter_of_the_networks_widens_the_interval():
    weights = networks_of(0.0, np.log(0.2), peak_at(1.0))
    narrow = blur_of(weights).width
    weights["b3"][:, 0] = [-0.3, 0.0, 0.3]
    wide = blur_of(weights).width
    assert np.log(wide[2]) == pytest.approx(np.hypot(0.2, np.std([-0.3, 0, 0.3])), rel=1e-6)
    assert narrow[1] == wide[1] == 1


def test_layers_are_those_of_a_perceptron():
    rng, weights = np.random.default_rng(0), networks_of(0.0, -1.0, peak_at(1.0))
    weights = {name: rng.normal(0, 0.3, values.shape) for name, values in weights.items()} | {
        "scale": np.ones(FEATURES)
    }
    x = rng.normal(0, 1, FEATURES)

    def silu(values):
        return values / (1 + np.exp(-values))

    logs = []
    for number in range(NETWORKS):
        w1, w2, w3 = (weights[f"w{layer}"][number] for layer in (1, 2, 3))
        b1, b2, b3 = (weights[f"b{layer}"][number] for layer in (1, 2, 3))
        logs.append((w3 @ silu(w2 @ silu(w1 @ (x - weights["middle"]) + b1) + b2) + b3)[0])
    assert np.log(learnt_blur(x, np.ones(3), 1.0, weights).width[1]) == pytest.approx(np.mean(logs))


def test_what_is_not_known_is_taken_for_usual():
    weights = networks_of(0.0, -1.0, peak_at(1.0))
    weights["w1"][:] = weights["w2"][:] = weights["w3"][:] = 0.3
    weights["middle"] = np.arange(FEATURES, dtype=float)
    known = learnt_blur(weights["middle"], np.ones(3), 1.0, weights)
    unknown = learnt_blur(np.full(FEATURES, np.nan), np.ones(3), 1.0, weights)
    np.testing.assert_array_equal(known.width, unknown.width)


@pytest.mark.parametrize("side", [40, 128])
def test_networks_read_what_is_measured(side):
    rng = np.random.default_rng(0)
    scene = cv2.GaussianBlur(SCENES["camera"](side, side), (0, 0), 1.2)
    frames = (scene + rng.normal(0, 0.01, (8, side, side))).astype(np.float32)
    known = BlurWitnesses(0.0, 8.0)
    measured = measure_witnesses(frames, np.zeros((*frames.shape, 2), np.float32), frames.mean(0), known)
    assert (measured.variation is None) == (side == 40)
    for witnesses in (measured, known):
        _, found = estimate_posterior(frames.mean(axis=0), witnesses, white_noise(0.01 / 8**0.5))
        assert np.isfinite(found.width).all() and found.removed >= 0
        assert (np.diff(found.width) > 0).all() and 0.4 < found.width[1] < 4


def test_the_file_of_the_weights_is_small_and_says_what_it_is_of():
    path = files("turbrestore.blur").joinpath("learnt_blur.npz")
    assert len(path.read_bytes()) < 300_000
    with path.open("rb") as stream, np.load(stream) as held:
        assert re.search(r"revision \w+, .*blur_training\.py train, \d+ clips; \| a fifth", str(held["about"]))


def test_the_image_alone_has_a_say_where_the_scene_may_have_two_tones():
    narrow, wide = (LearntBlur(np.array([0.8, 1.0, 1.2]) * width, 1.1, 0.9) for width in (1.0, 4.0))
    text, photograph = TwoTones(1.0, 0.2, 0.1), TwoTones(1.0, 0.0, 0.1)
    assert [narrow.chosen(tones) for tones in (text, photograph, None)] == [1.1, 0.9, 0.9]
    # Behind a wide blur, tiles do not show whether a scene has two tones.
    assert [wide.chosen(tones) for tones in (text, photograph, None)] == [1.1, 1.1, 0.9]

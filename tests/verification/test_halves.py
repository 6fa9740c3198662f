"""Detail that the halves of a clip do not agree on is that of the registered mean; what they agree on stays."""

import cv2
import numpy as np

from turbrestore.core.arrays import luminance
from turbrestore.core.noise import NoiseCurve
from turbrestore.core.noise_spectrum import RINGS, NoiseSpectrum
from turbrestore.metrics import psnr
from turbrestore.registration.registered_noise import Halves
from turbrestore.synthesis.scenes import SCENES
from turbrestore.verification.halves import keep_agreed

NOISE = 0.02


def halves_of(scene, seed=0, noise=NOISE):
    rng = np.random.default_rng(seed)
    return Halves(*(np.float32(scene + rng.normal(0, noise, scene.shape)) for _ in range(2)))


def guarded_by(result, halves, **settings):
    compared = Halves(luminance(halves.first), luminance(halves.second))
    return keep_agreed(result, halves.mean, halves.noise(), [compared], **settings)


def test_what_the_halves_agree_on_stays():
    scene = SCENES["brick"](96, 96)
    guarded = guarded_by(scene, halves_of(0.5 + 0.5 * (scene - 0.5), noise=0.002))
    assert np.abs(guarded.image - scene).max() < 0.01
    assert guarded.decisions == ()


def test_only_what_is_beyond_full_scale_is_clipped():
    scene = SCENES["brick"](96, 96)
    scene[40, 40] = 3
    halves = Halves(scene, scene.copy())
    assert guarded_by(scene, halves).image.max() == 1
    assert np.abs(guarded_by(scene, halves, full_scale=(-4.0, 5.0)).image - scene).max() < 1e-5


def test_amplified_noise_in_flat_parts_gives_way_and_edges_stay():
    scene = np.full((96, 96), 0.4, np.float32)
    scene[:, 48:] = 0.8
    halves = halves_of(scene)
    mean = (halves.first + halves.second) / 2
    noisy = scene + 4 * (mean - scene)
    guarded = guarded_by(noisy, halves)
    flat = np.s_[:, :30]
    assert guarded.image[flat].std() < 1.2 * mean[flat].std() < 0.4 * noisy[flat].std()
    assert psnr(guarded.image, scene) > psnr(noisy, scene) + 5
    edge = np.diff(guarded.image[:, 44:52], axis=1).max(axis=1)
    assert np.median(edge) > 0.35
    assert guarded.share[flat].mean() > 0.5
    assert guarded.decisions[0].subject == "agreement"


def test_a_result_that_is_smoother_than_the_mean_stays():
    flat = np.full((64, 64, 3), 0.5, np.float32)
    guarded = guarded_by(flat, halves_of(flat))
    assert np.abs(guarded.image - flat).max() < 1e-5


def test_colours_are_those_of_the_mean_and_detail_stays():
    scene = 0.1 + 0.8 * np.repeat(SCENES["brick"](96, 96)[..., None], 3, axis=2)
    tinted = scene + np.float32([0.03, 0, -0.03])
    guarded = guarded_by(tinted, Halves(scene, scene.copy()))
    # Luminance stays, to which red adds more than blue.
    assert np.abs(guarded.image - scene).max() < 0.01 and np.ptp(guarded.image - scene, axis=2).max() < 1e-4
    assert guarded.share.min() == 1
    slightly = scene + np.float32([0.003, 0, -0.003])
    assert np.abs(guarded_by(slightly, Halves(scene, scene.copy())).image - slightly).max() < 1e-5


def plate(noise=NOISE):
    """Scene, halves behind a blur, and flat parts from three pixels beside an edge on."""
    scene = np.full((96, 96), 0.3, np.float32)
    scene[:, 40:60] = 0.7
    columns = np.arange(96)
    flat = (np.abs(columns - 39.5) >= 4) & (np.abs(columns - 59.5) >= 4)
    return scene, halves_of(cv2.GaussianBlur(scene, (0, 0), 0.8), noise=noise), flat


def test_rings_behind_an_edge_in_a_flat_part_give_way_and_the_edge_stays():
    scene, halves, flat = plate(noise=0.002)
    distance = np.abs(np.arange(96) - 39.5)
    rings = 0.03 * np.cos(np.pi * distance / 2.5) * np.exp(-distance / 8) * (distance > 2)
    ringing = np.float32(scene + rings)
    guarded = guarded_by(ringing, halves)
    before, after = (np.abs(image - scene)[:, flat].max() for image in (ringing, guarded.image))
    assert before > 0.012 and after < 0.006
    assert guarded.share[:, flat & (distance < 8)].mean() > 0.9
    # The map shows it; frames that agree on the scene are no reason for a remark.
    assert guarded.decisions == ()
    np.testing.assert_array_equal(guarded.image[:, 39:41], ringing[:, 39:41])


def test_rings_that_the_deblurred_halves_share_give_way_in_a_flat_part():
    scene, halves, flat = plate(noise=0.002)
    distance = np.abs(np.arange(96) - 39.5)
    rings = np.float32(0.03 * np.cos(np.pi * distance / 2.5) * np.exp(-distance / 8) * (distance > 2))
    shared = Halves(halves.first + rings, halves.second + rings)
    guarded = keep_agreed(scene + rings, halves.mean, halves.noise(), [shared])
    assert np.abs(guarded.image - scene)[:, flat].max() < 0.5 * np.abs(rings[flat]).max()


def test_a_sharp_result_without_rings_stays():
    scene, halves, _ = plate(noise=0.002)
    assert np.abs(guarded_by(scene, halves).image - scene).max() < 2e-3
    colours = Halves(*(np.repeat(half[..., None], 3, axis=2) for half in (halves.first, halves.second)))
    image = np.repeat(scene[..., None], 3, axis=2)
    assert np.abs(guarded_by(image, colours).image - image).max() < 2e-3


def test_noise_beside_an_edge_is_that_of_the_mean():
    scene, halves, flat = plate()
    mean = (halves.first + halves.second) / 2
    noisy = scene + np.float32(np.random.default_rng(4).normal(0, 2 * NOISE, scene.shape))
    near = flat & (np.abs(np.arange(96) - 39.5) < 8)
    left, usual = ((image - scene)[:, near].std() for image in (guarded_by(noisy, halves).image, mean))
    assert left < 1.25 * usual


def test_rows_are_worked_on_in_parts_as_if_in_one(monkeypatch):
    rng = np.random.default_rng(3)
    scene = np.float32(rng.random((560, 24)))
    halves, result = halves_of(scene, noise=0.2), np.float32(scene + rng.normal(0, 0.3, scene.shape))
    parts = guarded_by(result, halves)
    monkeypatch.setattr("turbrestore.verification.halves._ROWS", 1000)
    whole = guarded_by(result, halves)
    np.testing.assert_allclose(parts.image, whole.image, atol=1e-6)
    np.testing.assert_allclose(parts.share, whole.share, atol=1e-4)
    assert 0.01 < whole.share.mean() < 0.99


def test_detail_that_one_pair_of_halves_lacks_gives_way():
    rng = np.random.default_rng(5)
    white = rng.standard_normal((3, 96, 96)).astype(np.float32)
    shared, *own = (0.2 * cv2.GaussianBlur(part, (0, 0), 1.5) for part in white)
    scene = np.full((96, 96), 0.5, np.float32)
    result, mean = scene + 2 * shared, scene + shared
    alike, unlike = Halves(mean, mean), Halves(scene + own[0], scene + own[1])
    noise = unlike.noise().scaled(1e-3)
    kept, given = (keep_agreed(result, mean, noise, pairs) for pairs in ([alike], [alike, unlike]))
    assert np.abs(kept.image - result).max() < 0.01
    assert np.square(given.image - mean).mean() < 0.1 * np.square(result - mean).mean()


def test_smooth_noise_in_flat_parts_is_that_of_the_mean():
    rng = np.random.default_rng(6)
    scene = np.full((128, 128), 0.4, np.float32)
    scene[:, 64:] = 0.8
    parts = (
        scene + cv2.GaussianBlur(rng.normal(0, 0.1, scene.shape).astype(np.float32), (0, 0), 1.5) for _ in range(2)
    )
    halves = Halves(*parts)
    result = scene + 2 * (halves.mean - scene)
    guarded = guarded_by(result, halves)
    flat = np.s_[:, :50]
    assert guarded.image[flat].std() < 1.25 * halves.mean[flat].std()


def test_dark_parts_are_as_flat_as_the_noise_of_photons_there():
    rng, shape = np.random.default_rng(8), (96, 192)
    scene = np.full(shape, 0.1, np.float32)
    scene[:, 96:] = 0.9
    # Faint detail where it is dark, weaker than the average noise and stronger than that of dark parts.
    scene[:, :96] += 0.012 * np.sign(np.sin(np.arange(96) * np.pi / 2 + 0.1)).astype(np.float32)
    deviation = np.where(np.arange(192) < 96, 0.002, 0.03).astype(np.float32)
    halves = Halves(*(scene + deviation * rng.standard_normal(shape).astype(np.float32) for _ in range(2)))
    mean, photons = halves.mean, NoiseCurve(np.array([0.1, 0.9]), np.array([2 / 226, 2 * 225 / 226]))
    # Detail that is twice as strong, and noise that is.
    result = np.float32(mean + np.where(np.arange(192) < 96, scene - 0.1, mean - scene))
    noise = NoiseSpectrum(
        np.full(RINGS.size, np.square(deviation).mean() / 2), np.zeros(RINGS.size), np.zeros(RINGS.size)
    )
    one, by_level = (keep_agreed(result, mean, noise, [halves], photons=curve) for curve in (None, photons))
    dark, bright = np.s_[16:-16, 16:80], np.s_[16:-16, 112:-16]
    assert np.abs(by_level.image - result)[dark].max() < 0.003
    assert np.abs(one.image - result)[dark].mean() > 0.009
    assert by_level.image[bright].std() < 1.25 * mean[bright].std()

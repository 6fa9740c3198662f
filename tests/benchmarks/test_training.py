"""Clips from which the blur is learnt, what is kept of them, and what a title hides of them."""

import pickle

import cv2
import numpy as np
import pytest
from blur_scenes import SCENES, part_of_images, read_images
from blur_simulators import simulate
from blur_training import CORE, INVISIBLE, KEPT, WIDTHS, errors_of, keep_clips, kept_clips, known_of, without_title

from turbrestore.blur.learnt import blur_features
from turbrestore.blur.witnesses.two_tones import two_tones
from turbrestore.core.noise_spectrum import white_noise


@pytest.fixture
def leaves(monkeypatch):
    """Scenes that need no photographs of other packages."""
    monkeypatch.setattr("blur_simulators.SCENES", {name: float(name == "leaves") for name in SCENES})


def test_what_a_title_hides_is_known(leaves):
    bare, titled = (simulate(seed, "lens") for seed in (3, 42))
    assert not bare.hidden.any() and bare.hidden.shape == bare.truth.shape
    # A title stands still and is dark or bright, all around it stays seen.
    assert 0.02 < titled.hidden.mean() < 0.4
    still = np.ptp(titled.frames, axis=0) < 0.1
    assert still[titled.hidden].mean() > still[~titled.hidden].mean() + 0.1


def test_a_title_neither_tells_the_blur_nor_counts_as_an_error():
    scene = cv2.GaussianBlur(np.random.default_rng(0).random((96, 96), np.float32), (0, 0), 2)
    scene = np.clip(0.5 + 0.2 * scene / scene.std() - 0.2 * scene.mean() / scene.std(), 0, 1).astype(np.float32)
    blurred = cv2.GaussianBlur(scene, (0, 0), 1.5)
    hidden = np.zeros(scene.shape, bool)
    hidden[4:40, 20:76] = True
    titled, truth = blurred.copy(), scene.copy()
    for image in (titled, truth):
        image[18:26, 34:62] = np.float32(0.95)
    noise, seen = white_noise(0.002), ~hidden[CORE]
    hurt, spared = (errors_of(titled, truth, noise, count, WIDTHS, 2.0) for count in (np.ones_like(seen), seen))
    gains = [-10 * np.log10(row[WIDTHS == 1.65] / row[0]) for row in (hurt, spared)]
    # The ringing title alone makes the right width hopeless, which is NaN.
    assert gains[1] > 3 and not gains[0] > 0
    faded = without_title(titled, hidden)
    assert np.ptp(faded[18:26, 34:62]) < 0.02 and abs(faded[70:, 70:] - titled[70:, 70:]).max() < 1e-3


def test_scenes_are_parts_of_opaque_images_that_differ(tmp_path):
    rng = np.random.default_rng(0)
    levels = [cv2.resize(rng.integers(0, 256, (20, 20), np.uint8), (300, 260)) for _ in range(2)]
    colour = cv2.merge([levels[1]] * 3)
    for name, image in {
        "a/first.png": levels[0],
        "a/again.png": cv2.resize(levels[0], (600, 520)),
        "b/second.png": colour,
        "b/cut out.png": cv2.merge([255 - colour, np.zeros_like(levels[1])]),
        "b/flat.png": np.full((300, 300), 90, np.uint8),
        "b/small.png": 255 - levels[0][:200],
        "b/deep.png": 257 * (255 - levels[0].astype(np.uint16)),
    }.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        assert cv2.imwrite(str(tmp_path / name), image)
    (tmp_path / "broken.png").write_bytes(b"no image")
    images = read_images(tmp_path)
    assert [image.shape for image in images] == [(520, 600), (260, 300)]
    parts = [part_of_images(images, 180, np.random.default_rng(seed)) for seed in (1, 1, 2)]
    assert parts[0].shape == (180, 180) and parts[0].min() >= 0 and parts[0].max() <= 1
    assert np.array_equal(parts[0], parts[1]) and not np.array_equal(parts[0], parts[2])


def test_the_scene_of_a_clip_is_part_of_a_given_image():
    images = [cv2.resize(np.random.default_rng(1).integers(0, 256, (40, 40), np.uint8), (320, 320))]
    first, second = (simulate(5, "lens", images) for _ in range(2))
    other = simulate(5, "lens", [255 - images[0]])
    assert first.scene == "image" and np.array_equal(first.frames, second.frames)
    assert np.corrcoef(first.truth.ravel(), other.truth.ravel())[0, 1] < -0.9


def test_what_networks_are_trained_on_is_kept(leaves, tmp_path):
    clip, kept = simulate(3, "lens"), tmp_path / "kept.npz"
    known, refused = {"simulator": clip.simulator, **known_of(clip)}, {"simulator": "lens", "refused": "too short"}
    for folder, clips in {
        "first": {"a": known, "b": known, "c": refused, "e": known},
        "second": {"b": {**known, "width": 3.0}, "d": known, "e": refused},
    }.items():
        (tmp_path / folder).mkdir()
        for name, one in clips.items():
            (tmp_path / folder / f"{name}.pkl").write_bytes(pickle.dumps(one))
        keep_clips(tmp_path / folder, kept)
    found = kept_clips(kept)
    assert found.names.tolist() == ["a", "b", "d"] and set(found.simulators) == {"lens"}
    np.testing.assert_allclose(found.width, [known["width"], 3.0, known["width"]], rtol=1e-3)
    visible = -10 * np.log10(np.array([*known["errors"][:2], known["right"]]) + INVISIBLE)
    # Gains of no blur, of the second width that is tried, and of the true blur.
    gains = np.column_stack([found.gains[:, :2], found.right])
    np.testing.assert_allclose(gains, [visible - visible[0]] * 3, atol=1e-2)
    read, estimate = known["read"], known["read"][4].estimate
    np.testing.assert_allclose(found.features, [blur_features(*read)] * 3, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(found.alone, [estimate.sigma * estimate.blurred] * 3, rtol=1e-3)
    np.testing.assert_allclose(found.tones[0], two_tones(read[0], read[5], read[6][1]), rtol=1e-3, atol=1e-3)


def test_the_clips_that_are_kept_are_of_every_simulator():
    clips = kept_clips(KEPT)
    assert {*clips.simulators} == {"screens", "kernels", "lens", "mixed", "near", "none", "close", "chamber"}
    assert len(clips.names) == len({*clips.names}) >= 1000 and KEPT.stat().st_size < 4e6
    assert (clips.width >= WIDTHS[1]).all() and np.isfinite(clips.gains).all() and not clips.gains[:, 0].any()
    # The networks of the package read the same features.
    with np.load(KEPT.parent.parent / "turbrestore" / "blur" / "learnt_blur.npz") as weights:
        assert clips.features.shape[1] == len(weights["middle"]) and not np.isinf(clips.features).any()


def test_a_clip_whose_dark_border_is_cut_off_teaches_nothing(leaves):
    clip = simulate(3, "lens")
    clip.frames[:, :24] = clip.truth[:24] = 0
    assert known_of(clip) == {"refused": "its dark border is cut off"}

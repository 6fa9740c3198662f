import socket

import numpy as np
import pytest
import skimage.data
import skimage.transform

from turbrestore.core.errors import ConfigurationError
from turbrestore.synthesis.scenes import PICTURES, SCENES, picture, printed_words


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("size", [(64, 64), (101, 257)])
def test_every_scene_comes_at_any_size_without_a_download(name, size, monkeypatch):
    def refuse(*_):
        raise AssertionError("a scene asked the network")

    monkeypatch.setattr(socket, "socket", refuse)
    scene = SCENES[name](*size)
    assert scene.shape[:2] == size
    assert scene.shape[2:] in ((), (3,))
    assert scene.dtype == np.float32
    assert scene.min() >= 0
    assert scene.max() <= 1
    assert scene.std() > 0.02


def test_pictures_are_what_scikit_image_shows():
    assert (picture("camera", 512, 512) * 255).round().astype(np.uint8).tobytes() == skimage.data.camera().tobytes()
    # Red stays the first channel.
    assert np.allclose(picture("astronaut", 512, 512), skimage.data.astronaut() / 255, atol=1e-6)


def test_pictures_shrink_by_area():
    whole = picture("gravel", 512, 512)
    means = whole.reshape(128, 4, 128, 4).mean(axis=(1, 3))
    assert np.allclose(picture("gravel", 128, 128), means, atol=1e-5)


def test_pictures_keep_proportions_and_their_middle():
    wide = picture("brick", 128, 256)
    assert np.allclose(wide, picture("brick", 256, 256)[64:192], atol=1e-6)


def test_pictures_grow():
    large = picture("moon", 1024, 1024)
    back = skimage.transform.downscale_local_mean(large, (2, 2))
    assert np.abs(back - picture("moon", 512, 512)).mean() < 0.01


@pytest.mark.parametrize(("height", "width"), [(64, 64), (256, 256), (90, 400)])
def test_words_fill_the_page_and_stay_on_it(height, width):
    page = printed_words(height, width)
    ink = page < 0.8
    rows, columns = np.flatnonzero(ink.any(axis=1)), np.flatnonzero(ink.any(axis=0))
    assert rows[0] > 0
    assert rows[-1] < height - 1
    assert columns[0] > 0
    assert columns[-1] < width - 1
    assert rows[-1] - rows[0] > 0.6 * height
    assert columns[-1] - columns[0] > 0.5 * width


def test_fewer_words_are_printed_larger():
    def letter_height(words):
        rows = (printed_words(200, 200, words) < 0.6).any(axis=1)
        return np.diff(np.flatnonzero(np.diff(np.pad(rows, 1)))[:2])[0]

    assert letter_height(["haze"]) > 2 * letter_height(["haze"] * 20)


def test_bad_parameters_are_refused():
    with pytest.raises(ConfigurationError, match="^picture: expected one of camera"):
        picture("lena", 64, 64)
    with pytest.raises(ConfigurationError, match="^size: expected at least 1 pixel"):
        picture("camera", 0, 64)
    with pytest.raises(ConfigurationError, match="^size: expected at least 64 pixels"):
        printed_words(63, 200)
    for none in ([], [" "]):
        with pytest.raises(ConfigurationError, match="^words: expected at least one"):
            printed_words(64, 64, none)
    with pytest.raises(ConfigurationError, match="^words: expected words that fit on 64×64 pixels, found 500"):
        printed_words(64, 64, ["haze"] * 500)
    assert set(PICTURES) < set(SCENES)

"""AVIF, HEIC, JPEG 2000, JPEG XL, DPX and EXR: every value, every depth, and refusals before anything is decoded."""

import io
import sys
from fractions import Fraction

import av
import imagecodecs
import numpy as np
import PIL.Image
import pytest

from turbrestore.core.errors import ConfigurationError, DataError
from turbrestore.io.images.image_files import read_image
from turbrestore.io.limits import Limits
from turbrestore.io.pixels import upright
from turbrestore.io.video import open_frames
from videos import cuts, refusal

HEIGHT, WIDTH = 32, 48


def values(bits, channels=3):
    """Smooth colours that reach 0 and the largest value."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    waves = np.stack([x / (WIDTH - 1), y / (HEIGHT - 1), (x + y) / (WIDTH + HEIGHT - 2)], -1)
    numbers = np.rint(waves * (2**bits - 1)).astype(np.uint8 if bits == 8 else np.uint16)
    return numbers if channels == 3 else np.ascontiguousarray(numbers[..., 0])


def heic(pixels, bits):
    pillow_heif = pytest.importorskip("pillow_heif")
    raw = (pixels << (16 - bits)).astype("<u2").tobytes() if bits > 8 else pixels.tobytes()
    image = pillow_heif.from_bytes("RGB;16" if bits > 8 else "RGB", (WIDTH, HEIGHT), raw)
    buffer = io.BytesIO()
    image.save(buffer, quality=-1, chroma=444, matrix_coefficients=0)
    return buffer.getvalue()


def film(pixels, codec, pixel_format):
    encoder = av.CodecContext.create(codec, "w")
    encoder.width, encoder.height, encoder.pix_fmt = WIDTH, HEIGHT, pixel_format
    encoder.time_base = Fraction(1, 25)
    frame = av.VideoFrame.from_ndarray(pixels, format=pixel_format)
    frame.pts = 0
    return b"".join(bytes(packet) for packet in [*encoder.encode(frame), *encoder.encode(None)])


MADE = {
    "a.avif": (8, lambda: imagecodecs.avif_encode(values(8), level=100)),
    "b.avif": (10, lambda: imagecodecs.avif_encode(values(10), level=100, bitspersample=10)),
    "a.heic": (8, lambda: heic(values(8), 8)),
    "b.HIF": (10, lambda: heic(values(10), 10)),
    "a.jp2": (8, lambda: imagecodecs.jpeg2k_encode(values(8), level=0)),
    "b.j2k": (12, lambda: imagecodecs.jpeg2k_encode(values(12), bitspersample=12, level=0, codecformat="j2k")),
    "a.jxl": (8, lambda: imagecodecs.jpegxl_encode(values(8), lossless=True)),
    "b.jxl": (10, lambda: imagecodecs.jpegxl_encode(values(10), bitspersample=10, lossless=True)),
    "c.jxl": (14, lambda: imagecodecs.jpegxl_encode(values(14), bitspersample=14, lossless=True, usecontainer=True)),
    "a.dpx": (8, lambda: film(values(8), "dpx", "rgb24")),
    "b.dpx": (10, lambda: film(values(10), "dpx", "gbrp10le")),
}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Folder with a file of every kind that can be made here."""
    folder = tmp_path_factory.mktemp("coded")
    for name, (_, make) in MADE.items():
        if name.lower().endswith((".heic", ".hif")):
            pytest.importorskip("pillow_heif")
        (folder / name).write_bytes(make())
    return folder


@pytest.mark.parametrize("name", MADE)
def test_every_value_comes_back_at_full_range(made, name):
    bits, _ = MADE[name]
    found = read_image(made / name)
    full = 255 if bits == 8 else 65535
    expected = np.rint(values(bits) * (full / (2**bits - 1))) / np.float32(full)
    np.testing.assert_array_equal(found.image, expected.astype(np.float32))
    assert found.bit_depth == (8 if bits == 8 else 16)


@pytest.mark.parametrize("name", MADE)
def test_what_is_cut_or_too_large_is_refused(made, tmp_path, name):
    with refusal(DataError, f"{name}: expected up to 1000 pixels, found {WIDTH}×{HEIGHT}"):
        read_image(made / name, Limits(max_pixels=1000))
    (tmp_path / name).write_bytes((made / name).read_bytes())
    for part in cuts(tmp_path / name, 0.02, 0.5, 0.97):
        with refusal(DataError, name):
            read_image(part)


def test_exr_is_floating_point_and_its_light_may_exceed_white(tmp_path):
    light = np.random.default_rng(0).uniform(0, 4, (HEIGHT, WIDTH, 3)).astype(np.float32)
    for number in range(2):
        (tmp_path / f"{number}.exr").write_bytes(film(light, "exr", "gbrpf32le"))
    source = open_frames(tmp_path)
    assert source.bit_depth == 32 and source.levels == (0, light.max())
    np.testing.assert_allclose(source.read()[1], light / light.max(), atol=1e-6)
    whole = (tmp_path / "0.exr").read_bytes()
    for end in (100, 500, 4000, len(whole) - 1):
        (tmp_path / "0.exr").write_bytes(whole[:end])
        with pytest.raises(DataError, match=r"0\.exr"):
            read_image(tmp_path / "0.exr")


# Only Pillow writes AVIF with an orientation, from 11.3 on; turbrestore reads it with imagecodecs and any Pillow.
@pytest.mark.skipif(".avif" not in PIL.Image.registered_extensions(), reason="this Pillow writes no AVIF")
@pytest.mark.parametrize("orientation", range(1, 9))
def test_avif_is_turned_upright(tmp_path, orientation):
    exif = PIL.Image.Exif()
    exif[274] = orientation
    PIL.Image.fromarray(values(8)).save(tmp_path / "a.avif", exif=exif, quality=100, subsampling="4:4:4")
    found = read_image(tmp_path / "a.avif").image
    np.testing.assert_allclose(found, upright(values(8), orientation) / np.float32(255), atol=0.03)


def test_a_suffix_that_lies_does_not_matter(made, tmp_path):
    for wrong, name in {"a.png": "a.jp2", "a.jpg": "a.avif", "a.bmp": "a.dpx", "b.jpg": "c.jxl"}.items():
        (tmp_path / wrong).write_bytes((made / name).read_bytes())
        np.testing.assert_array_equal(read_image(tmp_path / wrong).image, read_image(made / name).image)


def test_heic_without_its_package_names_the_extra(made, monkeypatch):
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(ConfigurationError, match="pillow-heif, which is not installed; run pip install"):
        read_image(made / "a.heic")

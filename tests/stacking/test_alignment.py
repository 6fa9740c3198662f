"""Alignment against known shifts, rotations, scales and bends, and the command that aligns the results of a night."""

import csv
import math

import cv2
import numpy as np
import pytest
from command_line import fails

from turbrestore.core.arrays import luminance
from turbrestore.core.errors import DataError
from turbrestore.io.images.image_files import read_image, write_image
from turbrestore.registration.warp import sample_linear, warp
from turbrestore.stacking.alignment import Alignment, align_to
from turbrestore.stacking.results_alignment import align_results, contact_sheet
from turbrestore.synthesis.drawn_scenes import road_sign, street
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, smooth_flows

PAD = 28


def similarity_flow(shape, shift, rotation, scale):
    """Flow of a similarity about the centre."""
    y, x = (axis - (length - 1) / 2 for axis, length in zip(np.mgrid[: shape[0], : shape[1]], shape, strict=True))
    angle = math.radians(rotation)
    u = scale * (math.cos(angle) * x - math.sin(angle) * y) + shift[0] - x
    v = scale * (math.sin(angle) * x + math.cos(angle) * y) + shift[1] - y
    return np.stack([u, v], -1).astype(np.float32)


def displaced(scene, rng, bend=0.3, change=lambda image: image):
    """A result that lies elsewhere, with its true alignment to the middle of the scene."""
    shift, rotation, scale = rng.uniform(-10, 10, 2), rng.uniform(-3, 3), 1 + rng.uniform(-0.02, 0.02)
    W = smooth_flows(1, *scene.shape, rng, SmoothFlowParams(rms=bend, correlation_length=14))[0]
    A = similarity_flow(scene.shape, shift, rotation, scale)
    F = W + sample_linear(cv2.split(A), W)
    inverse = -F
    for _ in range(60):
        inverse = -sample_linear(cv2.split(F), inverse)
    middle = np.s_[PAD:-PAD, PAD:-PAD]
    image = change(warp(scene, inverse)[middle]) + rng.normal(0, 0.005, scene[middle].shape)
    return image.astype(np.float32), F[middle], (shift, rotation, scale)


@pytest.fixture(scope="module")
def scene():
    return luminance(street(192, 216))


def middle(image):
    return np.ascontiguousarray(image[PAD:-PAD, PAD:-PAD])


def error(found, true):
    return np.linalg.norm(found - true, axis=-1)[8:-8, 8:-8]


def test_shift_rotation_and_scale_are_those_of_the_truth(scene):
    image, F, (shift, rotation, scale) = displaced(scene, np.random.default_rng(0), bend=0.0)
    found = align_to(image, middle(scene))
    assert found.shift == pytest.approx(shift, abs=0.02)
    assert found.rotation == pytest.approx(rotation, abs=0.02)
    assert found.scale == pytest.approx(scale, abs=3e-4)
    assert found.residual < 0.15
    assert np.median(error(found.flow, F)) < 0.03
    assert found.likeness > 0.9


@pytest.mark.parametrize(
    "change",
    [lambda image: 0.1 + 0.6 * np.clip(image, 0, 1) ** 1.6, lambda image: 0.8 - 0.5 * image],
    ids=["tone", "negative"],
)
def test_brightness_contrast_and_its_sign_do_not_matter(scene, change):
    image, F, _ = displaced(scene, np.random.default_rng(1), change=change)
    assert np.median(error(align_to(image, middle(scene)).flow, F)) < 0.1


def test_what_is_bent_is_found_and_not_only_shifted(scene):
    image, F, _ = displaced(scene, np.random.default_rng(2), bend=0.6)
    found = align_to(image, middle(scene))
    assert found.residual == pytest.approx(0.6 * math.sqrt(2), abs=0.25)
    assert np.median(error(found.flow, F)) < 0.1


def test_another_scene_is_refused(scene):
    with pytest.raises(DataError, match="the scene of the reference"):
        align_to(np.random.default_rng(0).random((120, 140)).astype(np.float32), middle(scene)[:120, :140])


def test_ten_results_lie_on_each_other(scene):
    rng = np.random.default_rng(7)
    made = [displaced(scene, rng) for _ in range(10)]
    found = align_results([image for image, *_ in made])
    assert all(isinstance(one, Alignment) for one in found.alignments)
    # The common geometry is that of their median: against it every result is where all are, on average.
    errors = [one.flow - F for one, (_, F, _) in zip(found.alignments, made, strict=True)]
    common = np.median(errors, axis=0)
    apart = [np.median(error(one, common)) for one in errors]
    assert np.median(apart) <= 0.1
    assert max(apart) <= 0.2
    spread = np.std(np.stack(found.images), axis=0)[8:-8, 8:-8].mean()
    assert spread < 0.2 * np.std(np.stack([image for image, *_ in made]), axis=0)[8:-8, 8:-8].mean()


def test_results_of_other_sizes_and_of_no_use():
    scene = luminance(road_sign(160, 200))
    results = [scene, scene[8:-8, 10:-10], np.random.default_rng(0).random((160, 200)).astype(np.float32)]
    found = align_results(results, onto=scene)
    assert [image is None for image in found.images] == [False, False, True]
    assert isinstance(found.alignments[2], str)
    assert found.images[1].shape == scene.shape
    assert np.abs(found.images[1] - scene)[20:-20, 20:-20].mean() < 0.01


def test_a_sheet_has_all_images_in_order():
    images = [np.full((20, 30), level, np.float32) for level in (0.2, 0.4, 0.6)]
    sheet = contact_sheet(images, ["1", "2", "3"])
    cell = sheet.shape[0] // 2, sheet.shape[1] // 2
    assert [
        round(float(sheet[row * cell[0] + 5, column * cell[1] + 5, 0]), 1) for row, column in ((0, 0), (0, 1), (1, 0))
    ] == [0.2, 0.4, 0.6]


def test_the_command_aligns_results_and_joins_channels(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scene, rng = street(192, 224), np.random.default_rng(3)
    for name, plane in zip("rgb", np.moveaxis(scene, -1, 0), strict=True):
        write_image(f"{name}.tif", np.clip(displaced(np.ascontiguousarray(plane), rng, bend=0.0)[0], 0, 1), 16)
    code, _, err = run("align", "--rgb", "r.tif", "g.tif", "b.tif", "--onto", "g.tif", "out")
    assert code == 0 and "3 of 3 results aligned" in err
    rows = list(csv.DictReader((tmp_path / "out/alignment.csv").read_text().splitlines()))
    assert [row["result"] for row in rows] == ["r.tif", "g.tif", "b.tif"]
    assert abs(float(rows[1]["shift_x"])) < 0.02
    colour = read_image("out/rgb.tif")
    assert (colour.image.shape, colour.bit_depth) == ((136, 168, 3), 16)
    green = read_image("g.tif").image
    for channel in (0, 2):
        found = align_to(np.ascontiguousarray(colour.image[..., channel]), green)
        assert np.hypot(*found.shift) < 0.1
    assert read_image("out/sheet.png").image.ndim == 3
    fails(run("align", "r.tif", "g.tif", "out"), 73, "exists already")
    fails(run("align", "r.tif", "g.tif"), 2, "folder to write to last")
    write_image("noise.tif", rng.random((136, 168)).astype(np.float32), 16)
    code, _, err = run("align", "r.tif", "noise.tif", "more", "--onto", "r.tif", "--quiet")
    assert code == 1 and "more/alignment.csv says why" in err
    assert (tmp_path / "more/r.tif").exists() and not (tmp_path / "more/noise.tif").exists()

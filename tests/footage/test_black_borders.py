"""Black borders that a stabiliser leaves are filled by what other frames show; a sky, a stop and a shadow stay."""

import dataclasses

import cv2
import numpy as np
import pytest

from conftest import make_sequence
from turbrestore.core.errors import DataError
from turbrestore.footage.checks.content import ContentParams, check_content, clean_source, keep_all
from turbrestore.io.source import FrameSource

SIDE, COUNT = 72, 24
Y, X = np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2


def shakes(seed, size):
    """Shifts of the frames, pixels, and turns, degrees."""
    rng = np.random.default_rng(seed)
    return np.column_stack([size * rng.standard_normal((COUNT, 2)), rng.standard_normal(COUNT)])


@pytest.fixture(scope="module")
def whole():
    return np.round(60 + 180 * np.clip(make_sequence(6, count=COUNT, size=SIDE).frames, 0, 1)).astype(np.uint8)


@pytest.fixture(scope="module")
def shown():
    """Where the moved frames show something."""
    moves = []
    for x, y, turn in shakes(1, 5.0):
        move = cv2.getRotationMatrix2D((SIDE / 2, SIDE / 2), turn, 1.0)
        move[:, 2] += x, y
        moves.append(cv2.warpAffine(np.ones((SIDE, SIDE), np.uint8), move, (SIDE, SIDE), flags=cv2.INTER_NEAREST) > 0)
    return np.array(moves)


@pytest.fixture
def bordered(whole, shown):
    """The moved frames, each black where it shows nothing."""
    return np.where(shown, whole, 0).astype(np.uint8)


def cleaned(stack, **settings):
    source = FrameSource.from_array(stack, "clip")
    report = check_content(source, ContentParams(**settings))
    return report, clean_source(source, report).read()


class TestStabilised:
    @pytest.mark.parametrize("kind", ["uint8", "uint16", "float32", "colour"])
    def test_borders_show_the_mean_of_other_frames(self, whole, shown, kind):
        stack = np.where(shown, whole, 0).astype(np.uint8 if kind == "colour" else kind)
        white = 1 if kind == "float32" else np.iinfo(stack.dtype).max
        if kind == "colour":
            stack = np.stack([stack, stack // 2, stack // 3], -1)
        if kind == "float32":
            stack /= 255
        report, found = cleaned(stack)
        assert report.warnings == ("black borders that move: filled by what other frames show",)
        stack = stack / np.float32(white)
        # Pixels beside a border may be darkened, and count as part of it.
        inner = np.array([cv2.erode(np.uint8(one), np.ones((13, 13), np.uint8)) > 0 for one in shown])
        np.testing.assert_allclose(found[inner], stack[inner], atol=1e-6)
        count = np.maximum(shown.sum(axis=0), 1)
        mean = ((stack.T * shown.T).T.sum(axis=0).T / count.T).T
        off = np.concatenate([np.abs(frame - mean)[~one].ravel() for one, frame in zip(shown, found, strict=True)])
        assert np.median(off) < 0.02 and np.quantile(off, 0.99) < 0.12

    def test_a_black_part_of_the_scene_beside_a_border(self, bordered):
        bordered[:, -18:, -18:] = 0
        assert check_content(FrameSource.from_array(bordered)).backdrop is not None

    def test_what_is_black_in_every_frame_stays(self, bordered):
        bordered[:, 30:40, :20] = 0
        report, found = cleaned(bordered)
        assert report.backdrop is not None
        assert (found[:, 30:40, :20] == 0).all()
        # Nor does it grow.
        np.testing.assert_allclose(found[:, 32:38, 24:28], bordered[:, 32:38, 24:28] / 255, atol=1e-6)
        assert not report.backdrop.unseen.any()

    def test_a_bar_does_not_grow(self, bordered):
        bordered[:, -12:] = 0
        report, found = cleaned(bordered)
        assert report.backdrop is not None
        np.testing.assert_allclose(found[:, -15:-12, 30:40], bordered[:, -15:-12, 30:40] / 255, atol=1e-6)

    def test_what_interpolation_has_darkened_is_filled_too(self, whole, shown):
        soft = [np.stack([cv2.GaussianBlur(one, (3, 3), 0.6) for one in np.where(seen, whole, 0).astype(np.uint8)])
                for seen in (shown, np.ones_like(shown))]  # fmt: skip
        _, found = cleaned(soft[0])
        beside = np.array([cv2.dilate(np.uint8(~one), np.ones((5, 5), np.uint8)) > 0 for one in shown])
        # Borders of a pixel have no black left.
        assert np.quantile(np.abs(found - soft[1] / 255)[beside], 0.9) < 0.25

    def test_a_blank_frame_does_not_darken_the_fill_and_stays_blank_where_it_is_kept(self, bordered):
        _, found = cleaned(bordered)
        bordered[7] = 0
        report, rest = cleaned(bordered)
        assert report.blank == (7,)
        assert np.abs(rest - np.delete(found, 7, axis=0)).max() < 0.1
        source = FrameSource.from_array(bordered)
        assert (clean_source(source, keep_all(check_content(source))).read()[7] == 0).all()

    def test_black_of_a_codec(self, whole, shown):
        rng = np.random.default_rng(9)
        noise = rng.integers(0, 4, whole.shape, np.uint8)
        # Ringing.
        noise[rng.uniform(size=noise.shape) < 0.02] = 12
        report, found = cleaned(np.where(shown, whole, noise))
        assert report.backdrop is not None
        assert found.min() > 0.1

    def test_missing_values_beside_a_border(self, whole, shown):
        stack = np.where(shown, whole, 0) / np.float32(255)
        stack[:, :, :4] = 0
        stack[6, :, 20:34] = np.nan
        _, found = cleaned(stack)
        assert np.isfinite(found).all()

    def test_strict_refuses_them_and_mosaics_are_not_looked_at(self, bordered):
        with pytest.raises(DataError, match="black borders"):
            cleaned(bordered, strict=True)
        source = FrameSource.from_array(bordered)
        mosaic = dataclasses.replace(source, bayer="rggb", file_shape=(*source.file_shape, 3))
        assert check_content(mosaic).backdrop is None

    def test_a_cut_is_found_and_other_scenes_keep_their_borders(self, whole, shown):
        other = np.round(60 + 180 * make_sequence(7, count=COUNT, size=SIDE, scene="camera").frames.clip(0, 1))
        stack = np.where(np.concatenate([shown, shown]), np.concatenate([whole, other]), 0).astype(np.uint8)
        source = FrameSource.from_array(stack, "clip")
        report = check_content(source)
        assert report.backdrop is not None
        assert [(scene.first, scene.last) for scene in report.scenes] == [(0, 23), (24, 47)]
        np.testing.assert_array_equal(clean_source(source, keep_all(report)).read(), source.read())


def unchanged(stack):
    """Expect nothing to be found, and no frame to be left out."""
    report = check_content(FrameSource.from_array(stack))
    assert (report.backdrop, report.warnings, report.left_out) == (None, (), frozenset())


class TestNoBorder:
    @pytest.mark.parametrize("radius", [0.5, 0.8, 1.0, 1.2, 1.5])
    def test_a_planet_that_the_wind_shakes(self, radius):
        side = 120
        y, x = np.mgrid[:side, :side] - (side - 1) / 2
        for size in (0.05, 0.15, 0.4):
            discs = [radius * side / 2 - np.hypot(x - right, y - down) for right, down, _ in shakes(2, size * side)]
            bright = (150 + 50 * np.sin(x / 4) * np.sin(y / 3)) * np.clip(np.array(discs) / 2, 0, 1)
            assert check_content(FrameSource.from_array(np.uint8(bright))).backdrop is None, size

    def test_a_bright_board_and_a_star_on_black(self):
        board = np.zeros((COUNT, SIDE, SIDE), np.uint8)
        board[:, 20:50, 20:50] = np.random.default_rng(5).normal(150, 5, (COUNT, 30, 30))
        unchanged(board)
        star = 200 * np.exp(-(np.hypot(X - 5, Y + 3) ** 2) / 4) + np.random.default_rng(6).normal(3, 2, board.shape)
        unchanged(np.uint8(star.clip(0)))

    def test_a_lens_cap(self, whole):
        stack = whole.copy()
        stack[3] = np.random.default_rng(7).normal(4, 2, (SIDE, SIDE)).clip(0)
        report = check_content(FrameSource.from_array(stack))
        assert (report.backdrop, report.blank, len(report.scenes)) == (None, (3,), 1)

    @pytest.mark.parametrize("width", [4, 8])
    def test_a_scene_in_a_fixed_box_after_one_without(self, whole, width):
        waves = 128 + 100 * np.sin(X / 2 + Y / 6) + np.random.default_rng(8).normal(0, 2, (10, SIDE, SIDE))
        boxed = whole[10:].copy()
        for side in (boxed.transpose(1, 2, 0), boxed.transpose(2, 1, 0)):
            side[:width] = side[-width:] = 0
        report = check_content(FrameSource.from_array(np.concatenate([np.uint8(waves), boxed])))
        assert (report.backdrop, len(report.scenes)) == (None, 2)

    def test_one_frame_that_was_moved(self, whole):
        moved, dark = whole.copy(), whole.copy()
        moved[5, :9] = moved[5, -9:] = moved[5, :, :9] = 0
        moved[6, :6] = 0
        # Frames without a picture.
        dark[::5] = 0
        for stack in (moved, dark):
            assert check_content(FrameSource.from_array(stack)).backdrop is None

    @pytest.mark.parametrize("shape", [(1, 1), (2, 50), (50, 2), (6, 6), (5, 20)])
    def test_tiny_frames(self, shape):
        stack = np.random.default_rng(8).integers(5, 255, (6, *shape), np.uint8)
        stack[:, 0, 0] = 0
        assert check_content(FrameSource.from_array(stack)).backdrop is None

    def test_a_sky_of_noise_around_zero(self):
        for mean in (-60, -40, -20, 5):
            stack = np.random.default_rng(3).normal(mean, 30, (COUNT, SIDE, SIDE)) + 800 * (np.hypot(X, Y) < 12)
            sky = FrameSource.from_array(np.uint16(np.maximum(stack, 0)))
            assert check_content(sky).backdrop is None

    def test_a_dark_frame_of_a_window_on_two_sides(self, whole):
        stack = whole.copy()
        for frame, (x, y, _) in zip(stack, shakes(4, 6.0), strict=True):
            frame[: max(round(8 + y), 0)] = 0
            frame[:, : max(round(8 + x), 0)] = 0
        assert check_content(FrameSource.from_array(stack)).backdrop is None

"""Black borders that a stabiliser leaves are filled by what other frames show; a sky, a stop and a shadow stay."""

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
        assert report.warnings == ("black borders that change from frame to frame: filled by what other frames show",)
        stack = stack / np.float32(white)
        # Pixels beside a border may be darkened, and count as part of it.
        inner = np.array([cv2.erode(np.uint8(one), np.ones((13, 13), np.uint8)) > 0 for one in shown])
        np.testing.assert_allclose(found[inner], stack[inner], atol=1e-6)
        count = np.maximum(shown.sum(axis=0), 1)
        mean = ((stack.T * shown.T).T.sum(axis=0).T / count.T).T
        off = np.concatenate([np.abs(frame - mean)[~one].ravel() for one, frame in zip(shown, found, strict=True)])
        assert np.median(off) < 0.02 and np.quantile(off, 0.99) < 0.12

    def test_a_black_part_of_the_scene_beside_a_border(self, whole, shown):
        stack = np.where(shown, whole, 0).astype(np.uint8)
        stack[:, -18:, -18:] = 0
        assert check_content(FrameSource.from_array(stack)).backdrop is not None

    def test_what_is_black_in_every_frame_stays(self, whole, shown):
        stack = np.where(shown, whole, 0).astype(np.uint8)
        stack[:, 30:40, :20] = 0
        report, found = cleaned(stack)
        assert report.backdrop is not None
        assert (found[:, 30:40, :20] == 0).all()
        # Nor does it grow.
        np.testing.assert_allclose(found[:, 32:38, 24:28], stack[:, 32:38, 24:28] / 255, atol=1e-6)
        assert not report.backdrop.unseen.any()

    def test_a_bar_does_not_grow(self, whole, shown):
        stack = np.where(shown, whole, 0).astype(np.uint8)
        stack[:, -12:] = 0
        report, found = cleaned(stack)
        assert report.backdrop is not None
        np.testing.assert_allclose(found[:, -15:-12, 30:40], stack[:, -15:-12, 30:40] / 255, atol=1e-6)

    def test_what_interpolation_has_darkened_is_filled_too(self, whole, shown):
        soft = [np.stack([cv2.GaussianBlur(one, (3, 3), 0.6) for one in np.where(seen, whole, 0).astype(np.uint8)])
                for seen in (shown, np.ones_like(shown))]  # fmt: skip
        _, found = cleaned(soft[0])
        beside = np.array([cv2.dilate(np.uint8(~one), np.ones((5, 5), np.uint8)) > 0 for one in shown])
        # Borders of a pixel have no black left.
        assert np.quantile(np.abs(found - soft[1] / 255)[beside], 0.9) < 0.25

    def test_a_blank_frame_does_not_darken_the_fill(self, whole, shown):
        stack = np.where(shown, whole, 0).astype(np.uint8)
        _, found = cleaned(stack)
        stack[7] = 0
        report, rest = cleaned(stack)
        assert report.blank == (7,)
        assert np.abs(rest - np.delete(found, 7, axis=0)).max() < 0.1

    def test_a_blank_frame_that_is_kept_stays_blank(self, whole, shown):
        stack = np.where(shown, whole, 0).astype(np.uint8)
        stack[7] = 0
        source = FrameSource.from_array(stack)
        assert (clean_source(source, keep_all(check_content(source))).read()[7] == 0).all()

    def test_strict_refuses_them(self, whole, shown):
        with pytest.raises(DataError, match="black borders"):
            cleaned(np.where(shown, whole, 0).astype(np.uint8), strict=True)

    def test_a_cut_is_found_and_other_scenes_keep_their_borders(self, whole, shown):
        other = np.round(60 + 180 * make_sequence(7, count=COUNT, size=SIDE, scene="camera").frames.clip(0, 1))
        stack = np.where(np.concatenate([shown, shown]), np.concatenate([whole, other]), 0).astype(np.uint8)
        source = FrameSource.from_array(stack, "clip")
        report = check_content(source)
        assert report.backdrop is not None
        assert [(scene.first, scene.last) for scene in report.scenes] == [(0, 23), (24, 47)]
        np.testing.assert_array_equal(clean_source(source, keep_all(report)).read(), source.read())


class TestNoBorder:
    @pytest.mark.parametrize("radius", [0.5, 0.8, 1.0, 1.2, 1.5])
    @pytest.mark.parametrize("size", [0.05, 0.15, 0.4])
    def test_a_planet_that_the_wind_shakes(self, radius, size):
        side = 120
        y, x = np.mgrid[:side, :side] - (side - 1) / 2
        discs = [radius * side / 2 - np.hypot(x - right, y - down) for right, down, _ in shakes(2, size * side)]
        stack = np.uint8(np.clip(np.array(discs) / 2, 0, 1) * (150 + 50 * np.sin(x / 4) * np.sin(y / 3)))
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

    def test_frames_without_a_picture(self, whole):
        stack = whole.copy()
        stack[::5] = 0
        assert check_content(FrameSource.from_array(stack)).backdrop is None

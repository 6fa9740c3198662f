"""Strips of images and blocks of spectra against transforms of the whole."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import fft

from turbrestore.blur.psf import psf_to_otf
from turbrestore.deconvolution import strip_grid
from turbrestore.deconvolution.problem import Problem, seen_mean
from turbrestore.deconvolution.strip_grid import StripGrid, inner
from turbrestore.runtime.threads import ThreadTeam

SHAPES = st.tuples(st.integers(1, 40), st.integers(1, 90))
rng = np.random.default_rng(0)


@pytest.fixture(params=[1 << 20, 1], ids=["whole", "strips"])
def strips(request, monkeypatch):
    """Images are one strip, or many, of some hundreds of pixels."""
    monkeypatch.setattr(strip_grid, "_ONE_STRIP", request.param)
    monkeypatch.setattr(strip_grid, "_STRIP", 200)
    monkeypatch.setattr(strip_grid, "_ALIGNED", 3)
    return request.param == 1


def spectrum_of(grid: StripGrid, image: np.ndarray) -> np.ndarray:
    """Transform an image, and put the blocks together."""
    spectrum = grid.spectrum()
    spectrum[...] = np.nan
    grid.over_rows(lambda rows: grid.transform_strip(image[rows], spectrum, rows), spectrum, image)

    def transform(block: int) -> None:
        spectrum[block] = fft.fft(spectrum[block], axis=0)

    grid.over_blocks(transform, spectrum)
    return spectrum


@pytest.mark.parametrize("shape", [(1, 1), (2, 1), (1, 2), (9, 30), (40, 31), (33, 64), (64, 7)])
@pytest.mark.parametrize("in_file", [False, True])
def test_transforms_are_those_of_the_whole(strips, shape, in_file, tmp_path):
    image = rng.normal(size=shape).astype(np.float32)
    with ThreadTeam(3) as team:
        grid = StripGrid(shape, team, tmp_path if in_file else None)
        spectrum = spectrum_of(grid, image)
        together = np.concatenate(spectrum, axis=1)
        assert together[:, : shape[1] // 2 + 1] == pytest.approx(fft.rfft2(image), abs=1e-4)
        assert not together[:, shape[1] // 2 + 1 :].any()
        back = grid.image()

        def put(rows: slice) -> None:
            back[rows] = grid.strip_of(spectrum, rows)

        def transform(block: int) -> None:
            spectrum[block] = fft.ifft(spectrum[block], axis=0)

        grid.over_blocks(transform, spectrum)
        grid.over_rows(put, spectrum, back)
    assert back == pytest.approx(image, abs=1e-5)
    # A file has no name.
    assert list(tmp_path.iterdir()) == []


@settings(deadline=None)
@given(SHAPES)
def test_strips_and_blocks_hold_all_once(shape):
    for least in (1 << 20, 1):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(strip_grid, "_ONE_STRIP", least)
            patch.setattr(strip_grid, "_STRIP", 200)
            grid = StripGrid(shape)
            rows = [row for strip in grid.over_rows(lambda rows: rows) for row in range(strip.start, strip.stop)]
            assert rows == list(range(shape[0]))
            columns = [column for block in grid.blocks for column in range(block.start, block.stop)]
            assert columns == list(range(shape[1] // 2 + 1))
            assert grid.over_blocks(int) == list(range(len(grid.blocks)))


def test_large_images_have_strips_of_like_size_and_small_ones_one():
    assert len(StripGrid((500, 500)).over_rows(id)) == len(StripGrid((500, 500)).blocks) == 1
    strips = StripGrid((1104, 1944)).over_rows(lambda rows: rows.stop - rows.start)
    assert len(strips) % 4 == 0
    assert max(strips) - min(strips) < len(strips)
    assert 1 << 16 < max(strips) * 1944 < 1 << 19
    assert all(block.stop - block.start <= 256 for block in StripGrid((1104, 1944)).blocks)


@pytest.mark.parametrize("shape", [(5, 6), (4, 7), (3, 1), (33, 40), (1, 2)])
def test_inner_products_are_those_of_the_spectra(strips, shape):
    a, b = rng.normal(size=(2, *shape)).astype(np.float32)
    grid = StripGrid(shape)
    one, other = (spectrum_of(grid, image) for image in (a, b))
    found = sum(grid.over_blocks(lambda block: grid.spectral_inner(one[block], other[block], block)))
    assert found == pytest.approx(np.vdot(a, b), abs=1e-4)
    assert grid.inner(a, b) == pytest.approx(np.vdot(a.astype(np.float64), b), rel=1e-6, abs=1e-6)
    assert inner(a, b) == pytest.approx(grid.inner(a, b), rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("in_file", [False, True])
def test_functions_of_the_frequency_are_put_into_blocks(strips, in_file, tmp_path):
    grid = StripGrid((20, 31), None, tmp_path if in_file else None)
    for function in (rng.random((20, 16)).astype(np.float32), fft.rfft2(rng.random((20, 31), np.float32))):
        blocks = np.concatenate(grid.in_blocks(function), axis=1)
        assert blocks.dtype == function.dtype
        assert np.array_equal(blocks[:, :16], function)
        # So that a reciprocal has no zero to divide by.
        assert (blocks[:, 16:] == 1).all()


@pytest.mark.parametrize("shape", [(8, 8), (33, 40), (24, 41)])
def test_a_blur_by_strips_is_that_of_the_whole(strips, shape):
    # An asymmetric kernel, for which a convolution and its adjoint differ.
    grid, otf = StripGrid(shape), psf_to_otf(rng.random((3, 5)), shape)
    image, seen, observed = rng.random((3, *shape)).astype(np.float32)
    seen = (seen > 0.3).astype(np.float32)
    problem = Problem(observed, seen, grid.in_blocks(otf), 7.0, grid)
    expected = fft.irfft2(otf * fft.rfft2(image), s=shape)
    assert problem.blurred(image) == pytest.approx(expected, abs=1e-5)
    assert problem.misfit(image) == pytest.approx(3.5 * (seen * (expected - observed) ** 2).sum(), rel=1e-5)
    assert seen_mean(problem) == pytest.approx(observed[seen > 0].mean(), rel=1e-5)


def test_what_is_touched_is_handed_back(strips, monkeypatch, tmp_path):
    grid, released = StripGrid((40, 64), None, tmp_path), []
    monkeypatch.setattr(strip_grid, "drop_pages", released.append)
    image = grid.copied(rng.random((40, 64)).astype(np.float32))
    assert isinstance(image.base, np.memmap)
    # By every strip: the copy, and what it is of.
    assert len(released) == 2 * len(grid.over_rows(id))
    assert (len(released) > 2) == strips

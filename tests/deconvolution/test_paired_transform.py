"""The descent by one transform there and one back, against one transform for each image."""

import numpy as np
import pytest
from scipy import fft

from turbrestore.blur.psf import blur_otf, psf_to_otf
from turbrestore.deconvolution import paired_transform
from turbrestore.deconvolution.paired_transform import pair_loops, paired_descent


def transfer_of(shape, lopsided):
    """That of a real point spread function, with or without a centre."""
    if not lopsided:
        return blur_otf(shape, 0.8, 5 / 3)
    kernel = np.random.default_rng(1).random([min(size, 3) // 2 * 2 + 1 if size > 2 else 1 for size in shape])
    return psf_to_otf(kernel, shape)


@pytest.mark.parametrize("shape", [(8, 6), (9, 7), (6, 9), (1, 4), (5, 1), (2, 2)])
@pytest.mark.parametrize("lopsided", [False, True])
@pytest.mark.parametrize("plain", [False, True])
def test_the_descent_is_that_of_four_transforms(monkeypatch, shape, lopsided, plain):
    if plain:
        monkeypatch.setattr(paired_transform, "compiled", lambda loops: None)
    pressure, pull = np.random.default_rng(0).normal(size=(2, *shape)).astype(np.float32)
    transfer, floor, weight = transfer_of(shape, lopsided), 2.0, 30.0
    descent = fft.rfft2(pull) + transfer.conj() * fft.rfft2(pressure)
    descent /= floor + weight * np.abs(transfer) ** 2
    expected = [fft.irfft2(spectrum, s=shape) for spectrum in (descent, transfer * descent)]
    found = paired_descent(pressure, pull, transfer, floor, weight)
    assert found.dtype == np.float32
    assert np.moveaxis(found, -1, 0) == pytest.approx(np.array(expected), abs=3e-6)


def test_loops_run_without_a_compiler_too():
    numbers = np.random.default_rng(2).normal(size=(2, 5, 6)).astype(np.float32)
    spectrum, transfer = numbers[0] + 1j * numbers[1], transfer_of((5, 6), True)
    found = np.empty((5, 6), np.complex64), np.empty((5, 6), np.complex64)
    for loops, descent in zip((pair_loops, paired_transform._pair), found, strict=True):
        loops(spectrum.astype(np.complex64), transfer, np.float32([2, 60]), descent)
    assert found[0] == pytest.approx(found[1], abs=1e-5)

"""Transforms against those of SciPy."""

import numpy as np
import pytest
import scipy

from turbrestore.runtime.fourier import fast_length, irfft2, rfft2


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("shape", [(3, 5), (5, 1), (1, 4), (2, 30, 41)])
def test_transforms_are_those_of_scipy(shape, threads):
    exact = np.random.default_rng(0).random(shape)
    for dtype, close in ((np.float32, 2e-6), (np.float64, 1e-14)):
        image = exact.astype(dtype)
        spectrum = scipy.fft.rfft2(image)
        found, back = rfft2(image, threads), irfft2(spectrum, shape[-2:], threads)
        assert found.dtype == spectrum.dtype and back.dtype == dtype
        np.testing.assert_allclose(found, spectrum, rtol=0, atol=close * abs(spectrum).max())
        np.testing.assert_allclose(back, image, rtol=0, atol=close)


def test_fast_lengths_are_those_of_scipy():
    lengths = range(1, 1000)
    assert [*map(fast_length, lengths)] == [scipy.fft.next_fast_len(length, real=True) for length in lengths]

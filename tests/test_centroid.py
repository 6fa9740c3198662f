import numpy as np
import pytest

from turbrestore.centroid import CentroidParams, find_centroid, mean_registered
from turbrestore.errors import ConfigurationError, DataError
from turbrestore.metrics import psnr
from turbrestore.warp import warp

INSIDE = (slice(12, -12), slice(12, -12))


def blurred_truth(sequence):
    import cv2

    return cv2.GaussianBlur(sequence.scene, (0, 0), 1.0)[INSIDE]


def test_fused_centroid_beats_the_mean_and_one_warped_frame(sequence):
    truth = blurred_truth(sequence)
    fused = find_centroid(sequence.frames, CentroidParams(mode="fused"))
    single = find_centroid(sequence.frames, CentroidParams(mode="single"))
    mean = psnr(sequence.frames.mean(axis=0)[INSIDE], truth)
    assert psnr(single.image[INSIDE], truth) > mean + 1
    assert psnr(fused.image[INSIDE], truth) > psnr(single.image[INSIDE], truth) + 0.5


def test_mean_flow_shrinks(sequence):
    centroid = find_centroid(sequence.frames, CentroidParams(mode="single", iterations=10, tolerance=0.0))
    sizes = centroid.mean_flow_sizes
    assert sizes[-1] < 0.3 * sizes[0]
    # Without a tolerance it ends when nothing shrinks any more.
    assert centroid.converged
    assert len(sizes) < 10
    assert sizes[-1] > 0.8 * sizes[-2]


def test_stops_on_the_size_of_the_mean_flow(sequence):
    loose = find_centroid(sequence.frames, CentroidParams(tolerance=5.0))
    assert loose.converged
    assert len(loose.mean_flow_sizes) == 1
    strict = find_centroid(sequence.frames, CentroidParams(tolerance=0.0, iterations=1))
    assert not strict.converged


@pytest.mark.parametrize("mode", ["fused", "single"])
def test_flows_start_from_the_centroid_and_average_out(sequence, mode):
    centroid = find_centroid(sequence.frames, CentroidParams(mode=mode))
    errors = [
        np.abs(warp(f, w) - centroid.image)[INSIDE].mean() for f, w in zip(sequence.frames, centroid.flows, strict=True)
    ]
    unregistered = [np.abs(f - centroid.image)[INSIDE].mean() for f in sequence.frames]
    assert np.mean(errors) < 0.5 * np.mean(unregistered)
    mean_flow = centroid.flows.mean(axis=0)[INSIDE]
    assert np.hypot(mean_flow[..., 0], mean_flow[..., 1]).mean() <= CentroidParams().tolerance


def test_opposite_shifts_meet_in_the_middle(sequence):
    from scipy.ndimage import shift

    image = sequence.frames[0]
    pair = np.stack([shift(image, (0, s), mode="nearest", order=3) for s in (-1.0, 1.0)]).astype(np.float32)
    centroid = find_centroid(pair, CentroidParams(mode="single"))
    assert psnr(centroid.image[INSIDE], image[INSIDE]) > psnr(pair[0][INSIDE], image[INSIDE]) + 8


def test_frames_are_not_changed_and_colour_is_kept(sequence):
    frames = np.repeat(sequence.frames[:3, ..., None], 3, axis=3)
    before = frames.copy()
    centroid = find_centroid(frames)
    assert centroid.image.shape == frames.shape[1:]
    assert (frames == before).all()


def test_mean_registered_of_still_frames_is_the_mean():
    frames = np.random.default_rng(0).random((3, 8, 8)).astype(np.float32)
    assert np.allclose(mean_registered(frames, np.zeros((3, 8, 8, 2), np.float32)), frames.mean(axis=0), atol=1e-6)


def test_bad_input_is_refused(sequence):
    with pytest.raises(DataError, match="at least 2 frames, found 1"):
        find_centroid(sequence.frames[:1])
    with pytest.raises(ConfigurationError, match=r"^start: expected a frame below 16"):
        find_centroid(sequence.frames, CentroidParams(mode="single", start=16))
    for bad in ({"mode": "median"}, {"iterations": 0}, {"tolerance": -1.0}, {"start": -1}):
        with pytest.raises(ConfigurationError, match=f"^{next(iter(bad))}: expected"):
            CentroidParams(**bad)

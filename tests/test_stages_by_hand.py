"""The public functions of the stages, called one after the other, give what ``restore`` gives."""

import numpy as np

import turbrestore as tr
from conftest import make_sequence


def test_stages_by_hand_give_the_image_of_restore():
    frames = make_sequence(seed=5, count=14, size=64, scene="camera", rms=1.2).frames
    # The means of both halves are those of the scene: without one of the frames the training frames are moved.
    frames = frames[1:]
    known = tr.RestoreParams(train=6, border="keep", deconvolution=tr.DeconvolutionParams(sigma=1.0, iterations=5))
    whole = tr.restore(frames, known)
    centroid = tr.find_centroid(frames[:6])
    dynamics = tr.identify(centroid.flows)
    filtered = tr.filter_frames(frames, centroid.image, dynamics, known_flows=centroid.flows)
    straight = filtered.recentred()
    assert np.abs(filtered.image - straight.image).max() > 0.01
    np.testing.assert_array_equal(straight.image, whole.filtered.image)
    guide = tr.recentre(centroid.image, filtered.mean_flow)
    sharp = tr.deconvolve(straight.image, 1.0, known.deconvolution, guide, noise=whole.noise)
    np.testing.assert_array_equal(sharp.image, whole.image)


def test_dynamics_are_printed_in_a_few_lines():
    flows = np.random.default_rng(0).normal(0, 1, (9, 12, 16, 2)).astype(np.float32)
    lines = str(tr.identify(flows)).splitlines()
    assert lines[0] == "FlowDynamics: 16×12 pixels" and len(lines) < 9 and max(map(len, lines)) < 200

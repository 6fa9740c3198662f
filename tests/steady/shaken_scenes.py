"""Scenes, and frames of them that are bent and noisy, for the tests of steadied video."""

import cv2
import numpy as np
import skimage.data

from turbrestore.runtime.runtime import Runtime
from turbrestore.steady.settings import SteadyParams
from turbrestore.steady.video import steady_frames
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows

SIZE = 128


def photo(name="camera", size=SIZE):
    image = cv2.resize(getattr(skimage.data, name)(), (size, size), interpolation=cv2.INTER_AREA)
    return image.astype(np.float32) / 255


def psnr(image, truth, part=...):
    return -10 * np.log10(np.mean((np.clip(image, 0, 1) - truth)[part] ** 2))


def images(frames, **settings):
    return [frame.image for frame in steady_frames(frames, SteadyParams(**settings), Runtime(threads=2))]


def shaken(truth, rms=0.6, seed=0):
    """Noisy frames through smooth displacements that are independent from frame to frame."""
    rng = np.random.default_rng(seed)
    params = SmoothFlowParams(rms=rms, correlation_length=24.0, persistence=0.0)
    flows = smooth_flows(len(truth), *truth[0].shape[:2], rng, params)
    frames = [distort(scene, flow[None], rng)[0] for scene, flow in zip(truth, flows, strict=True)]
    return [(frame + rng.normal(0, 0.01, frame.shape)).astype(np.float32) for frame in frames]


def windows_of_a_wall(height, width, across=12, down=14):
    """Regular windows on a wall."""
    y, x = np.mgrid[: 4 * height, : 4 * width] / 4
    window = (x % across > 0.3 * across) & (y % down > 0.35 * down)
    return cv2.resize(np.where(window, 0.25, 0.65).astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)

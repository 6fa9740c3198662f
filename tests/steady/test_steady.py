"""Video in, video out: still scenes, things that move, cameras, cuts, ends and memory."""

import itertools
import weakref

import cv2
import numpy as np
import pytest
import skimage.data

from turbrestore.core.errors import ConfigurationError, DataError
from turbrestore.runtime.runtime import Runtime
from turbrestore.steady.video import SteadyParams, steady_frames
from turbrestore.synthesis.anisoplanatic import phase_screen_frames
from turbrestore.synthesis.atmosphere import PhaseScreenParams
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows

SIZE = 128


def photo(name="camera", size=SIZE):
    image = cv2.resize(getattr(skimage.data, name)(), (size, size), interpolation=cv2.INTER_AREA)
    return image.astype(np.float32) / 255


def psnr(image, truth, part=...):
    return -10 * np.log10(np.mean((np.clip(image, 0, 1) - truth)[part] ** 2))


def images(frames, **settings):
    return [frame.image for frame in steady_frames(frames, SteadyParams(**settings), Runtime(threads=2))]


def shaken(truth, deviation=0.7, seed=0, sigma=0.0):
    """Frames through smooth displacements that are independent from frame to frame."""
    flows = smooth_flows(len(truth), truth[0].shape[:2], np.random.default_rng(seed), SmoothFlowParams(rms=deviation))
    noise = np.random.default_rng(seed + 1)
    frames = [distort(scene, flow) for scene, flow in zip(truth, flows, strict=True)]
    soft = [cv2.GaussianBlur(frame, (0, 0), sigma) if sigma else frame for frame in frames]
    return [(frame + noise.normal(0, 0.01, frame.shape)).astype(np.float32) for frame in soft]

"""Small synthetic sequences with known motion, shared by several tests."""

import gc
import os
import shutil
import signal
from dataclasses import dataclass

import cv2
import numpy as np
import pytest
import skimage.data
from flow_systems import uneven_flows
from hypothesis import HealthCheck, given, settings
from hypothesis.strategies import none

from turbrestore.core.arrays import luminance
from turbrestore.footage.correction import Correction
from turbrestore.footage.survey import Survey, take_survey
from turbrestore.io.source import FrameSource
from turbrestore.io.video import write_video
from turbrestore.synthesis.scenes import resolution_chart
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows

# A busy machine is slow, which no test is to blame for; in CI the examples are the same every time.
settings.register_profile(
    "shared", deadline=None, suppress_health_check=[HealthCheck.too_slow], derandomize=bool(os.environ.get("CI"))
)
settings.load_profile("shared")

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


@pytest.fixture(scope="module")
def browser():
    if CHROMIUM is None:
        # A browser is no Python package, so the extra `dev` cannot install it; .ci/run does.
        pytest.skip("no Chromium on the path; install chromium to test pages in a browser")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Leave out of the searches for cycles what is imported for good: each would pass through millions of objects."""
    gc.disable()
    result = yield
    # The first test that Hypothesis runs registers a generator, and searches what is not frozen for a reference to it.
    given(none())(lambda _: None)()
    gc.freeze()
    gc.enable()
    return result


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Give all tests of a module to one process, which then makes what they share once."""
    from xdist.scheduler import LoadFileScheduling

    # As they are collected: the examples in docstrings come last, and are over soon in every module.
    config.option.loadscopereorder = False
    return LoadFileScheduling(config, log)


@dataclass(frozen=True)
class Sequence:
    scene: np.ndarray
    flows: np.ndarray
    frames: np.ndarray


@pytest.fixture(scope="session", autouse=True)
def signals_as_in_the_foreground():
    """Shells start background jobs with signals ignored, and every process that a test interrupts would inherit it."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)


def natural_scene(size: int) -> np.ndarray:
    """The photographer: edges, faint texture, a flat sky."""
    return photograph("camera", 256)[20 : 20 + size, 60 : 60 + size]


def photograph(name: str, side: int) -> np.ndarray:
    """Grey photograph of scikit-image, reduced to a square."""
    photo = cv2.resize(getattr(skimage.data, name)(), (side, side), interpolation=cv2.INTER_AREA)
    return luminance(photo.astype(np.float32) / 255)


SCENES = {"chart": lambda size: resolution_chart(size, size), "camera": natural_scene}


def surveyed(frames) -> Survey:
    return take_survey(FrameSource.from_array(frames))


def corrected(frames, find) -> tuple[FrameSource, Correction]:
    """A clip without what a detector finds in it, and what that is."""
    survey = surveyed(frames)
    found = find(survey)
    return survey.corrected(found).clip, found


def make_sequence(
    seed: int,
    count: int = 16,
    size: int = 96,
    scene: str = "chart",
    blur: float = 1.0,
    blur_change: float = 0.0,
    noise: float = 0.01,
    **statistics: float,
) -> Sequence:
    """Frames whose blur is drawn anew for each, between ``blur`` and ``blur + blur_change``."""
    rng = np.random.default_rng(seed)
    image = SCENES[scene](size)
    flows = smooth_flows(count, size, size, rng, SmoothFlowParams(**statistics))
    # Frames tell the scene up to their mean displacement only.  It is taken out of either half, so that training on
    # the first half gives the true geometry and results can be compared in place.
    for half in np.array_split(np.arange(count), 2):
        flows[half] -= flows[half].mean(axis=0)
    blurs = blur + blur_change * rng.uniform(0, 1, count)
    frames = [distort(image, flow[None], rng, blur=b, noise=noise)[0] for flow, b in zip(flows, blurs, strict=True)]
    return Sequence(image, flows, np.stack(frames))


@pytest.fixture(scope="session")
def sequence() -> Sequence:
    return make_sequence(seed=1)


def blurred(
    scene: np.ndarray, sigma: float | tuple[float, float], rng: np.random.Generator, noise: float = 0.01
) -> np.ndarray:
    """The scene under a Gaussian of one σ, or of one along x and one along y, with noise."""
    soft = cv2.GaussianBlur(scene, (0, 0), sigmaX=np.atleast_1d(sigma)[0], sigmaY=np.atleast_1d(sigma)[-1])
    return (soft + rng.normal(0, noise, scene.shape)).astype(np.float32)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


@pytest.fixture
def noise_flows() -> np.ndarray:
    return uneven_flows()


@pytest.fixture(scope="session")
def clip(tmp_path_factory):
    """A short video whose frames bend, for tests that read it and leave it as it is."""
    path = tmp_path_factory.mktemp("clip") / "clip.mkv"
    write_video(path, make_sequence(seed=31, count=8, size=80, rms=0.8).frames, 25)
    return path


@pytest.fixture
def run(capsys):
    """Run a command in this process; what it returned, printed and complained."""
    from turbrestore_cli.__main__ import main

    def call(*words):
        code = main([str(word) for word in words])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return call

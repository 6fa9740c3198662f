"""What a deconvolution takes, against what is planned for it."""

import tracemalloc
from contextlib import contextmanager
from itertools import pairwise

import cv2
import numpy as np
import pytest

from turbrestore.deconvolution.deconvolution_memory import DeconvolutionWork, Room
from turbrestore.deconvolution.deconvolve import METHODS, DeconvolutionParams, deconvolve
from turbrestore.deconvolution.nonlocal_tv import NonlocalParams, nonlocal_weights
from turbrestore.deconvolution.primal_dual import REST, PrimalDual

SHAPE = (256, 400)


@pytest.fixture(scope="module")
def image():
    return cv2.GaussianBlur(np.random.default_rng(0).random(SHAPE, np.float32), (0, 0), 1.5)


@contextmanager
def traced():
    """List that holds the peak of arrays afterwards."""
    peaks = []
    tracemalloc.start()
    try:
        yield peaks
        peaks.append(tracemalloc.get_traced_memory()[1])
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("params", "threads"),
    [
        (NonlocalParams(), 1),
        (NonlocalParams(), 8),
        (NonlocalParams(search=31), 1),
        (NonlocalParams(search=9, best=60), 1),
    ],
)
@pytest.mark.parametrize("join", ["compiled", "numpy"])
def test_weights_keep_the_plan(image, tmp_path, monkeypatch, params, threads, join):
    if join == "numpy":
        monkeypatch.setattr("turbrestore.deconvolution.patch_pairs.compiled", lambda loops: None)
    # The compiler takes memory once.
    nonlocal_weights(image[:16, :16])
    with traced() as peaks:
        nonlocal_weights(image, params, tmp_path, threads)
    assert peaks[0] < DeconvolutionWork(SHAPE, 1, "nltv", params).peak(Room(threads, True))


def test_threads_are_what_weights_take_most_for(image, tmp_path, monkeypatch):
    monkeypatch.setattr("turbrestore.deconvolution.nonlocal_tv.available_cores", lambda: 8)
    monkeypatch.setattr("turbrestore.runtime.threads.available_cores", lambda: 8)
    # Compiled, the search keeps no distances.
    monkeypatch.setattr("turbrestore.deconvolution.patch_search.compiled", lambda loops: None)
    taken = {}
    for threads in (1, 0):
        with traced() as peaks:
            nonlocal_weights(image, folder=tmp_path, threads=threads)
        taken[threads] = peaks[0]
    # A tile of each is 22 MB; what is asked for counts, not the cores there are.
    assert taken[0] > taken[1] + 40e6


def test_a_deconvolution_keeps_its_limit_on_many_cores(image, tmp_path, monkeypatch):
    for module in ("deconvolution.deconvolve", "deconvolution.nonlocal_tv", "runtime.threads"):
        monkeypatch.setattr(f"turbrestore.{module}.available_cores", lambda: 8)
    limit = DeconvolutionWork((280, 420), 1, "nltv", NonlocalParams()).peak(Room(1, True))
    with traced() as peaks:
        deconvolve(image, 1.5, DeconvolutionParams(iterations=2, memory=limit), scratch=tmp_path)
    assert peaks[0] < limit


@pytest.mark.parametrize("room", [Room(1, False), Room(8, True), Room(1, True, True), Room(8, True, True)])
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("channels", [1, 3])
def test_every_method_keeps_what_is_planned(monkeypatch, tmp_path, room, method, channels):
    """Of an image of many strips; mapped pages are not seen here, but by benchmarks/memory.py."""
    image = np.random.default_rng(0).random((600, 800, 3)[: 2 + (channels == 3)], np.float32)
    # As many earlier images are kept as are looked back to.
    monkeypatch.setattr(PrimalDual, "window", 1)
    params = DeconvolutionParams(method=method, iterations=REST + 2, tolerance=0, channels="each")
    work = DeconvolutionWork((640, 840), channels, method, NonlocalParams())
    monkeypatch.setattr("turbrestore.deconvolution.deconvolve.DeconvolutionWork.room", lambda *_: room)
    deconvolve(image[:48, :48], 1.5, params)
    with traced() as peaks:
        deconvolve(image, 1.5, params, scratch=tmp_path)
    assert peaks[0] < work.peak(room)


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("params", [NonlocalParams(), NonlocalParams(search=61, best=40)])
def test_more_memory_is_never_worse(channels, params):
    work = DeconvolutionWork((1080, 1920), channels, "nltv", params)
    rooms = [work.room(memory, 8) for memory in np.geomspace(1e8, 1e11, 200)]
    assert rooms[0] == Room(1, True, True)
    assert rooms[-1] == work.room(None, 8) == Room(8, False)
    assert all(before.threads <= after.threads for before, after in pairwise(rooms))
    assert {room.in_file for room in rooms if room.threads == 8} == {True, False}


def test_large_windows_and_many_neighbours_count():
    least = DeconvolutionWork((540, 960), 1, "nltv", NonlocalParams()).peak(Room(1, True))
    for more in (NonlocalParams(search=101), NonlocalParams(best=60)):
        assert DeconvolutionWork((540, 960), 1, "nltv", more).peak(Room(1, True)) > least + 3e7

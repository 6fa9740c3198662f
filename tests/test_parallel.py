import threading
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest

from conftest import make_sequence
from turbrestore.flow import FlowParams
from turbrestore.parallel import map_ahead
from turbrestore.pipeline import RestoreParams, restore


def test_results_keep_their_order():
    assert list(map_ahead(lambda n: n * n, range(50), threads=3)) == [(n, n * n) for n in range(50)]


def test_items_are_taken_only_a_few_ahead():
    taken = []
    results = map_ahead(abs, (taken.append(n) or n for n in range(100)), threads=2)
    next(results)
    assert len(taken) <= 5
    results.close()


def test_an_error_reaches_the_caller_and_no_thread_is_left():
    def fail(n):
        raise ValueError("seen")

    with pytest.raises(ValueError, match="seen"):
        list(map_ahead(fail, range(10), threads=2))
    assert threading.active_count() == 1


def test_opencv_threads_are_given_back():
    before = cv2.getNumThreads()
    list(map_ahead(abs, [1]))
    assert cv2.getNumThreads() == before


def test_streams_that_are_worked_on_in_turns_give_the_threads_back():
    before = cv2.getNumThreads()
    cv2.setNumThreads(2)
    try:
        pairs = zip(map_ahead(abs, [1, 2]), map_ahead(abs, [3, 4, 5]), strict=False)
        next(pairs)
        assert cv2.getNumThreads() == 1
        list(pairs)
        del pairs
        assert cv2.getNumThreads() == 2
        first, second = map_ahead(abs, [1, 2]), map_ahead(abs, [3, 4])
        next(first), next(second)
        first.close()
        assert cv2.getNumThreads() == 1
        second.close()
        assert cv2.getNumThreads() == 2
    finally:
        cv2.setNumThreads(before)


def test_uses_in_several_threads_give_the_threads_back():
    before = cv2.getNumThreads()
    cv2.setNumThreads(2)
    try:
        with ThreadPoolExecutor(4) as pool:
            list(pool.map(lambda n: list(map_ahead(abs, range(n), threads=1)), range(40)))
        assert cv2.getNumThreads() == 2
    finally:
        cv2.setNumThreads(before)


def test_a_restoration_is_the_same_bytes_whatever_the_number_of_threads():
    frames = make_sequence(seed=3, count=14).frames[:, :64, :80]
    one, *others = (restore(frames, RestoreParams(train=6, flow=FlowParams(threads=n))) for n in (1, 2, 4))
    for other in others:
        for name in ("image", "mean"):
            assert getattr(one, name).tobytes() == getattr(other, name).tobytes()
        assert one.centroid.flows.tobytes() == other.centroid.flows.tobytes()
        assert np.array_equal(one.filtered.shares, other.filtered.shares)

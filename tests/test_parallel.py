import threading

import cv2
import pytest

from turbrestore.parallel import map_ahead


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

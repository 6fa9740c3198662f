import itertools
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest

from conftest import make_sequence
from turbrestore.pipeline import RestoreParams, restore
from turbrestore.registration.flow import FlowParams
from turbrestore.runtime.runtime import Runtime
from turbrestore.runtime.threads import ThreadTeam, map_ahead, map_in_turns, sum_in_threads


def test_results_keep_their_order():
    assert list(map_ahead(lambda n: n * n, range(50), threads=3)) == [(n, n * n) for n in range(50)]


def test_items_are_taken_only_a_few_ahead():
    taken = []
    results = map_ahead(abs, (taken.append(n) or n for n in range(100)), threads=2)
    next(results)
    assert len(taken) <= 5
    results.close()


def test_an_error_reaches_the_caller_and_no_thread_is_left():
    before = set(threading.enumerate())

    def fail(n):
        raise ValueError("seen")

    with pytest.raises(ValueError, match="seen"):
        list(map_ahead(fail, range(10), threads=2))
    assert set(threading.enumerate()) <= before


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


def hurried(number):
    """Takes longer for earlier items, so that later ones overtake them."""
    time.sleep(0.002 * (3 - number % 4))
    return number


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_what_carries_a_state_sees_items_in_their_order(threads):
    seen, inside = [], threading.Lock()

    def in_turn(number):
        assert inside.acquire(blocking=False)
        seen.append(number)
        inside.release()
        return sum(seen)

    expected = list(itertools.accumulate(range(30)))
    assert list(map_in_turns(hurried, in_turn, float, range(30), threads)) == expected
    assert seen == list(range(30))


@pytest.mark.parametrize("step", ["early", "in_turn", "late"])
def test_the_first_error_reaches_the_caller_and_nobody_waits_for_a_turn(step):
    def fail(number):
        hurried(number)
        if number in (5, 6):
            raise ValueError(f"seen {number}")
        return number

    steps = {name: fail if name == step else hurried for name in ("early", "in_turn", "late")}
    before = set(threading.enumerate())
    found = map_in_turns(**steps, items=range(20), threads=3)
    assert list(itertools.islice(found, 5)) == [0, 1, 2, 3, 4]
    with pytest.raises(ValueError, match="seen 5"):
        next(found)
    assert set(threading.enumerate()) <= before


LEAVE_OFTEN = """
import itertools, sys
from turbrestore.runtime.threads import map_in_turns
sys.setswitchinterval(1e-6)
for _ in range(2500):
    found = map_in_turns(abs, abs, abs, itertools.count(), threads=4)
    assert [next(found), next(found)] == [0, 1]
    found.close()
"""


@pytest.mark.long
def test_a_stream_of_turns_can_be_left_at_any_moment():
    # In a process of its own: one that waits for an item that was given up never ends.
    subprocess.run([sys.executable, "-c", LEAVE_OFTEN], check=True, timeout=120)


@pytest.mark.parametrize("count", [1, 8, 9, 40])
def test_sums_do_not_depend_on_the_number_of_threads(count):
    values = np.random.default_rng(0).normal(size=(count, 5)) * 10.0 ** np.arange(-2, 3)

    def add(some):
        return np.sum(some, axis=0), np.sum(np.square(some), axis=0)

    one, *others = (sum_in_threads(add, iter(values), threads) for threads in (1, 2, 5))
    assert one[0] == pytest.approx(values.sum(axis=0), rel=1e-12)
    assert one[1] == pytest.approx(np.square(values).sum(axis=0), rel=1e-12)
    assert all(a.tobytes() == b.tobytes() for other in others for a, b in zip(one, other, strict=True))


@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize("count", [0, 1, 2, 7])
def test_a_crew_hands_results_over_in_order(threads, count):
    last = threading.Event()

    def work(number):
        if number == count - 1:
            last.set()
        if number == 0 and threads > 1:
            # It ends after those between.
            assert last.wait(10)
        return 10 * number

    with ThreadTeam(threads) as team:
        assert list(team.map(work, range(count))) == [10 * number for number in range(count)]


def test_a_crew_of_one_is_the_caller():
    with ThreadTeam(1) as team:
        assert set(team.map(lambda _: threading.current_thread(), range(3))) == {threading.current_thread()}


def test_a_crew_is_so_many_threads_and_the_caller_one_of_them():
    together, names = threading.Barrier(3, timeout=10), set()

    def meet(_):
        together.wait()
        names.add(threading.current_thread())

    with ThreadTeam(3) as team:
        list(team.map(meet, range(3)))
    assert len(names) == 3 and threading.current_thread() in names


@pytest.mark.parametrize("bad", range(3))
def test_an_error_in_a_crew_ends_the_work(bad):
    together, done = threading.Barrier(2, timeout=10), []

    def work(number):
        if number < 2:
            # Both threads have begun.
            together.wait()
        if number == bad:
            raise ZeroDivisionError
        time.sleep(0.05)
        done.append(number)

    with ThreadTeam(2) as team:
        with pytest.raises(ZeroDivisionError):
            list(team.map(work, range(5000)))
        assert len(done) < 1000
        before = len(done)
        time.sleep(0.1)
        assert len(done) == before
        assert list(team.map(abs, [-1, -2, -3])) == [1, 2, 3]


def test_a_crew_has_ended_where_its_results_are_left():
    running, begun = [], []

    def work(number):
        begun.append(number)
        running.append(number)
        time.sleep(0.02)
        running.remove(number)

    with ThreadTeam(3) as team:
        results = team.map(work, range(5000))
        next(results)
        results.close()
        assert not running and len(begun) < 1000


def test_a_crew_may_be_called_within_itself():
    with ThreadTeam(2) as team:
        assert list(team.map(lambda n: sum(team.map(abs, range(n))), range(6))) == [0, 0, 1, 3, 6, 10]


@pytest.mark.parametrize("method", ["dis", "tvl1"])
def test_a_restoration_is_the_same_bytes_whatever_the_number_of_threads(monkeypatch, method):
    # Several strips and several sums of everything.
    monkeypatch.setattr("turbrestore.registration.warp._STRIP", 1000)
    monkeypatch.setattr("turbrestore.dynamics.dynamic_texture._STRIP_BYTES", 1 << 16)
    monkeypatch.setattr("turbrestore.deconvolution.deconvolve.PARALLEL_PIXELS", 0)
    monkeypatch.setattr("turbrestore.deconvolution.nonlocal_prior.nonlocal_tv.PARALLEL_PIXELS", 0)
    frames = make_sequence(seed=3, count=16).frames[:, :48, :64]

    def run(threads):
        return restore(frames, RestoreParams(train=8, flow=FlowParams(method)), Runtime(threads=threads))

    one, *others = map(run, (1, 3))
    for other in others:
        for name in ("image", "mean"):
            assert getattr(one, name).tobytes() == getattr(other, name).tobytes()
        assert one.centroid.flows.tobytes() == other.centroid.flows.tobytes()
        assert one.dynamics.C.tobytes() == other.dynamics.C.tobytes()
        assert one.blur.sigma == other.blur.sigma
        assert np.array_equal(one.filtered.shares, other.filtered.shares)

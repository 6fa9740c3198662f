"""Arrays in a file without a name: what they hold, what they take, and what is left of them."""

import itertools
import os
import shutil
import signal
import subprocess
import sys
import textwrap
from collections import namedtuple
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from turbrestore.core.errors import StorageError
from turbrestore.runtime.scratch import (
    drop_pages,
    iter_frames,
    iter_parts,
    iter_slices,
    mean_of,
    new_stack,
    to_scratch,
    variance_of,
)

STATM = Path("/proc/self/statm")
HUGE_PAGES = Path("/sys/kernel/mm/transparent_hugepage/enabled")
SHAPES = st.lists(st.integers(1, 7), min_size=1, max_size=4).map(tuple)


def resident() -> int:
    """Bytes of mapped files that are in memory; what other threads of the process allocate does not count."""
    return int(STATM.read_text().split()[2]) * os.sysconf("SC_PAGE_SIZE")


needs_proc = pytest.mark.skipif(not STATM.exists(), reason="memory is read from /proc")


@given(SHAPES, st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_a_stack_in_a_file_is_one_in_memory(tmp_path_factory, shape, seed):
    with pytest.MonkeyPatch.context() as patch:
        compare_with_memory(tmp_path_factory.getbasetemp(), shape, seed, patch)


def compare_with_memory(folder, shape, seed, patch):
    """Assert that it makes no difference where a stack is, nor in how many iter_parts it is gone through."""
    values = np.random.default_rng(seed).normal(size=shape).astype(np.float32)
    mapped = new_stack(shape, folder)
    mapped[...] = values
    drop_pages(mapped)
    assert isinstance(mapped, np.memmap)
    assert np.array_equal(mapped, values)
    for stack, part in itertools.product((values, mapped), (3, 1 << 22)):
        patch.setattr("turbrestore.runtime.scratch.PART", part)
        assert np.array_equal(mean_of(stack), values.mean(axis=0, dtype=np.float32))
        assert np.allclose(variance_of(stack), values.var(axis=0), atol=1e-5)
        assert np.array_equal(np.concatenate(list(iter_parts(stack))), values)
        assert all(np.array_equal(a, b) for a, b in zip(iter_frames(stack), values, strict=True))


def test_without_a_folder_or_numbers_it_is_in_memory(tmp_path):
    assert not isinstance(new_stack((2, 3)), np.memmap)
    assert new_stack((5, 0), tmp_path).shape == (5, 0)


def test_no_file_is_left_by_a_process_that_dies(tmp_path):
    code = f"""
        import os, signal
        from pathlib import Path
        from turbrestore.runtime.scratch import new_stack
        stack = new_stack((4, 1000), Path({str(tmp_path)!r}))
        stack[:] = 1
        os.kill(os.getpid(), signal.SIGKILL)
        signal.pause()
    """
    ended = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], capture_output=True, check=False)
    assert ended.returncode == -signal.SIGKILL
    assert not list(tmp_path.iterdir())


@needs_proc
def test_walking_a_stack_takes_one_frame_at_a_time(tmp_path):
    stack = new_stack((40, 512, 1024), tmp_path)
    before = resident()
    for frame in stack:
        frame[:] = 1
        drop_pages(frame)
    peak = max(resident() for frame in iter_frames(stack) if frame.sum())
    assert peak - before < 12e6
    assert stack.sum(dtype=np.float64) == stack.size
    # What was written is there, and the counter above would have seen it.
    assert resident() - before > 70e6


def test_who_leaves_a_walk_early_hands_back_what_was_seen_last(tmp_path, monkeypatch):
    released = []
    monkeypatch.setattr("turbrestore.runtime.scratch.drop_pages", lambda array: released.append(float(array[0])))
    assert any(frame[0] == 1 for frame in iter_frames(np.arange(3.0)[:, None]))
    assert released == [0, 1]


def test_changes_of_a_private_map_are_kept(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros(10_000, np.float32))
    private = np.load(tmp_path / "a.npy", mmap_mode="c")
    private[:] = 3
    drop_pages(private[5:])
    assert (private == 3).all()


def test_what_is_no_map_is_left_alone():
    for thing in (np.ones(3), None, [np.ones(2)], 4):
        drop_pages(thing)


def test_a_full_disk_is_a_clear_error(tmp_path, monkeypatch):
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: usage(10**9, 10**9 - 10**8, 10**8))
    with pytest.raises(StorageError, match=r"expected 400 MB free .*, found 100 MB; name another scratch folder, or"):
        new_stack((100, 1000, 1000), tmp_path)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with pytest.raises(StorageError, match="name another scratch folder by TMPDIR"):
        new_stack((100, 1000, 1000), tmp_path)
    with pytest.raises(StorageError, match="nowhere: cannot hold"):
        monkeypatch.undo()
        new_stack((2, 2), tmp_path / "nowhere")


def test_an_array_is_moved_to_a_file_once(tmp_path):
    array = np.arange(6, dtype=np.float32).reshape(2, 3)
    kept = to_scratch(array, tmp_path)
    assert isinstance(kept, np.memmap) and np.array_equal(kept, array)
    for there in (kept, kept[1:], np.asarray(kept).reshape(-1)):
        assert to_scratch(there, tmp_path) is there
    # Of the class of mapped arrays, but in memory.
    copy = kept.copy()
    assert to_scratch(copy, tmp_path) is not copy
    assert to_scratch(array) is array


@needs_proc
def test_work_in_slices_takes_a_slice_of_each_array_at_a_time(tmp_path):
    read, written = (new_stack((40, 250_000), tmp_path) for _ in range(2))
    read[:] = 1
    drop_pages(read)
    before, most = resident(), 0
    for rows in iter_slices(40, 4, read, written):
        written[rows] = 2 * read[rows]
        most = max(most, resident() - before)
    # Each array takes 40 MB.
    assert most < 24e6
    assert resident() - before < 4e6
    assert (written == 2).all()

"""What Windows and macOS lack or do otherwise, taken away here: every fallback runs on this system too."""

import errno
import mmap
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from turbrestore.core.errors import OutputError, StorageError
from turbrestore.io.output import atomic_output, atomic_write
from turbrestore.io.video import open_frames
from turbrestore.registration.centroid import CentroidParams
from turbrestore.runs.folder_lock import LOCK, lock_folder
from turbrestore.runtime.scratch import drop_pages, new_stack
from turbrestore.runtime.threads import available_cores
from turbrestore.settings import RestoreParams
from turbrestore_cli import signals
from turbrestore_cli.batch import work
from turbrestore_cli.clip import Order
from turbrestore_cli.options import Machine, Selection


class TestLocks:
    def test_windows_locks_with_its_own_module(self, tmp_path, monkeypatch):
        held = []

        def locking(descriptor, mode, count):
            if held:
                raise PermissionError(errno.EACCES, "locked")
            held.append(descriptor)

        monkeypatch.setitem(sys.modules, "fcntl", None)
        monkeypatch.setitem(sys.modules, "msvcrt", SimpleNamespace(locking=locking, LK_NBLCK=2))
        with lock_folder(tmp_path / "kept") as locks:
            assert locks
            with pytest.raises(OutputError, match="another run is at work"), lock_folder(tmp_path / "kept"):
                pass

    def test_a_system_without_locks_says_so(self, tmp_path, monkeypatch):
        monkeypatch.setitem(sys.modules, "fcntl", None)
        monkeypatch.setitem(sys.modules, "msvcrt", None)
        monkeypatch.delattr(os, "O_NOFOLLOW")
        with lock_folder(tmp_path / "kept") as locks:
            assert not locks
        assert not (tmp_path / "kept").exists()

    def test_a_lock_file_that_cannot_go_while_it_is_open_goes_afterwards(self, tmp_path, monkeypatch):
        unlink, tries = Path.unlink, []

        def once_closed(path, missing_ok=False):
            if path.name == LOCK and not tries:
                tries.append(path)
                raise PermissionError(errno.EACCES, "in use")
            unlink(path, missing_ok)

        monkeypatch.setattr(Path, "unlink", once_closed)
        with lock_folder(tmp_path / "kept"):
            pass
        assert tries and not (tmp_path / "kept").exists()


class TestFiles:
    def test_stacks_need_neither_advice_nor_reserved_space(self, tmp_path, monkeypatch):
        monkeypatch.delattr(mmap, "MADV_DONTNEED")
        monkeypatch.delattr(os, "posix_fallocate")
        stack = new_stack((3, 4), tmp_path)
        stack[...] = 7
        drop_pages(stack)
        assert stack.sum() == 84

    def test_a_file_that_is_open_elsewhere_is_not_replaced(self, tmp_path, monkeypatch):
        (tmp_path / "a.png").write_bytes(b"old")

        def in_use(path, target):
            raise PermissionError(errno.EACCES, "in use by another process")

        monkeypatch.setattr(Path, "replace", in_use)
        with pytest.raises(StorageError, match=r"a\.png: cannot be written \(in use by another process\)"):
            atomic_write(tmp_path / "a.png", b"new", overwrite=True)
        assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("a.png", b"old")]

    def test_the_error_of_a_writer_is_told_where_its_file_cannot_go(self, tmp_path, monkeypatch):
        def in_use(path, missing_ok=False):
            raise PermissionError(errno.EACCES, "in use by another process")

        monkeypatch.setattr(Path, "unlink", in_use)
        with pytest.raises(ZeroDivisionError), atomic_output(tmp_path / "a.png"):
            raise ZeroDivisionError


def test_cores_are_counted_without_affinity(monkeypatch):
    monkeypatch.delattr(os, "sched_getaffinity")
    assert available_cores() == os.cpu_count()


def test_signals_that_the_system_lacks_are_left_out(monkeypatch):
    monkeypatch.delattr(signal, "SIGHUP")
    monkeypatch.setattr(signal, "SIGBREAK", signal.SIGUSR1, raising=False)
    heard = []
    with pytest.raises(KeyboardInterrupt), signals.termination_raises(heard):
        signal.raise_signal(signal.SIGUSR1)
    assert len(heard) == 1


# Everything at once, in a process whose console knows the letters of western Europe alone.
PRELUDE = """
import mmap, os, signal, sys
sys.modules["fcntl"] = sys.modules["resource"] = sys.modules["termios"] = None
for module, name in (
    (mmap, "MADV_DONTNEED"), (os, "posix_fallocate"), (os, "sched_getaffinity"), (os, "O_NOFOLLOW"), (signal, "SIGHUP")
):
    delattr(module, name)
from turbrestore_cli.__main__ import main
sys.exit(main(sys.argv[1:]))
"""


def test_a_run_without_posix_on_a_console_without_utf_8(clip, tmp_path):
    words = ["restore", str(clip), str(tmp_path / "sharp.png"), "--keep", str(tmp_path / "kept"), "--sigma=1"]
    words += ["--memory-limit=400MB", "--centroid.iterations=1", "--filter.inner-iterations=1"]
    words += ["--deconvolution.iterations=2"]
    environment = {**os.environ, "PYTHONIOENCODING": "cp1252", "PYTHONUTF8": "0", "LC_ALL": "C"}
    done = subprocess.run(
        [sys.executable, "-c", PRELUDE, *words, "--verbose"], capture_output=True, check=False, env=environment
    )
    told = done.stderr.decode("cp1252")
    assert (done.returncode, done.stdout) == (0, b""), told
    assert "sharp.png" in told and "Traceback" not in told
    assert (tmp_path / "sharp.png").exists() and not (tmp_path / "kept" / LOCK).exists()


def test_a_clip_is_restored_in_a_process_that_is_spawned(clip, tmp_path):
    settings = RestoreParams(until="centroid", centroid=CentroidParams(iterations=1))
    order = Order(clip, tmp_path / "a.png", Selection(), settings, Machine(threads=1))
    assert pickle.loads(pickle.dumps(order)) == order
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        row = pool.apply(work, (order,))
    assert row.state == "done", row.reason
    assert np.isfinite(open_frames(clip).read()).all() and (tmp_path / "a.png").exists()

"""Freed memory goes back to the system while that is asked for, and the setting ends afterwards."""

import os
import platform
import subprocess
import sys
import textwrap
from types import SimpleNamespace

import pytest

from turbrestore.runtime.allocator import returning_freed_memory


def test_the_allocator_gets_its_setting_back_after_an_error(monkeypatch):
    calls = []
    library = SimpleNamespace(mallopt=lambda *setting: calls.append(setting), malloc_trim=calls.append)
    monkeypatch.setattr("ctypes.CDLL", lambda name: library)
    monkeypatch.setattr("platform.libc_ver", lambda: ("glibc", "2.36"))
    with returning_freed_memory(False):
        pass
    assert calls == []
    with pytest.raises(KeyError), returning_freed_memory():
        raise KeyError
    assert calls == [(-3, 1 << 20), (-3, 32 << 20), 0]
    calls.clear()
    monkeypatch.setattr("platform.libc_ver", lambda: ("", ""))
    with returning_freed_memory():
        pass
    assert calls == []


# Only the allocator of glibc is told when to return memory; others, as on macOS, follow rules of their own.
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the allocator is another one than glibc's")
def test_arrays_that_are_freed_go_back_to_the_system():
    code = """
        import re, sys
        from pathlib import Path
        import numpy as np
        from turbrestore.runtime.allocator import returning_freed_memory

        def resident():
            return int(re.search(r"VmRSS:\\s*(\\d+)", Path("/proc/self/status").read_text())[1])

        with returning_freed_memory(sys.argv[1] == "return"):
            # The C library keeps freed arrays of a size that it has seen returned.
            del [np.ones(3 << 20)][0]
            arrays = [np.ones(1 << 18) for _ in range(64)]
            last, before = np.ones(1 << 18), resident()
            del arrays
            print(before - resident())
    """
    words = [sys.executable, "-c", textwrap.dedent(code)]
    # Dask sets the allocator for the processes that it starts, and leaves that in the environment.
    own = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")}
    freed = [
        int(subprocess.run([*words, how], env=own, capture_output=True, text=True, check=True).stdout)
        for how in ("return", "keep")
    ]
    assert freed[0] > 100_000
    assert freed[1] < freed[0] / 2

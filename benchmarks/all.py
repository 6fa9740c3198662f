"""Make every table of ``benchmarks/results`` anew, and the figures in README.md and docs/ from them.

    TURBRESTORE_DATA=DIR python benchmarks/all.py --write

A table that was made by this revision of the code is left as it is, so that a run that was interrupted goes on where it
ended.  Tables are made two at a time, those that measure time one after the other at the end.  Names take some of them.
Without ``--write`` the program says of which revision each table is, and what it took.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from methods.packages import NETWORKS, PackageError, make_environment
from provenance import LINE, revision, with_origin
from texts import fill_texts

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "results"
# What the origin of a table says if its script has failed.
BROKEN = "; a bound does not hold"


@dataclass(frozen=True)
class Table:
    """Words after ``python benchmarks/``; whether time is measured, so that nothing else may run; what is missing."""

    words: str
    timed: bool = False
    missing: Callable[[], str] = lambda: ""


def _torch() -> str:
    return "" if find_spec("torch") else "torch is not installed"


def _gpu() -> str:
    if reason := _torch():
        return reason
    import torch

    return "" if torch.cuda.is_available() else "there is no GPU"


# The longest first, so that two processes end at about the same time.
TABLES = {
    "peers": Table("peers.py"),
    "robustness": Table("robustness.py"),
    "ablation": Table("ablation.py --clips drawn_* ao_camera_medium"),
    "blur_calibration": Table("blur_calibration.py {scratch}"),
    "quality": Table("quality.py"),
    "blur_training": Table("blur_training.py train", missing=_torch),
    "filter": Table("filter.py ao_camera_medium purdue1_brick_strong quick_chart_weak"),
    "dynamics": Table("dynamics.py"),
    "oracles": Table("oracles.py"),
    "outliers": Table("outliers.py"),
    "guards": Table("guards.py"),
    "smooth_noise": Table("smooth_noise.py"),
    "blur": Table("blur.py"),
    "registration": Table("registration.py"),
    "memory": Table("memory.py --quick"),
    "steady": Table("steady.py reported"),
    "stacking": Table("stacking.py"),
    "verdicts": Table("verdicts.py"),
    "answers": Table("answers.py"),
    "flow_calls": Table("flow_calls.py", timed=True),
    "presets": Table("flow_calls.py --presets", timed=True),
    # 546a653 is the last revision before the work on the time of a restoration.
    "speed": Table("speed.py --before 546a653", timed=True),
    "history": Table("history.py", timed=True),
    "tvl1": Table("tvl1.py --quick", timed=True),
    "device": Table("device.py --device cuda --size 1080 1920 --frames 100 --runs 1", timed=True, missing=_gpu),
}


def main() -> int:
    """Make tables and texts, or list them; 1 where a bound of a table is broken or a table cannot be made."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"all of {', '.join(TABLES)} by default")
    parser.add_argument("--write", action="store_true", help="make what is not of this revision")
    options = parser.parse_args()
    if unknown := set(options.names) - set(TABLES):
        parser.error(f"expected names of {', '.join(TABLES)}, found {', '.join(sorted(unknown))}")
    chosen = {name: table for name, table in TABLES.items() if not options.names or name in options.names}
    if not options.write:
        for name in chosen:
            print(f"{name}: {origin_of(RESULTS / f'{name}.md')}")
        return 0
    try:
        # Tables that read text want the second reader from the start.
        make_environment(NETWORKS)
    except PackageError as error:
        print(f"without the network and the second reader: {error}")
    with ThreadPoolExecutor(2) as pool:
        done = [*pool.map(lambda name: make(name, TABLES[name]), [name for name in chosen if not chosen[name].timed])]
    done += [make(name, table) for name, table in chosen.items() if table.timed]
    changed = fill_texts()
    print(f"texts with new figures: {', '.join(changed) or 'none'}")
    return int(not all(done))


def make(name: str, table: Table) -> bool:
    """Make a table unless it is of this revision; whether it is there and its bounds hold."""
    path, now = RESULTS / f"{name}.md", revision()
    if now.isalnum() and now != "unknown" and path.exists() and _is_of(path, now):
        print(f"{name}: of this revision already", flush=True)
        return BROKEN not in origin_of(path)
    if reason := table.missing():
        print(f"{name}: left as it is: {reason}", flush=True)
        return True
    before, clock, spent = path.read_bytes() if path.exists() else b"", time.monotonic(), _children()
    with tempfile.TemporaryDirectory() as scratch:
        words = [word.format(scratch=scratch) for word in table.words.split()]
        command = [sys.executable, str(HERE / words[0]), *words[1:], "--write", str(path)]
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=HERE.parent, env=_environment())
    if revision() != now:
        path.unlink(missing_ok=True)
        if before:
            path.write_bytes(before)
        print(f"{name}: NOT WRITTEN, the code has changed since revision {now}", flush=True)
        return False
    written = path.exists() and path.read_bytes() != before
    if written and not _is_of(path, now):
        path.write_text(with_origin(path.read_text("utf-8"), _children() - spent), "utf-8")
    if written and done.returncode and "Traceback" not in done.stderr:
        text = path.read_text("utf-8")
        path.write_text(LINE.sub(lambda found: found[0].replace(".*\n", f"{BROKEN}.*\n"), text), "utf-8")
    end = "" if done.returncode == 0 else f", exit status {done.returncode}: {''.join(done.stderr.splitlines()[-1:])}"
    print(f"{name}: {time.monotonic() - clock:.0f} s{'' if written else ', NOT WRITTEN'}{end}", flush=True)
    return written and done.returncode == 0


def origin_of(path: Path) -> str:
    """Line of a table that says what it is of."""
    found = LINE.search(path.read_text("utf-8")) if path.exists() else None
    return found[0].strip().strip("*") if found else "of no known revision"


def _is_of(path: Path, wanted: str) -> bool:
    found = LINE.search(path.read_text("utf-8"))
    return found is not None and found["revision"] == wanted


def _environment() -> dict[str, str]:
    """Threads of BLAS would only wait for each other."""
    return {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}


def _children() -> float:
    """Processor time of all processes that have ended, s."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    sys.exit(main())

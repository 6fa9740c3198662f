"""What becomes of outputs that cannot be written, and of runs that are interrupted.

    python benchmarks/interruptions.py [--json]

Runs the command line in processes of its own on a small clip that it makes: the commands of
:mod:`unwritable_outputs`, whose outputs cannot be written, and SIGINT and SIGKILL at ten points of a run each.  Nothing
partial may be left, inputs must stay as they are, and a run that was interrupted must go on with what it has kept and
end as one that was not, bit for bit.  Exit code 1 if anything fails.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from unwritable_outputs import COMMAND, SETTINGS, Result, can_mount, digests, execute, output_cases, run_case

from turbrestore.io.video import write_video
from turbrestore.synthesis.scenes import resolution_chart
from turbrestore.synthesis.smooth_flow import distort, smooth_flows

POINTS = 10
STAGES = {
    "centroid.npz": "centroid",
    "dynamics.npz": "flow model",
    "filtered.npz": "filter",
    "deconvolution.npz": "deconvolution",
}
RESTORE = ["restore", "clip.mkv", "o.png", "--keep=kept", "--checkpoint-every=8", "--report=r.html", *SETTINGS]


def whole_run(clip: Path, folder: Path) -> tuple[dict[str, str], float]:
    """Digests of a run without interruption, and the seconds from the lock to the end."""
    folder.mkdir()
    shutil.copy(clip, folder / "clip.mkv")
    with subprocess.Popen([*COMMAND, *RESTORE], cwd=folder, stderr=subprocess.PIPE) as process:
        start = wait_for_lock(folder, process)
        process.communicate()
        if process.returncode:
            raise SystemExit("the run without interruption has failed")
        return digests(folder), time.perf_counter() - start


def wait_for_lock(folder: Path, process: subprocess.Popen[bytes]) -> float:
    """Wait until the run has begun."""
    while not (folder / "kept" / ".lock").exists() and process.poll() is None:
        time.sleep(0.002)
    return time.perf_counter()


def interrupted_run(clip: Path, root: Path, number: signal.Signals, delay: float, expected: dict[str, str]) -> Result:
    """Interrupt a run after a delay, or sooner if it is over by then."""
    for share in (1.0, 0.8, 0.6, 0.4, 0.2):
        result = try_interruption(clip, root, number, share * delay, expected)
        if result is not None:
            return result
    return Result(f"{number.name} after {delay:.2f} s", ("the run was over each time",))


def try_interruption(
    clip: Path, root: Path, number: signal.Signals, delay: float, expected: dict[str, str]
) -> Result | None:
    """Interrupt a run, look at what is there, resume it, compare; None if it was over before."""
    faults: list[str] = []
    with tempfile.TemporaryDirectory(dir=root) as name:
        folder = Path(name)
        shutil.copy(clip, folder / "clip.mkv")
        with subprocess.Popen([*COMMAND, *RESTORE], cwd=folder, stderr=subprocess.PIPE) as process:
            wait_for_lock(folder, process)
            time.sleep(delay)
            process.send_signal(number)
            error = process.communicate()[1].decode()
        # After the last output nothing is left to interrupt but the interpreter.
        if digests(folder) == expected:
            return None
        if process.returncode != (130 if number == signal.SIGINT else -number):
            faults.append(f"exit code {process.returncode}: {error.strip()[-300:]}")
        if number == signal.SIGINT and error.count("\n") != 1:
            faults.append(f"not one line: {error.strip()[-300:]!r}")
        hidden = [str(path) for path in folder.rglob(".*") if path.suffix == ".part" or path.name == ".lock"]
        if number == signal.SIGINT and hidden:
            faults.append(f"left behind: {', '.join(hidden)}")
        faults += [f"{item}: not whole" for item in ("o.png", "o.png.toml") if not whole(folder / item, expected)]
        kept = last_kept(folder)
        resumed = execute([*(word for word in RESTORE if word != "--quiet"), "--resume"], folder)
        if kept not in resumed.error:
            faults.append(f"expected {kept!r} of the resumed run: {resumed.error.strip()[-300:]!r}")
        if resumed.code:
            faults.append(f"resuming ended with {resumed.code}: {resumed.error.strip()[-300:]}")
        if not (folder / "r.html").exists():
            faults.append("r.html: missing")
        found = {name: digest for name, digest in digests(folder).items() if not name.endswith(".part")}
        faults += [f"{item}: differs" for item in sorted({*found, *expected}) if found.get(item) != expected.get(item)]
        return Result(f"{number.name} after {delay:.2f} s", tuple(faults))


def last_kept(folder: Path) -> str:
    """Where a run in the folder should go on, in its words; read from the folder, not from the run."""
    record = folder / "kept" / "run.json"
    if not record.exists():
        # Nothing was kept, and nothing is said of it.
        return ""
    files, words = json.loads(record.read_text())["files"], "from the start"
    for name, stage in STAGES.items():
        if name not in files:
            break
        words = f"after the {stage}"
    checkpoint = folder / "kept" / "checkpoint.npz"
    if checkpoint.exists() and "filtered.npz" not in files:
        with np.load(checkpoint) as arrays:
            words += f" and {len(arrays['gain'])} frames of the filter"
    return f"continues {words}\n"


def whole(path: Path, expected: dict[str, str]) -> bool:
    """Whether a file is missing or complete."""
    return not path.exists() or hashlib.sha256(path.read_bytes()).hexdigest() == expected[path.name]


def main() -> int:
    """Print the table."""
    as_json = "--json" in sys.argv[1:]
    # Shells start background jobs with this signal ignored, and every process started here would inherit that.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with tempfile.TemporaryDirectory(prefix="interruptions-") as name:
        root = Path(name)
        rng = np.random.default_rng(0)
        flows = smooth_flows(40, 64, 64, rng)
        write_video(root / "clip.mkv", distort(resolution_chart(64, 64), flows, rng, blur=1.0, noise=0.01), 25)
        mounts = can_mount(root)
        outputs = [run_case(case, root / "clip.mkv", root) for case in output_cases(mounts)]
        expected, seconds = whole_run(root / "clip.mkv", root / "whole")
        delays = np.linspace(0, seconds, POINTS, endpoint=False)
        signals = {
            number: [interrupted_run(root / "clip.mkv", root, number, delay, expected) for delay in delays]
            for number in (signal.SIGINT, signal.SIGKILL)
        }
    groups = {"outputs that cannot be written": outputs, **{number.name: found for number, found in signals.items()}}
    failed = {name: [result for result in found if result.faults] for name, found in groups.items()}
    if as_json:
        record = {
            name: {"cases": len(found), "failed": {result.name: result.faults for result in failed[name]}}
            for name, found in groups.items()
        }
        print(json.dumps({**record, "mounts": mounts}, indent=2))
    else:
        print("| what happens | cases | as promised |\n|---|---|---|")
        for title, found in groups.items():
            print(f"| {title} | {len(found)} | {len(found) - len(failed[title])} |")
        if not mounts:
            print("\nNot run: read-only and full disks, which need the right to mount.")
        for title, found in failed.items():
            for result in found:
                print(f"\n{title}, {result.name}: {'; '.join(result.faults)}")
    return int(any(failed.values()))


if __name__ == "__main__":
    sys.exit(main())

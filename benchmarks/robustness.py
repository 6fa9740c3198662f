"""Everything that the documentation promises about odd input, bad arguments, interruptions and files, in one table.

    python benchmarks/robustness.py --write benchmarks/results/robustness.md

prints a Markdown document, writes it, and exits with 1 when a row fails.  ``--groups`` runs some of the groups.

Hostile input and interruptions are programs of their own; bad arguments and round trips are the cases of the tests.
"""

from __future__ import annotations

import argparse
import importlib
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from provenance import publish

HERE = Path(__file__).parent
TESTS = HERE.parent / "tests"
INTRO = """# Odd and damaged input

`python benchmarks/robustness.py --write benchmarks/results/robustness.md` makes these files, arguments and
interruptions, calls the command line on each, and ends with 1 if a case fails. "Found" counts the flipped bytes that
were noticed; the others changed pixels, or bytes without meaning.

"""


@dataclass(frozen=True)
class Row:
    """Cases of one kind: how many, when they pass, how many did, and what failed."""

    title: str
    count: int
    rule: str
    passed: int
    failures: tuple[str, ...] = ()


def main() -> int:
    """Run the groups, print the document and write it."""
    options = _options()
    rows: list[Row] = []
    for name in options.groups or GROUPS:
        print(f"{name} …", file=sys.stderr, flush=True)
        rows += GROUPS[name]()
    text = INTRO + table(rows)
    for row in rows:
        for failure in row.failures:
            print(f"{row.title}: {failure}", file=sys.stderr)
    publish(text, options.write)
    return int(any(row.passed < row.count for row in rows))


def table(rows: list[Row]) -> str:
    """Rows as Markdown."""
    lines = [f"| {row.title} | {row.count} | {row.rule} | {row.passed} |" for row in rows]
    return "\n".join(["| group | count | passes when | passed |", "|---|---|---|---|", *lines]) + "\n"


def hostile_input() -> list[Row]:
    """Rows of benchmarks/hostile_input.py as it prints them."""
    done = _program("hostile_input.py")
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in done.stdout.splitlines() if line[:1] == "|"]
    rows = [Row(title, int(count), rule, int(passed)) for title, count, rule, passed in cells[2:]]
    # Its complaints name the case; a program that broke off has no rows to show for it.
    return rows or [Row("hostile input", 1, "the program runs", 0, (done.stderr[-500:],))]


def interruptions() -> list[Row]:
    """Rows of benchmarks/interruptions.py."""
    done = _program("interruptions.py", "--json")
    try:
        record = json.loads(done.stdout)
    except ValueError:
        return [Row("interruptions", 1, "the program runs", 0, (done.stderr[-500:],))]
    rule = (
        "nothing partial is left, inputs stay as they are, a resumed run ends bit for bit as one without interruption"
    )
    refused = "the exit code for it, one line, nothing is left or changed"
    left_out = "" if record.pop("mounts") else "; without full and read-only disks, which need the right to mount"
    rows = []
    for title, found in record.items():
        failures = tuple(f"{name}: {'; '.join(faults)}" for name, faults in found["failed"].items())
        signal = title.startswith("SIG")
        words = f"interrupted by {title}" if signal else f"{title}{left_out}"
        rows.append(Row(words, found["cases"], rule if signal else refused, found["cases"] - len(failures), failures))
    return rows


def bad_arguments() -> list[Row]:
    """Arguments and settings files of tests/core/test_bad_arguments.py."""
    cases = importlib.import_module("test_bad_arguments")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        cases.write_inputs(folder)
        found = [(str(case), cases.complaint(case, folder)) for kind in cases.KINDS for case in kind()]
    failures = tuple(f"{case}: {complaint}" for case, complaint in found if complaint)
    rule = (
        "exit 2, or 66 for a missing file; one line, no traceback, no output; names the option or key, and the nearest "
        "name for a misspelt one"
    )
    title = "bad arguments and TOML: misspelt, wrong types, out of range, contradicting, misplaced, missing"
    return [Row(title, len(found), rule, len(found) - len(failures), failures)]


def round_trips() -> list[Row]:
    """Pairs of a writer and its reader of tests/io/test_round_trips.py."""
    pairs = importlib.import_module("test_round_trips")
    passed, failures = 0, []
    for name in pairs.PAIRS:
        try:
            count = pairs.passed(name)
            passed += count >= pairs.EXAMPLES
        except Exception as error:  # whatever a writer or reader raises is what failed
            failures.append(f"{name}: {error!r:.300}")
    title = f"round trips of every writer and reader, {pairs.EXAMPLES} random examples each"
    return [Row(title, len(pairs.PAIRS), "every array and field comes back, bit for bit", passed, tuple(failures))]


def usual_files() -> list[Row]:
    """Files of benchmarks/usual_files.py."""
    files = importlib.import_module("usual_files")
    found = list(files.figures())
    failures = tuple(f"{item.name}: {'; '.join(item.faults)}" for item in found if item.faults)
    rule = (
        f"all frames at one level, a remark, a result no more than {files.SLACK} dB worse than the temporal mean, "
        f"colours within {files.LEVELS:g} grey levels"
    )
    title = "files as programs and cameras write them: counts, FITS, twins, raw, HDR, tints, pictures that freeze"
    return [Row(title, len(found), rule, len(found) - len(failures), failures)]


def recordings() -> list[Row]:
    """Clips of benchmarks/recordings.py, and files of benchmarks/usual_files.py."""
    clips = importlib.import_module("recordings")
    rows = list(clips.figures())
    worse = tuple(
        f"{name}: {result:.2f} dB, mean {mean:.2f}" for name, result, _, mean in rows if result < mean - clips.SLACK
    )
    rule = f"the result is no more than {clips.SLACK} dB worse than the temporal mean"
    title = "clips as people record them: light, walkers, overlays, range"
    kinds = recordings_kinds(clips.SLACK)
    return [Row(title, len(rows), rule, len(rows) - len(worse), worse), kinds, *usual_files()]


def recordings_kinds(slack: float) -> Row:
    """Clips of benchmarks/recordings_kinds.py."""
    kinds = importlib.import_module("recordings_kinds")
    rows = list(kinds.figures())
    worse = tuple(
        f"{row.name}: {row.result:.2f} dB, at least {row.bound(slack):.2f}"
        for row in rows
        if row.result < row.bound(slack)
    )
    worse += tuple(
        f"{row.name}: text {row.text[0]:.2f} dB, mean {row.text[1]:.2f}"
        for row in rows
        if row.text is not None and row.text_is_worse(slack)
    )
    rule = (
        f"the result, and the text in it, is no more than {slack} dB worse than the temporal mean; in snow and rain "
        "the result is above the median"
    )
    title = "clips with more than the scene: weather, photons, titles, pictures in pictures, sensors, shadows, a car"
    return Row(title, len(rows), rule, len(rows) - len(worse), worse)


GROUPS: dict[str, Callable[[], list[Row]]] = {
    "hostile-input": hostile_input,
    "bad-arguments": bad_arguments,
    "interruptions": interruptions,
    "round-trips": round_trips,
    "recordings": recordings,
}


def _program(name: str, *words: str) -> subprocess.CompletedProcess[str]:
    done = subprocess.run([sys.executable, str(HERE / name), *words], capture_output=True, text=True, check=False)
    sys.stderr.write(done.stderr)
    return done


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--groups", nargs="+", choices=GROUPS, metavar="NAME", help=f"some of: {', '.join(GROUPS)}")
    parser.add_argument("--write", type=Path, metavar="FILE", help="write the document")
    return parser.parse_args()


if __name__ == "__main__":
    sys.path[:0] = [str(TESTS), str(TESTS / "core"), str(TESTS / "io")]
    sys.exit(main())

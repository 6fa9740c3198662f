"""A reader may follow all pages in one folder: no page writes what another has written, and the prose stays short."""

import re
import shlex
from itertools import pairwise
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
# In the order in which newcomers read them.
PAGES = [ROOT / "README.md", DOCS / "start.md", DOCS / "students.md", *sorted((DOCS / "recipes").glob("*.md"))]
PAGES.append(DOCS / "troubleshooting.md")
MOST_WORDS = 18_000


def outputs(line):
    """Files and folders that a command must not find."""
    words = shlex.split(line)
    if words[0] in ("restore", "steady", "synthesize") and not words[2].startswith("-"):
        yield words[2]
    yield from (value for name, value in pairwise(words) if name in ("--report", "--mask", "--uncertainty", "--keep"))


def test_no_command_finds_what_another_has_written():
    found = {}
    for page in PAGES:
        text = page.read_text("utf-8").replace("\\\n", " ")
        for line in re.findall(r"(?m)^ *turbrestore ((?:restore|steady|synthesize) \S+ \S+.*)$", text):
            for name in outputs(line):
                assert found.setdefault(name, line) == line, f"{page.name}: {name}"
    assert len(found) > 40


def test_the_manual_is_short():
    words = 0
    for page in [ROOT / "README.md", *DOCS.rglob("*.md")]:
        if not {"_build", "jupyter_execute"} & set(page.parts):
            text = re.sub(r"(?ms)^ *```.*?^ *```$|\$\$.*?\$\$|\]\([^)]*\)", "", page.read_text("utf-8"))
            words += sum(bool(re.search(r"\w", word)) for word in re.sub(r"\$[^$]+\$", "x", text).split())
    assert 10_000 < words <= MOST_WORDS

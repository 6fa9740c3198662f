"""The notebooks of the documentation: they run without a warning, leave nothing behind, and say what they show.

Each is run once, as a script, in a copy of the folders it needs. The documentation runs them too when it is built; a
job that does may leave out ``test_runs``.
"""

import ast
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "docs" / "examples").glob("*.py"))
LARGEST_FIGURE = 300_000
# Calls a cell may end with: their value is None.
QUIET = {"print", "show", "table", "legend", "plt.rcParams.update", "temporary.cleanup"}

# Runs a notebook and describes its figures, as the documentation would show them.
DRIVER = """
import io, json, runpy, sys
import matplotlib.pyplot as plt


def is_bare(axis):
    labels = [label for tick in axis.get_major_ticks() for label in (tick.label1, tick.label2) if label.get_visible()]
    return any(label.get_text() for label in labels) and not axis.get_label_text()


runpy.run_path(sys.argv[1])
figures = []
for number in plt.get_fignums():
    figure, picture = plt.figure(number), io.BytesIO()
    figure.savefig(picture, format="png", bbox_inches="tight")
    axes = [ax for ax in figure.axes if ax.axison]
    unlabelled = [ax.get_title() for ax in axes if is_bare(ax.xaxis) or is_bare(ax.yaxis)]
    grey = [image for ax in figure.axes for image in ax.get_images() if image.get_cmap().name == "gray"]
    limits = [image.get_clim() for image in grey]
    figures.append({"bytes": len(picture.getvalue()), "unlabelled": unlabelled, "limits": limits})
with open(sys.argv[2], "w") as file:
    json.dump(figures, file)
"""


class Cell(NamedTuple):
    kind: str
    source: str


def cells(notebook: Path) -> list[Cell]:
    """Cells of a percent script; the header before the first is left out."""
    parts = re.split(r"^# %%(.*)\n", notebook.read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]
    kinds = ["markdown" if "markdown" in mark else "code" for mark in parts[::2]]
    return [Cell(kind, source.strip()) for kind, source in zip(kinds, parts[1::2], strict=True)]


def files_in(folder: Path) -> set[Path]:
    return {path.relative_to(folder) for path in folder.rglob("*")}


def test_there_are_notebooks() -> None:
    assert [path.name[:3] for path in NOTEBOOKS] == [f"{number:02}_" for number in range(1, len(NOTEBOOKS) + 1)]
    assert len(NOTEBOOKS) >= 9


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_runs(notebook: Path, tmp_path: Path) -> None:
    work, temporary = tmp_path / "work", tmp_path / "temporary"
    here = work / "docs" / "examples"
    here.mkdir(parents=True)
    temporary.mkdir()
    (here / notebook.name).write_bytes(notebook.read_bytes())
    (work / "sample_data").symlink_to(ROOT / "sample_data", target_is_directory=True)
    before, record = files_in(work), tmp_path / "figures.json"

    environment = os.environ | {"MPLBACKEND": "Agg", "TMPDIR": str(temporary), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-W", "error", "-c", DRIVER, notebook.name, str(record)]
    done = subprocess.run(command, cwd=here, env=environment, capture_output=True, text=True, check=False)

    assert done.returncode == 0, done.stderr[-3000:]
    assert files_in(work) == before
    assert files_in(temporary) == set()
    figures = json.loads(record.read_text())
    assert figures
    for figure in figures:
        assert figure["bytes"] < LARGEST_FIGURE
        assert figure["unlabelled"] == []
        assert all(limits == [0, 1] for limits in figure["limits"])


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_has_title_and_text_around_every_figure(notebook: Path) -> None:
    found = cells(notebook)
    assert found[0].kind == "markdown"
    assert re.match(r"# # \S.*\n#\n# \S", found[0].source), "a title, then what the notebook is about"
    titles = [
        line for cell in found if cell.kind == "markdown" for line in cell.source.splitlines() if line[:4] == "# # "
    ]
    assert len(titles) == 1
    assert found[-1].kind == "markdown"
    drawing = [index for index, cell in enumerate(found) if re.search(r"^(show\(|figure\b)", cell.source, re.MULTILINE)]
    assert drawing
    for index in drawing:
        # Cells that print and draw the same results may follow each other.
        before, after = found[index - 1], found[index + 1]
        assert "markdown" in (before.kind, found[index - 2].kind)
        assert after.kind == "markdown" and not after.source.startswith("# ##"), f"no text after\n{found[index].source}"


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_cells_show_nothing_but_figures_and_what_they_print(notebook: Path) -> None:
    for cell in cells(notebook):
        if cell.kind == "code" and isinstance(last := ast.parse(cell.source).body[-1], ast.Expr):
            call = last.value
            assert isinstance(call, ast.Call), ast.unparse(last)
            shown = ast.unparse(call.func)
            assert shown in QUIET, f"{shown}(…) would show its value"

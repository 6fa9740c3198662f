"""The notebooks of the documentation: they run without a warning, leave nothing behind, and say what they show.

Each is run once, as a script, in a copy of the folders it needs. Warnings are errors there, as in all tests.
"""

import ast
import io
import re
import runpy
import tempfile
from pathlib import Path
from typing import NamedTuple

import matplotlib
import matplotlib.pyplot as plt
import pytest

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "docs" / "examples").glob("*.py"))
LARGEST_FIGURE = 300_000
# Calls a cell may end with: their value is None.
QUIET = {"print", "show", "table", "legend", "plt.rcParams.update", "temporary.cleanup"}


def is_bare(axis) -> bool:
    """Whether an axis has numbers and does not say of what."""
    labels = [label for tick in axis.get_major_ticks() for label in (tick.label1, tick.label2) if label.get_visible()]
    return any(label.get_text() for label in labels) and not axis.get_label_text()


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
def test_runs(notebook: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    work, temporary = tmp_path / "work", tmp_path / "temporary"
    here = work / "docs" / "examples"
    here.mkdir(parents=True)
    temporary.mkdir()
    (here / notebook.name).write_bytes(notebook.read_bytes())
    (work / "sample_data").symlink_to(ROOT / "sample_data", target_is_directory=True)
    before = files_in(work)
    monkeypatch.chdir(here)
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    matplotlib.use("Agg")
    plt.close("all")
    with matplotlib.rc_context():
        runpy.run_path(notebook.name)
        figures = [plt.figure(number) for number in plt.get_fignums()]
        assert figures
        for figure in figures:
            picture = io.BytesIO()
            # As the documentation shows it.
            figure.savefig(picture, format="png", bbox_inches="tight")
            assert len(picture.getvalue()) < LARGEST_FIGURE
            axes = [ax for ax in figure.axes if ax.axison]
            assert not [ax.get_title() for ax in axes if is_bare(ax.xaxis) or is_bare(ax.yaxis)]
            images = [image for ax in figure.axes for image in ax.get_images()]
            assert all(image.get_clim() == (0, 1) for image in images if image.get_cmap().name == "gray")
    plt.close("all")
    assert files_in(work) == before
    assert files_in(temporary) == set()


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


def test_cells_show_nothing_but_figures_and_what_they_print() -> None:
    for cell in (cell for notebook in NOTEBOOKS for cell in cells(notebook)):
        if cell.kind == "code" and isinstance(last := ast.parse(cell.source).body[-1], ast.Expr):
            call = last.value
            assert isinstance(call, ast.Call), ast.unparse(last)
            shown = ast.unparse(call.func)
            assert shown in QUIET, f"{shown}(…) would show its value"

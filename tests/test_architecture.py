"""Rules of the layout, read off the source."""

import ast
import subprocess
import sys
from collections import Counter
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "turbrestore"
# A folder, or a module that lies beside the folders, imports only from itself and from those before it.
ORDER = [
    "core", "runtime", "display", "io", "registration", "footage", "dynamics", "filtering", "blur_moments", "blur",
    "deconvolution", "deblurring", "verification", "steady", "synthesis", "seeing", "metrics", "wording", "results",
    "settings", "memory_plan", "runs", "preparation", "stacking", "known_geometry", "restoration_run", "tiles",
    "evidence", "pipeline", "report",
]  # fmt: skip
LEAVES = {"blur_moments"}
HEAVY = {"torch", "kornia", "numba", "matplotlib", "av", "imageio", "tifffile", "skimage", "rich", "PIL", "cyclopts"}
HEAVY |= {"imagecodecs", "astropy", "dask", "distributed", "rawpy", "msgspec"}
MODULES = sorted(path for path in PACKAGE.rglob("*.py") if path.name != "__init__.py")


def imports(path):
    """Pairs of (top-level or not, imported module) of one file, relative imports as ``.name``."""
    tree = ast.parse(path.read_text())
    top = {id(node) for node in tree.body}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((id(node) in top, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield id(node) in top, "." * node.level + (node.module or node.names[0].name)


def layer(path):
    relative = path.relative_to(PACKAGE)
    return relative.parts[0].removesuffix(".py")


def test_imports_point_downward():
    for path in MODULES:
        folder, depth = layer(path), len(path.relative_to(PACKAGE).parts)
        for _, name in imports(path):
            assert not name.startswith("turbrestore."), f"{path} imports {name}, which should be relative"
            level = len(name) - len(name.lstrip("."))
            if level == depth:
                target = name.lstrip(".").split(".")[0]
                assert ORDER.index(target) < ORDER.index(folder), f"{path} imports {name}"
                assert target not in LEAVES, f"{path} imports {name}, which only commands use"


def test_heavy_imports_stay_inside_functions():
    for path in MODULES:
        at_top = {name.split(".")[0] for top, name in imports(path) if top}
        assert not at_top & HEAVY, path


def test_rooms_and_modules_stay_small():
    sizes = Counter(path.parent.relative_to(PACKAGE).as_posix() for path in MODULES)
    assert max(sizes.values()) <= 12
    assert max(len(path.read_text().splitlines()) for path in MODULES) <= 400


APP = PACKAGE.parent / "app"


def test_modules_of_the_app_stay_small_and_nicegui_stays_in_its_views():
    using = set()
    for path in APP.rglob("*.py"):
        text = path.read_text()
        assert len(text.splitlines()) <= 400
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                assert node.end_lineno - node.body[0].lineno < 50, f"{path.name}: {node.name}"
        if any(top and name.split(".")[0] == "nicegui" for top, name in imports(path)):
            using.add(path)
    assert using == set((APP / "views").glob("[!_]*.py"))


@pytest.mark.parametrize("root", [PACKAGE, APP], ids=lambda root: root.name)
def test_modules_can_be_read_one_after_the_other(root):
    # Nothing imports in a circle, types included; a view of the app is given what it has of another.
    within = {path.relative_to(root).with_suffix("").as_posix(): path for path in root.rglob("*.py")}
    needs = {}
    for name, path in within.items():
        folder = [*name.split("/")[:-1]]
        targets = {
            "/".join([*folder[: len(folder) + 1 - level], *target.lstrip(".").split(".")])
            for _, target in imports(path)
            if (level := len(target) - len(target.lstrip(".")))
        }
        needs[name] = targets & within.keys()
    assert sum(map(len, needs.values())) > 40
    list(TopologicalSorter(needs).static_order())


def test_every_module_is_placed():
    assert {layer(path) for path in MODULES} == set(ORDER)


LIBRARIES = {
    "torch",
    "kornia",
    "numba",
    "matplotlib",
    "cv2",
    "scipy",
    "astropy",
    "dask",
    "distributed",
    "nicegui",
    "uvicorn",
}
# What takes longest to import of the libraries that a command needs.
SLOW = {"scipy.fft", "scipy.linalg", "scipy.ndimage", "scipy.optimize", "scipy.sparse", "scipy.special", "scipy.stats"}
PARSER = {"cyclopts", "rich"}
# What a restoration takes only where an option asks for it.  Numba takes its linear algebra from SciPy.
ON_DEMAND = LIBRARIES - {"cv2", "numba", "scipy"} | SLOW - {"scipy.linalg"}
ON_DEMAND |= {"rich", "skimage", "PIL", "imageio", "tifffile", "rawpy", "jinja2", "turbrestore.report"}


@pytest.mark.parametrize(
    ("action", "absent"),
    [
        ("import turbrestore", LIBRARIES | {"numpy"}),
        ("import turbrestore_cli.__main__ as m; m.main(['--help'])", LIBRARIES | PARSER),
        ("import turbrestore_cli.__main__ as m; m.main(['restore', '--help'])", LIBRARIES - {"cv2", "scipy"} | SLOW),
        ("import turbrestore_cli.__main__ as m; m.main(['app', '--help'])", LIBRARIES),
    ],
)
def test_nothing_heavy_is_loaded(action, absent):
    code = f"{action}\nimport sys\nprint(sorted({absent} & set(sys.modules)))"
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert output.splitlines()[-1] == "[]"


def test_a_restoration_loads_nothing_that_no_option_asks_for(tmp_path):
    clip = PACKAGE.parent / "sample_data" / "chart.mkv"
    words = ["restore", str(clip), str(tmp_path / "a.png"), "--preset", "fast", "--quiet"]
    words += ["--frames", "0:16", "--roi", "64,64,64,64"]
    test_nothing_heavy_is_loaded(f"import turbrestore_cli.__main__ as m; assert m.main({words}) == 0", ON_DEMAND)


def test_public_names_load_and_hide_no_module():
    import turbrestore

    modules = {path.stem for path in PACKAGE.iterdir()}
    for name in turbrestore.__all__:
        assert getattr(turbrestore, name).__module__.startswith("turbrestore.")
        assert name not in modules


def test_the_test_command_of_the_readme_is_what_ci_runs():
    root = PACKAGE.parent
    commands = [line.strip() for line in (root / ".ci" / "run").read_text().splitlines()]
    assert ".ci/test .venv-ci constraints.txt" in commands
    assert '.venv-ci/bin/python .ci/first_block.py "$fresh"' in commands
    assert "`.ci/test`" in (root / "README.md").read_text()

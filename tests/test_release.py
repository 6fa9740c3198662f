"""What a release needs: one version, every package and data file in the wheel, a workflow without secrets."""

import os
import re
import subprocess
import sys
import tomllib
from fnmatch import fnmatch
from pathlib import Path

import turbrestore

ROOT = Path(__file__).parents[1]
TOOL = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]


def test_every_package_is_in_the_wheel():
    folders = {path.parent.relative_to(ROOT) for path in (ROOT / "turbrestore").rglob("__init__.py")}
    found = {".".join(folder.parts) for folder in folders} | {
        "turbrestore_cli",
        "turbrestore_app",
        "turbrestore_app.views",
        "turbrestore_napari",
    }
    assert set(TOOL["packages"]) == found


def test_every_data_file_is_in_the_wheel():
    for path in (ROOT / "turbrestore").rglob("*"):
        if path.is_file() and path.suffix != ".py" and path.parent.name != "__pycache__":
            package = ".".join(path.parent.relative_to(ROOT).parts)
            patterns = TOOL["package-data"].get(package, [])
            assert any(fnmatch(path.name, pattern) for pattern in patterns), path


def test_the_version_is_that_of_the_package_everywhere():
    assert TOOL["dynamic"]["version"] == {"attr": "turbrestore.__version__"}
    heading = re.search(r"(?m)^## (\S+?),? ", (ROOT / "CHANGELOG.md").read_text())[1]
    assert heading == turbrestore.__version__
    assert re.search(r"(?m)^version: (\S+)$", (ROOT / "CITATION.cff").read_text())[1] == turbrestore.__version__


def test_the_workflow_has_no_secrets_and_writes_nothing():
    text = (ROOT / ".github" / "workflows" / "release.yml").read_text()
    assert "secrets." not in text and "password" not in text.replace("no password", "")
    assert re.findall(r"(?m)^ +([\w-]+: write)$", text) == ["id-token: write"]
    assert "python .ci/release.py --tag" in text


def test_folders_of_wheels_that_pip_knows_are_named_for_uv(tmp_path):
    settings = tmp_path / "pip.conf"
    settings.write_text("[global]\nfind-links =\n    /some/wheels\n    https://wheels.example/more\n")
    environment = {**os.environ, "PIP_CONFIG_FILE": str(settings), "PIP_FIND_LINKS": "/other /some/wheels"}
    words = [sys.executable, ROOT / ".ci" / "find_links.py"]
    found = subprocess.run(words, env=environment, check=True, capture_output=True, text=True).stdout.strip().split(",")
    assert {"/some/wheels", "https://wheels.example/more", "/other"} <= set(found)
    assert len(found) == len(set(found))
    for script in ("test", "run", "release.py"):
        assert "UV_FIND_LINKS" in (ROOT / ".ci" / script).read_text()

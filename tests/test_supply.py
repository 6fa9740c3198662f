"""What is installed: the oldest and the newest versions that are tested are those that are promised."""

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.version import Version

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]
# What `.ci/run` installs at its oldest.
INSTALLED = ("torch", "report", "fits", "distributed", "app", "dev")
OLDEST = [
    Requirement(text) for text in (*PROJECT["dependencies"], *(text for name in INSTALLED for text in EXTRAS[name]))
]
ALL = [Requirement(text) for text in (*PROJECT["dependencies"], *(text for extra in EXTRAS.values() for text in extra))]
# Style and types are checked with the newest version alone.
CHECKERS = {"ruff", "mypy"}
OURSELVES = "turbrestore"


def pins(name):
    lines = re.findall(r"(?m)^([\w-]+)==(\S+)$", (ROOT / name).read_text())
    return {package: Version(version) for package, version in lines}


@pytest.mark.parametrize("requirement", [item for item in OLDEST if item.name not in CHECKERS | {OURSELVES}], ids=str)
def test_every_floor_is_tested(requirement):
    floor = next(item.version for item in requirement.specifier if item.operator == ">=")
    assert pins("constraints-lowest.txt")[requirement.name] == Version(floor)


@pytest.mark.parametrize("requirement", [item for item in ALL if item.name != OURSELVES], ids=str)
def test_the_newest_version_is_pinned_and_allowed(requirement):
    assert requirement.specifier.contains(pins("constraints.txt")[requirement.name])


def test_both_are_installed_from_wheels_and_tested():
    script = (ROOT / ".ci" / "run").read_text()
    assert "export PIP_ONLY_BINARY=:all:" in script
    for environment, constraints in ((".venv-ci", "constraints.txt"), (".venv-lowest", "constraints-lowest.txt")):
        assert f".ci/test {environment} {constraints} --version" in script
        assert re.search(rf"(?m)^\.ci/test {environment} {constraints}( -m .*)?$", script)

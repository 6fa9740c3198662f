"""What is installed: the oldest and the newest versions that are tested are those that are promised."""

import re
import tomllib
from pathlib import Path

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


def test_every_floor_is_tested():
    pinned = pins("constraints-lowest.txt")
    for requirement in OLDEST:
        if requirement.name not in CHECKERS | {OURSELVES}:
            floor = next(item.version for item in requirement.specifier if item.operator == ">=")
            assert pinned[requirement.name] == Version(floor), requirement


def test_the_newest_version_is_pinned_and_allowed():
    pinned = pins("constraints.txt")
    for requirement in ALL:
        if requirement.name != OURSELVES:
            assert requirement.specifier.contains(pinned[requirement.name]), requirement


def test_both_are_installed_from_wheels_and_tested():
    run, test = ((ROOT / ".ci" / name).read_text() for name in ("run", "test"))
    assert "export PIP_ONLY_BINARY=:all:" in run
    assert "--only-binary :all: --no-binary turbrestore" in test
    for environment, constraints in ((".venv-ci", "constraints.txt"), (".venv-lowest", "constraints-lowest.txt")):
        assert f".ci/test {environment} {constraints} --version" in run
        tests = rf"(?m)^ *(\.ci/test {environment} {constraints}$|{environment}/bin/python -m pytest )"
        assert re.search(tests, run)

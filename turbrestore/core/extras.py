"""Packages that only some commands need, and the command that installs them."""

from __future__ import annotations

import re
import shlex

from .errors import ConfigurationError

_OURSELVES = "turbrestore"


def install_command(extra: str) -> str:
    """Command that installs the packages of an extra by their own names, wherever turbrestore itself came from."""
    # It takes a while to load, and is needed where something is missing.
    from importlib import metadata

    try:
        return f"pip install {shlex.join(_packages(extra))}"
    except metadata.PackageNotFoundError:
        return f"pip install '.[{extra}]'"


def missing_package(user: str, package: str, extra: str) -> ConfigurationError:
    """Return the error for a package that is not installed; ``user`` is what needs it."""
    return ConfigurationError(f"{user}: expected {package}, which is not installed; run {install_command(extra)}")


def _packages(extra: str) -> list[str]:
    from importlib import metadata

    found: list[str] = []
    for line in metadata.requires(_OURSELVES) or ():
        requirement, _, marker = (part.strip() for part in line.partition(";"))
        if not re.search(rf"""extra == ['"]{extra}['"]""", marker):
            continue
        others = re.fullmatch(rf"{_OURSELVES}\[(.+)\]", requirement)
        found += [name for other in others[1].split(",") for name in _packages(other)] if others else [requirement]
    return found

"""Settings files: how ``--config`` fills what no flag has set, and what is refused."""

from __future__ import annotations

import dataclasses
import difflib
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from cyclopts.config import Dict

from turbrestore.core.errors import ConfigurationError, InputNotFoundError

if TYPE_CHECKING:
    from cyclopts import App
    from cyclopts.argument import Argument, ArgumentCollection

# What a settings file must not decide behind the user's back.
NOT_SETTINGS = {
    *("config", "overwrite", "keep", "resume", "checkpoint_every", "truth", "report", "uncertainty", "mask", "json"),
    *("quiet", "verbose", "raw", "out", "format", "reports", "scheduler", "workers"),
}
# Two names of one setting: where a flag has set either, the file sets neither.
_SIGMA = ("sigma", "deconvolution.sigma")


def settings_file(app: App, commands: tuple[str, ...], arguments: ArgumentCollection) -> None:
    """Fill what no flag has set from the preset and from the TOML file named by ``--config``, and check numbers.

    A preset on the command line wins over the file; the settings of a file win over its own preset.
    """
    _fill_preset(app, commands, arguments)
    for argument in arguments:
        if "--config" in argument.names and argument.tokens:
            path = Path(argument.tokens[0].value)
            record = read_toml(path)
            check_keys(path, record, arguments)
            if any(other.tokens for other in arguments if _key(other) in _SIGMA):
                record = _without_sigma(record)
            # Sections are named after stages, and so are commands: under the command's name the two cannot be confused.
            for command in reversed(commands):
                record = {command: record}
            Dict(record, source=str(path))(app, commands, arguments)
            _fill_preset(app, commands, arguments)
    for argument in arguments:
        if argument.hint in (int, int | None):
            _refuse_fractions(argument)
        for kind in get_args(argument.hint):
            # Types of our own say what they expect; in a union with None Cyclopts hides this error.
            if isinstance(kind, type) and issubclass(kind, float) and kind is not float:
                _read_all(kind, argument)


def read_toml(path: Path) -> dict[str, Any]:
    """Read a file as TOML."""
    if not path.is_file():
        raise InputNotFoundError(f"{path}: no such settings file")
    try:
        return tomllib.loads(path.read_text("utf-8"))
    except RecursionError as error:
        raise ConfigurationError(f"{path}: expected settings as TOML, found nesting that is too deep") from error
    except ValueError as error:
        raise ConfigurationError(f"{path}: expected settings as TOML, found {error}") from error


def settings(arguments: ArgumentCollection) -> dict[str, Argument]:
    """Arguments that a settings file may hold, by their dotted keys; sections are left out."""
    found = {_key(argument): argument for argument in arguments if argument.name.startswith("--") and argument.parse}
    return {key: argument for key, argument in found.items() if not argument.children and key not in NOT_SETTINGS}


def check_keys(path: Path, record: dict[str, Any], arguments: ArgumentCollection) -> None:
    """Refuse keys that mean nothing, and values where a section belongs; both would be ignored silently."""
    known = set(settings(arguments))
    sections = {key.rsplit(".", depth)[0] for key in known for depth in range(1, key.count(".") + 1)}
    for key, value in _flat(record):
        name = key.replace("-", "_")
        if name in NOT_SETTINGS:
            raise ConfigurationError(f"{path}: {name} belongs on the command line, not in a settings file")
        if name in sections and not isinstance(value, dict):
            raise ConfigurationError(f"{path}: {key}: expected a section [{key}], found {value!r}")
        if name in known and isinstance(value, dict):
            raise ConfigurationError(f"{path}: {key}: expected a value, found a section")
        if name not in known | sections:
            raise ConfigurationError(f"{path}: {key} is no setting{_suggestion(name, known | sections)}")


def _flat(record: dict[str, Any], head: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys and values, a section before what it holds."""
    for key, value in record.items():
        yield head + key, value
        if isinstance(value, dict):
            yield from _flat(value, f"{head}{key}.")


def _without_sigma(record: dict[str, Any]) -> dict[str, Any]:
    """Leave out both names of the width of the blur."""
    return {
        key: _without_sigma(value) if key == "deconvolution" else value
        for key, value in record.items()
        if key != "sigma"
    }


def _fill_preset(app: App, commands: tuple[str, ...], arguments: ArgumentCollection) -> None:
    """Fill what has not been set from the preset that has been, if any; values of another name are refused later."""
    takes_settings = any("--config" in argument.names for argument in arguments)
    for argument in arguments:
        if takes_settings and argument.name == "--preset" and argument.tokens:
            name = argument.tokens[0].value
            record = preset_settings(name)
            for command in reversed(commands):
                record = {command: record}
            Dict(record, source=f"--preset {name}")(app, commands, arguments)


def preset_settings(name: str) -> dict[str, Any]:
    """Return the settings in which presets differ as one of them has them, and none for an unknown name."""
    from turbrestore.settings import PRESETS

    known = {str(preset): dict(_flat(dataclasses.asdict(params))) for preset, params in PRESETS.items()}
    record: dict[str, Any] = {}
    for key, value in known.get(name, {}).items():
        if not isinstance(value, dict) and any(other[key] != value for other in known.values()):
            *tables, last = key.split(".")
            table = record
            for part in tables:
                table = table.setdefault(part, {})
            table[last] = value
    return record


def _suggestion(name: str, known: set[str]) -> str:
    """Suggest a key: alike as a whole, or of a like last word in another section."""
    last = name.rsplit(".", 1)[-1]
    alike = difflib.get_close_matches(name, sorted(known), n=1, cutoff=0.7)
    words = difflib.get_close_matches(last, sorted({key.rsplit(".", 1)[-1] for key in known}), n=1, cutoff=0.8)
    elsewhere = sorted(key for key in known if key.rsplit(".", 1)[-1] in words)
    best = alike or elsewhere
    return f"; did you mean {best[0]}?" if best else "; turbrestore config --init FILE writes all of them"


def _key(argument: Argument) -> str:
    return argument.name.removeprefix("--").replace("-", "_")


def _read_all(kind: type[float], argument: Argument) -> None:
    for token in argument.tokens:
        kind(token.value)


def _refuse_fractions(argument: Argument) -> None:
    """Whole numbers must be written as such: conversion alone would round 3.5 frames to 4."""
    for token in argument.tokens:
        if token.value and not token.value.lstrip("+-").isdecimal():
            where = argument.name if token.source == "cli" else f"{token.source}: {_key(argument)}"
            raise ConfigurationError(f"{where}: expected a whole number, found {token.value!r}")

"""``turbrestore config``: write a settings file with every setting explained, or check one."""

from __future__ import annotations

import re
import textwrap
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Any, get_args

import tomli_w

from turbrestore import __version__
from turbrestore.core.errors import require
from turbrestore.io.output import atomic_write, check_output
from turbrestore.settings import Preset, RestoreParams

from .options import Flag, known_sigma
from .output import check_output_depth
from .settings import preset_settings, read_toml, settings
from .streams import put

if TYPE_CHECKING:
    from cyclopts import App
    from cyclopts.argument import Argument

KINDS = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}


def config(
    *, init: Path | None = None, check: Path | None = None, preset: Preset = "standard", overwrite: Flag = False
) -> None:
    """Write a settings file for ``restore --config`` with every setting explained, or check one.

    Parameters
    ----------
    init : Path
        File to write, .toml: every setting with its meaning, what it may be, and its value.
    check : Path
        File to check; what differs from the defaults is listed.
    preset : str
        Settings that the file starts from, with --init.
    overwrite : bool
        Replace an existing file.
    """
    require((init is None) != (check is None), "config: expected either --init FILE or --check FILE")
    require(init is not None or not overwrite, "--overwrite: has no effect with --check; leave it out")
    require(init is not None or preset == "standard", "--preset: has no effect with --check; leave it out")
    # The commands hang on the application, and the application on this command.
    from .commands import build

    app = build()
    if init is not None:
        check_output(init, overwrite=overwrite, suffixes=(".toml",))
        atomic_write(init, template(app, preset).encode(), overwrite)
    if check is not None:
        put("\n".join([f"{check}: valid", *_changes(app, check)]))


def template(app: App, preset: Preset) -> str:
    """Every setting of ``restore`` as TOML, with the values of a preset, explained by the words that ``--help`` has."""
    chosen = {"preset": preset, **dict(_values(preset_settings(preset)))}
    tables: dict[str, list[str]] = {"": []}
    for key, argument in _settings(app, explained=True).items():
        table, _, name = key.rpartition(".")
        value = chosen.get(key, argument.field_info.default)
        tables.setdefault(table, []).append(_entry(name, argument, value))
    head = (
        f"# Settings of turbrestore {__version__}: turbrestore restore INPUT OUTPUT --config THIS_FILE\n"
        f"# Values are those of the preset {preset}.  Lines without one are measured or left open.\n"
    )
    parts = [head, *tables.pop("")]
    for table, entries in tables.items():
        parts.append("\n".join([f"[{table}]", *entries]))
    return "\n".join(parts)


def _settings(app: App, explained: bool = False) -> dict[str, Argument]:
    return settings(app["restore"].assemble_argument_collection(parse_docstring=explained))


def _entry(name: str, argument: Argument, value: Any) -> str:
    """Comment and line of one setting; one without a default is a comment as a whole."""
    comment = textwrap.wrap(
        f"{_plain(argument.parameter.help or '')} {_allowed(argument)}", 100, break_on_hyphens=False
    )
    line = f"# {name} =" if value is None else tomli_w.dumps({name: value}).strip()
    return "\n".join([*(f"# {words}" for words in comment), line, ""])


def _plain(text: str) -> str:
    """Without the marks that Sphinx reads."""
    return " ".join(re.sub(r":\w+:`~?([^`]*)`|``([^`]*)``", lambda found: found[1] or found[2], text).split())


def _allowed(argument: Argument) -> str:
    choices = argument.get_choices()
    if choices:
        return f"({' | '.join(choices)})"
    kinds = get_args(argument.hint) or (argument.hint,)
    # bool is an int, so the first that fits counts; settings may have types of their own.
    named = [next((KINDS[known] for known in KINDS if issubclass(kind, known)), "") for kind in kinds]
    left_open = ["none by default"] if NoneType in kinds else []
    words = ", ".join([*filter(None, named), *left_open])
    return f"({words})" if words else ""


def _changes(app: App, path: Path) -> list[str]:
    """Read the file as ``restore`` would, and say what it changes."""
    words = ["restore", "input", "output.png", f"--config={path}"]
    _, bound, _ = app.parse_args(words, exit_on_error=False, print_error=False)
    given = bound.arguments
    if "selection" in given:
        given["selection"].frame_range()
        given["selection"].region()
    check_output_depth(given.get("bit_depth"))
    params = given.get("params", RestoreParams())
    known_sigma(given.get("sigma"), params.deconvolution)
    defaults = {key: argument.field_info.default for key, argument in _settings(app).items()}
    return [
        f"{key} = {value!r} (default: {'left open' if defaults[key] is None else repr(defaults[key])})"
        for key, value in _values(read_toml(path))
        if value != defaults[key]
    ]


def _values(record: dict[str, Any], head: str = "") -> list[tuple[str, Any]]:
    """Dotted keys of all values."""
    found: list[tuple[str, Any]] = []
    for key, value in record.items():
        name = head + key.replace("-", "_")
        found += _values(value, f"{name}.") if isinstance(value, dict) else [(name, value)]
    return found

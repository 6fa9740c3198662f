"""Errors that turbrestore raises on purpose.

Each message is one line: what was expected, what was found, what to do.  ``exit_code`` is the exit status of the
command line; the numbers follow the BSD ``sysexits`` convention.
"""

from typing import TypeVar

Kind = TypeVar("Kind")


class TurbrestoreError(Exception):
    """Base class of every expected failure."""

    exit_code = 1


class ConfigurationError(TurbrestoreError):
    """A setting is unknown, out of range or contradicts another one."""

    exit_code = 2


class DataError(TurbrestoreError):
    """The input exists but is not usable: damaged, wrong shape, NaN, too few frames."""

    exit_code = 65


class InputNotFoundError(TurbrestoreError):
    """The named input does not exist."""

    exit_code = 66


class OutputError(TurbrestoreError):
    """The output cannot be created: exists already, folder missing, not writable, equal to the input."""

    exit_code = 73


class StorageError(TurbrestoreError):
    """Reading or writing failed half-way, for example because the disk is full."""

    exit_code = 74


def require_between(name: str, value: float, low: float, high: float, unit: str = "") -> None:
    """Raise :class:`ConfigurationError` unless ``low <= value <= high``; NaN never does."""
    require(low <= value <= high, f"{name}: expected {low:g} to {high:g}{' ' * bool(unit)}{unit}, found {value:g}")


def require_type(name: str, value: object, kind: type[Kind], remedy: str) -> Kind:
    """Return ``value``, or raise :class:`ConfigurationError` unless it is of the type ``kind``."""
    if not isinstance(value, kind):
        raise ConfigurationError(f"{name}: expected {kind.__name__}, found {type(value).__name__}; {remedy}")
    return value


def settings_of(kind: type[Kind], value: Kind | None, name: str = "params") -> Kind:
    """Return settings of the type ``kind``, by default its own; raise :class:`ConfigurationError` for others."""
    return kind() if value is None else require_type(name, value, kind, f"write {kind.__name__}(...)")


def require(condition: bool, message: str) -> None:
    """Raise :class:`ConfigurationError` with ``message`` unless ``condition`` holds."""
    if not condition:
        raise ConfigurationError(message)

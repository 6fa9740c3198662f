"""Typed reading of JSON records that users may have edited."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any, TypeVar

from ..core.decision import Decision
from ..core.errors import ConfigurationError, DataError
from ..deblurring.guards import GuardReading

Kind = TypeVar("Kind")


@dataclass(frozen=True)
class DeblurringRecord:
    """The parts of a Deblurred that have no stage file."""

    # Whether the width of the blur was estimated by the edges, and measured by all witnesses.
    estimated: bool
    measured: bool
    readings: tuple[GuardReading, ...]
    decisions: tuple[Decision, ...]


@dataclass
class KeptRecord:
    """What ``run.json`` says; None where a part is not there yet."""

    # What each stage depends on; None if the run cannot be resumed, empty if an earlier version of turbrestore kept the
    # stages, which are then made again.
    facts: dict[str, dict[str, Any]] | None = None
    files: dict[str, str] = field(default_factory=dict)  # checksum of each file that holds the result of a stage
    deblurred: DeblurringRecord | None = None
    outputs: tuple[str, ...] = ()  # files that the run was about to write
    # The record of the input, and the fields of the restoration that lie in no other file.
    run: dict[str, Any] | None = None
    restoration: dict[str, Any] | None = None


def convert_to(kind: type[Kind], found: Any, name: str) -> Kind:
    """Convert parsed JSON, in which arrays and records are taken as they are; a DataError says what is of another type.

    ``name`` is that of the file.
    """
    import msgspec

    try:
        return msgspec.convert(found, kind, dec_hook=lambda _, array: array)
    except ConfigurationError as error:
        raise DataError(f"{name}: {error}") from error
    except msgspec.ValidationError as error:
        what, _, place = str(error).partition(" - at ")
        place = place.strip("`$").lstrip(".") or "the record"
        wrong = re.fullmatch("Expected (.*), got (.*)", what)
        told = f"expected {place} to be {wrong[1]}, found {wrong[2]}" if wrong else f"{what} in {place}"
        raise DataError(f"{name}: {told}") from error

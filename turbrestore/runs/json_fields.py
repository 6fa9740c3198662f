"""JSON records that others may have changed: values read with their types checked."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from ..blind.guards import GuardReading
from ..core.decision import Decision
from ..core.errors import DataError
from ..seeing.strength import Estimate, Seeing

Kind = TypeVar("Kind")


@dataclass(frozen=True)
class JsonFields:
    """Part of a JSON record; every method raises a DataError on what is of another type."""

    path: Path  # file of the record, for messages
    record: dict[str, Any]  # what it says

    def value(self, name: str, kind: type[Kind]) -> Kind:
        """Return a value that is no flag; whole numbers count as numbers."""
        found = self.record.get(name)
        if kind is float and type(found) is int and abs(found) < 2**1000:
            found = float(found)
        if not isinstance(found, kind) or isinstance(found, bool):
            raise self._wrong(name, kind.__name__)
        return found

    def flag(self, name: str) -> bool:
        """Return true or false."""
        found = self.record.get(name)
        if not isinstance(found, bool):
            raise self._wrong(name, "true or false")
        return found

    def part(self, name: str) -> JsonFields:
        """Return a record in the record."""
        return JsonFields(self.path, self.value(name, dict))

    def parts(self, name: str) -> list[JsonFields]:
        """Return a list of records."""
        items = self.value(name, list)
        return [JsonFields(self.path, {name: item}).part(name) for item in items]

    def texts(self, name: str) -> tuple[str, ...]:
        """Return a list of texts."""
        return tuple(JsonFields(self.path, {name: item}).value(name, str) for item in self.value(name, list))

    def numbers(self, name: str) -> dict[str, float]:
        """Return a record of numbers."""
        part = self.part(name)
        return {key: part.value(key, float) for key in part.record}

    def named_texts(self, name: str) -> dict[str, str]:
        """Return a record of texts."""
        part = self.part(name)
        return {key: part.value(key, str) for key in part.record}

    def decisions(self, name: str) -> tuple[Decision, ...]:
        """Return a list of decisions."""
        names = [item.name for item in dataclasses.fields(Decision)]
        return tuple(Decision(*(part.value(name, str) for name in names)) for part in self.parts(name))

    def guard_readings(self, name: str) -> tuple[GuardReading, ...]:
        """Return a list of readings of the guards."""
        names = ("sigma", "ringing", "overshoot", "noise_gain")
        return tuple(
            GuardReading(**{name: part.value(name, float) for name in names}, passed=part.flag("passed"))
            for part in self.parts(name)
        )

    def seeing(self, name: str) -> Seeing | None:
        """Return the strength of the turbulence; None where it was not measured."""
        if self.record.get(name) is None:
            return None
        part = self.part(name)
        values: dict[str, Any] = {}
        for item in dataclasses.fields(Seeing):
            if item.name == "remarks":
                values[item.name] = part.texts(item.name)
            elif item.type == "float":
                values[item.name] = part.value(item.name, float)
            elif part.record.get(item.name) is None:
                values[item.name] = None
            else:
                estimate = part.part(item.name)
                values[item.name] = Estimate(*(estimate.value(end, float) for end in ("value", "low", "high")))
        return Seeing(**values)

    def like(self, usual: Mapping[str, Any]) -> dict[str, Any]:
        """Return the record, whose values are sections and numbers where ``usual`` has such."""
        for name, value in usual.items():
            if name not in self.record:
                continue
            if isinstance(value, Mapping):
                self.part(name).like(value)
            elif type(value) in (int, float) and self.record[name] is not None:
                self.value(name, float)
        return self.record

    def _wrong(self, name: str, expected: str) -> DataError:
        return DataError(f"{self.path}: expected {name} to be {expected}, found {self.record.get(name)!r:.40}")

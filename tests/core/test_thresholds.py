"""Every threshold of a detector says where it comes from."""

import dataclasses
import importlib
import re
from pathlib import Path

import turbrestore

PACKAGE, TESTS = Path(turbrestore.__file__).parent, Path(__file__).parents[1]
KINDS = ("theory", "bits", "cost", "measured", "test", "chosen")
# Thresholds that nothing holds; may only become fewer.
MOST_CHOSEN = 28


def records():
    for path in sorted(PACKAGE.rglob("*.py")):
        text = path.read_text()
        if re.search(r"^class _?\w*Thresholds\b", text, re.MULTILINE):
            name = ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
            module = importlib.import_module(name)
            yield from (
                item
                for key, item in vars(module).items()
                if key.endswith("Thresholds") and isinstance(item, type) and item.__module__ == name
            )


def complaint(where, field, tests):
    unit, source = field.metadata.get("unit"), field.metadata.get("source", "")
    kind, _, words = source.partition(": ")
    if not unit or kind not in KINDS or not words.strip():
        return f"{where}.{field.name}: expected a unit and a source of {', '.join(KINDS)}, found {unit!r}, {source!r}"
    named = re.findall(r"\btest_\w+", words)
    if kind == "test" and not (named and all(f"def {name}(" in tests for name in named)):
        return f"{where}.{field.name}: expected names of tests, found {words!r}"
    return None


def test_every_threshold_has_a_unit_and_a_source_that_exists():
    tests = "\n".join(path.read_text() for path in TESTS.rglob("test_*.py"))
    found = list(records())
    assert len(found) >= 5
    for record in found:
        assert dataclasses.is_dataclass(record) and record.__dataclass_params__.frozen
        for field in dataclasses.fields(record):
            assert complaint(record.__qualname__, field, tests) is None
    chosen = [
        field.name for each in found for field in dataclasses.fields(each) if field.metadata["source"][:6] == "chosen"
    ]
    assert len(chosen) <= MOST_CHOSEN, chosen


def test_one_without_a_source_is_refused():
    for metadata in (
        {},
        {"unit": "pixels"},
        {"unit": "pixels", "source": "measured: "},
        {"unit": "", "source": "theory: a line"},
        {"unit": "pixels", "source": "experience: many clips"},
        {"unit": "pixels", "source": "test: test_that_is_not_there"},
    ):
        made = dataclasses.make_dataclass("Made", [("width", int, dataclasses.field(default=1, metadata=metadata))])
        assert complaint("Made", dataclasses.fields(made)[0], "def test_other():").startswith("Made.width: expected")

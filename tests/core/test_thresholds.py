"""Every threshold of a detector says where it comes from."""

import ast
import dataclasses
import importlib
import re
from pathlib import Path

import turbrestore

PACKAGE, TESTS = Path(turbrestore.__file__).parent, Path(__file__).parents[1]
KINDS = ("theory", "bits", "cost", "measured", "test", "chosen")
# Thresholds that nothing holds; may only become fewer.
MOST_CHOSEN = 28
# Named numeric constants, and floats within functions; may only become fewer as well.
MOST_NAMED, MOST_INLINE = 861, 337


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


def named_constants(tree):
    """Names of module-level constants whose values contain numbers."""
    for node in tree.body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = [part.id for target in targets for part in ast.walk(target) if isinstance(part, ast.Name)]
            if any(type(getattr(part, "value", None)) in (int, float) for part in ast.walk(node.value)):
                yield from (name for name in names if re.fullmatch("_?[A-Z][A-Z0-9_]*", name))


def inline_floats(tree):
    """Places and values of the floats within functions, without those that need no explanation."""
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    found = {part for function in functions for line in function.body for part in ast.walk(line)}
    floats = [part for part in found if isinstance(part, ast.Constant) and type(part.value) is float]
    return [(part.lineno, part.value) for part in floats if part.value not in (0.0, 0.5, 1.0, 2.0)]


def test_numbers_do_not_become_more():
    trees = [ast.parse(path.read_text()) for path in sorted(PACKAGE.rglob("*.py"))]
    named = sum(len([*named_constants(tree)]) for tree in trees)
    inline = sum(len(inline_floats(tree)) for tree in trees)
    advice = "measure the number, derive it, or name the source of one that is there in place of adding one"
    assert named <= MOST_NAMED, f"{named} named constants, at most {MOST_NAMED}: {advice}"
    assert inline <= MOST_INLINE, f"{inline} floats within functions, at most {MOST_INLINE}: {advice}"


def test_numbers_are_counted():
    tree = ast.parse("_WIDTH, SIDE = 3.0, 1 << 4\nNAMES = ('a',)\ndef f(x=0.3):\n    return 0.7 * x + 2.0")
    assert [*named_constants(tree)] == ["_WIDTH", "SIDE"]
    assert inline_floats(tree) == [(4, 0.7)]

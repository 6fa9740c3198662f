"""Whatever the words and settings: a value is taken or refused in one line, with the code of a usage error."""

import contextlib
import io

import tomli_w
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from turbrestore.core.errors import ConfigurationError
from turbrestore_cli.__main__ import main
from turbrestore_cli.commands import build
from turbrestore_cli.options import Selection
from turbrestore_cli.settings import settings as settings_of

MANY = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
KEYS = sorted(settings_of(build()["restore"].assemble_argument_collection(parse_docstring=True)))
VALUES = (
    st.none()
    | st.booleans()
    | st.integers(-(2**70), 2**70)
    | st.floats()
    | st.text(max_size=6)
    | st.lists(st.integers(0, 9), max_size=3)
)


def nested(flat):
    tables: dict[str, object] = {}
    for key, value in flat.items():
        *path, last = key.split(".")
        table = tables
        for part in path:
            table = table.setdefault(part, {})
        if value is not None:
            table[last] = value
    return tables


def called(*words):
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main([str(word) for word in words])
    return code, err.getvalue()


@given(flat=st.dictionaries(st.sampled_from(KEYS), VALUES, min_size=1, max_size=3))
@settings(MANY, max_examples=20)
def test_any_values_of_settings(tmp_path, flat):
    (tmp_path / "a.toml").write_text(tomli_w.dumps(nested(flat)), "utf-8")
    code, err = called("config", "--check", tmp_path / "a.toml")
    assert code in (0, 2), err
    assert code == 0 or (err.count("\n") == 1 and "Traceback" not in err)


@given(data=st.binary(max_size=60))
@settings(MANY, max_examples=20)
def test_any_bytes_as_settings(tmp_path, data):
    (tmp_path / "a.toml").write_bytes(data)
    code, err = called("config", "--check", tmp_path / "a.toml")
    assert code in (0, 2) and err.count("\n") == (code == 2)


@given(key=st.sampled_from(KEYS), value=st.text(st.characters(exclude_categories=["Cs"]), max_size=8))
@MANY
def test_any_text_as_the_value_of_a_flag(tmp_path, key, value):
    code, err = called("restore", tmp_path / "none.mkv", tmp_path / "a.png", f"--{key.replace('_', '-')}={value}")
    # With a value that is accepted, the missing input is what is wrong.
    assert code in (2, 66) and err.count("\n") == 1, err


@given(frames=st.text(max_size=12), roi=st.text(max_size=12))
@settings(MANY, max_examples=200)
def test_any_text_as_a_selection(frames, roi):
    for read in (Selection(frames=frames).frame_range, Selection(roi=roi).region):
        try:
            assert all(value is None or value >= 0 for value in read())
        except ConfigurationError as error:
            assert "\n" not in str(error)

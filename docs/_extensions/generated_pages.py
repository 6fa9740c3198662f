"""Sphinx extension: parts of pages that are generated when they are read, so that they are always up to date.

``<!-- command-line -->`` becomes a table of the commands, and ``<!-- command: restore -->`` the description of one,
both taken from the application itself; ``<!-- gallery -->`` becomes the notebooks in ``examples/``, to download and in
the contents; ``<!-- api: centroid flow -->`` becomes the reference of all public names that these modules define, and
``<!-- api-table -->`` a table of all of them.
Links to modules and to tables of ``benchmarks/``, which are not pages of the site, become links to copies of them.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Any, get_args

import turbrestore
from turbrestore_cli.commands import COMMANDS, build
from turbrestore_cli.examples import EXAMPLES

if TYPE_CHECKING:
    from sphinx.application import Sphinx

DOCS = Path(__file__).parents[1]
EXAMPLES_FOLDER = DOCS / "examples"
COPIED = re.compile(r"\]\((?=(?:\.\./)+(?:benchmarks/[\w/]+\.md|turbrestore/[\w/]+\.py)\))")
COMMAND_MARK = re.compile(r"<!-- command: ([\w -]+?) -->")
API_MARK = re.compile(r"<!-- api: ([\w. ]+) -->")
KINDS = {bool: "", int: "INT", float: "NUMBER", str: "TEXT", Path: "PATH"}


def fill(app: Sphinx, name: str, source: list[str]) -> None:
    """Replace the marks of a page that is being read, and its links to files that are copied."""
    source[0] = COPIED.sub("](path:", filled(source[0]))


def filled(text: str) -> str:
    """Replace the marks of a text by the generated parts."""
    for mark, make in (
        ("<!-- command-line -->", command_line),
        ("<!-- gallery -->", gallery),
        ("<!-- api-table -->", api_table),
    ):
        if mark in text:
            text = text.replace(mark, make())
    text = COMMAND_MARK.sub(lambda found: command(found[1]), text)
    return API_MARK.sub(lambda found: reference(found[1].split()), text)


def command_line() -> str:
    """List the commands, each with its page and what it does."""
    rows = (f"| [{words}](commands/{command_page(words)}) | {summary} |" for words, (_, summary) in COMMANDS.items())
    return "\n".join(["| command | what it does |", "|---|---|", *rows])


def command_page(words: str) -> str:
    """Name of the page of a command."""
    return f"{words.strip('-').replace(' ', '_')}.md"


def command(words: str) -> str:
    """Describe a command in Markdown: what it does, its usage, examples, and all options."""
    return "\n".join(_command(build(), words))


def _command(app: Any, words: str) -> Iterator[str]:
    command = app
    for word in words.split():
        command = command[word]
    arguments = [item for item in command.assemble_argument_collection(parse_docstring=True) if item.show]
    places = [item for item in arguments if not item.name.startswith("-")]
    options = [item for item in arguments if item.name.startswith("-")]
    yield _description(command.default_command.__doc__)
    usage = " ".join(["turbrestore", words, *(_place(item) for item in places), "[OPTIONS]"])
    yield f"```text\n{usage}\n```\n"
    yield f"Examples:\n\n```bash\n{chr(10).join(EXAMPLES[words])}\n```\n"
    yield from _table("argument", places)
    sections: dict[str, list[Any]] = {}
    for item in options:
        sections.setdefault(item.name.rpartition(".")[0], []).append(item)
    for section, items in sections.items():
        yield from _table(f"`{section}.…`" if section else "option", items)


def _table(head: str, arguments: list[Any]) -> Iterator[str]:
    if not arguments:
        return
    yield f"| {head} | meaning | default |\n|---|---|---|"
    for item in arguments:
        names = "<br>".join(f"`{name}`" for name in item.names)
        choices = " ".join(f"`{choice}`" for choice in item.get_choices() or ())
        kind = choices or "".join(f"`{name}`" for name in _kinds(item))
        yield f"| {names} {kind} | {_cell(item.parameter.help or '')} | {_default(item)} |"
    yield ""


def _kinds(item: Any) -> list[str]:
    """Names of the types that an option takes; subclasses have the name of the type that they extend."""
    kinds = [kind for kind in get_args(item.hint) or (item.hint,) if isinstance(kind, type) and kind is not NoneType]
    names = [next((KINDS[known] for known in KINDS if issubclass(kind, known)), "") for kind in kinds]
    return [name for name in names if name]


def _place(item: Any) -> str:
    return item.name if item.required else f"[{item.name}]"


def _default(item: Any) -> str:
    value = item.field_info.default
    if item.required:
        return "required"
    return "" if value is None or value is False else f"`{str(value).lower() if value is True else value}`"


def _description(docstring: str) -> str:
    """Docstring up to its first section, without the markup of roles."""
    lines = re.split(r"\n\s*Parameters\n", docstring)[0].splitlines()
    return _plain("\n".join(line.strip() for line in lines)) + "\n"


def _cell(text: str) -> str:
    return _plain(" ".join(text.split())).replace("|", "\\|").replace("$", "\\$")


def _plain(text: str) -> str:
    return re.sub(r"``([^`]*)``", r"`\1`", re.sub(r":\w+:`~?([^`]*)`", r"`\1`", text))


def public_names(modules: list[str]) -> list[str]:
    """Public names that some modules or folders of the package define, functions first."""
    named = [(name, getattr(turbrestore, name)) for name in turbrestore.__all__]
    here = [(inspect.isclass(item), _position(item, modules), name) for name, item in named]
    return [name for _, place, name in sorted(here, key=lambda entry: entry[:2]) if place >= 0]


def _position(item: Any, modules: list[str]) -> int:
    """Index of the module or folder that defines a name; -1 if none of them does."""
    module = item.__module__.removeprefix("turbrestore.")
    return next((index for index, name in enumerate(modules) if f"{module}.".startswith(f"{name}.")), -1)


def reference(modules: list[str]) -> str:
    """Write the reference of the public names of some modules."""
    blocks = []
    for name in public_names(modules):
        is_class = inspect.isclass(getattr(turbrestore, name))
        directive = (
            f".. autoclass:: turbrestore.{name}\n   :members:" if is_class else f".. autofunction:: turbrestore.{name}"
        )
        blocks.append(f"## {name}\n\n```{{eval-rst}}\n{directive}\n```\n")
    return "\n".join(blocks)


def api_pages() -> dict[Path, list[str]]:
    """Pages of the reference in order, each with the names that it shows."""
    order = re.findall(r"(?m)^\w+$", (DOCS / "api" / "index.md").read_text("utf-8").split("toctree")[1])
    pages = [DOCS / "api" / f"{name}.md" for name in order]
    return {page: public_names(API_MARK.search(page.read_text("utf-8"))[1].split()) for page in pages}


def api_table() -> str:
    """Table of the pages of the reference with their names."""
    rows = []
    for page, names in api_pages().items():
        title = page.read_text("utf-8").splitlines()[0].lstrip("# ")
        links = ", ".join(f"[{name}]({page.name}#{name.lower()})" for name in names)
        rows.append(f"| [{title}]({page.name}) | {links} |")
    return "\n".join(["| page | names |", "|---|---|", *rows])


def gallery() -> str:
    """Offer the notebooks to download, and put their pages into the contents."""
    found = sorted(path for path in EXAMPLES_FOLDER.glob("*.py") if path.name[:2].isdigit())
    files = ", ".join(f"{{download}}`{path.name} <examples/{path.name}>`" for path in found)
    tree = "\n".join(f"examples/{path.stem}" for path in found)
    return f"Download: {files}.\n\n```{{toctree}}\n:hidden:\n\n{tree}\n```\n"


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the extension."""
    app.connect("source-read", fill)
    return {"parallel_read_safe": True, "parallel_write_safe": True}

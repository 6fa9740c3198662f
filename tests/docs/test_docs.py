"""The documentation is complete: every name, every command and option, every link, and examples that run."""

import doctest
import importlib.util
import inspect
import re
from pathlib import Path

import pytest

import turbrestore
from turbrestore_cli.commands import COMMANDS, build
from turbrestore_cli.examples import EXAMPLES

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = sorted(path for path in DOCS.rglob("*.md") if not {"_build", "jupyter_execute"} & set(path.parts))
NOTEBOOKS = sorted((DOCS / "examples").glob("*.py"))
ROOT_PAGES = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")]
TABLES = sorted((ROOT / "benchmarks" / "results").glob("*.md"))
LINK = re.compile(r"\[[^\]\[]*\]\(([^)\s]+)\)")


@pytest.fixture(scope="module")
def generated():
    """The extension that generates parts of pages when they are read."""
    spec = importlib.util.spec_from_file_location("generated_pages", DOCS / "_extensions" / "generated_pages.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def text_of(path):
    """Markdown of a page, or of the text cells of a notebook."""
    text = path.read_text("utf-8")
    if path.suffix == ".py":
        cells = re.findall(r"# %% \[markdown\]\n((?:#.*\n?)+)", text)
        text = "\n".join(re.sub(r"(?m)^# ?", "", cell) for cell in cells)
    return text


def prose(text):
    """Without blocks of code."""
    return re.sub(r"(?ms)^```.*?^```$", "", text)


def anchors(text):
    """Headings as links name them, the way code hosts and MyST do."""
    for title in re.findall(r"(?m)^#+ (.+)$", prose(text)):
        yield re.sub(r"[^\w\- ]", "", title.replace("`", "").lower()).replace(" ", "-")


def options(app, words):
    command = app
    for word in words.split():
        command = command[word]
    return {name for item in command.assemble_argument_collection() if item.show for name in item.names}


class TestReference:
    def test_every_public_name_is_shown_once(self, generated):
        shown = [name for names in generated.api_pages().values() for name in names]
        assert sorted(shown) == sorted(turbrestore.__all__)

    def test_every_page_is_in_the_list_and_shows_its_names(self, generated):
        assert set(generated.api_pages()) == set((DOCS / "api").glob("*.md")) - {DOCS / "api" / "index.md"}
        for page, names in generated.api_pages().items():
            text = generated.filled(page.read_text("utf-8"))
            assert names
            for name in names:
                kind = "class" if inspect.isclass(getattr(turbrestore, name)) else "function"
                assert f".. auto{kind}:: turbrestore.{name}\n" in text

    def test_every_public_function_has_an_example(self):
        for name in turbrestore.__all__:
            item = getattr(turbrestore, name)
            assert inspect.getdoc(item), name
            if inspect.isfunction(item):
                heading, examples = inspect.getdoc(item).partition("Examples\n--------\n")[1:]
                assert heading, name
                # The examples run with the other tests, which include the doctests of the whole package.
                assert doctest.DocTestParser().get_examples(examples), name

    def test_examples_of_the_package_run_with_the_tests(self, pytestconfig):
        assert "--doctest-modules" in pytestconfig.getini("addopts")
        assert "turbrestore" in pytestconfig.getini("testpaths")

    def test_every_command_has_a_page_with_its_options(self, generated):
        listed = generated.filled((DOCS / "command_line.md").read_text("utf-8"))
        app = build()
        for words in COMMANDS:
            page = DOCS / "commands" / generated.command_page(words)
            assert f"](commands/{page.name})" in listed
            shown = generated.filled(page.read_text("utf-8"))
            for name in options(app, words):
                assert f"`{name}`" in shown, f"{words} {name}"
            for example in EXAMPLES[words]:
                assert example in shown
        assert len(list((DOCS / "commands").glob("*.md"))) == len(COMMANDS)

    def test_every_notebook_is_in_the_gallery(self, generated):
        text = generated.filled((DOCS / "gallery.md").read_text("utf-8"))
        assert NOTEBOOKS
        for path in NOTEBOOKS:
            assert f"](examples/{path.name})" in text
            assert f"\nexamples/{path.stem}\n" in text
            assert text_of(path).lstrip().startswith("# ")


class TestLinks:
    def test_links_lead_somewhere(self, generated):
        texts = {path: prose(generated.filled(text_of(path))) for path in [*PAGES, *NOTEBOOKS, *ROOT_PAGES, *TABLES]}
        for path, text in texts.items():
            for link in LINK.findall(text):
                if link.startswith(("http://", "https://")):
                    continue
                name, _, anchor = link.partition("#")
                target = path.parent / name if name else path
                assert target.exists(), f"{link} from {path}"
                if anchor:
                    assert anchor in set(anchors(generated.filled(text_of(target)))), f"{link} from {path}"

    def test_every_page_can_be_reached_from_the_first(self, generated):
        found, waiting = set(), [DOCS / "index.md"]
        while waiting:
            page = waiting.pop()
            found.add(page)
            for tree in re.findall(r"(?ms)^```\{toctree\}\n(.*?)^```$", generated.filled(text_of(page))):
                for line in tree.splitlines():
                    name = re.sub(r".*<(.*)>", r"\1", line.strip())
                    if name and not name.startswith(":"):
                        targets = {path for suffix in (".md", ".py") for path in page.parent.glob(f"{name}{suffix}")}
                        waiting += sorted(targets - found)
        assert set(PAGES) | set(NOTEBOOKS) == found | {DOCS / "README.md"}


def test_every_table_of_the_benchmarks_is_linked_and_made_by_a_script():
    text = "\n".join(text_of(path) for path in PAGES)
    for table in TABLES:
        assert f"benchmarks/results/{table.name})" in text
        script = re.search(r"python (benchmarks/\w+\.py)", text_of(table))[1]
        assert (ROOT / script).exists()


def test_options_that_pages_name_exist(generated):
    app = build()
    known = {name for words in COMMANDS for name in options(app, words)}
    known |= {"--help", "--help-all", "--version", *COMMANDS}
    sections = {name.rsplit(".", 1)[0] for name in known if "." in name}
    for path in [*PAGES, *NOTEBOOKS, ROOT / "README.md", ROOT / "CHANGELOG.md"]:
        text = text_of(path)
        lines = [line for line in text.splitlines() if line.startswith("turbrestore ")]
        for code in [*re.findall(r"(?<!`)`([^`\n]+)`", text), *lines]:
            if "pip" in code or "python" in code or "git" in code:
                continue
            for option in re.findall(r"(?<![\w-])--[a-z][\w.-]*\w", code):
                assert option in known | sections, f"{option} in {path}"

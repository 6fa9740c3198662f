"""Two images split by a divider, with zoom: a part of the report and of the app."""

from __future__ import annotations

from importlib.resources import files
from typing import TYPE_CHECKING

from ..core.errors import ConfigurationError
from ..core.extras import missing_package

if TYPE_CHECKING:
    import jinja2

    from .pictures import Gallery


def comparison(gallery: Gallery) -> str:
    """Return the markup for comparing the images of a gallery; it needs ``compare.css`` and ``compare.js``.

    Parameters
    ----------
    gallery : Gallery
        At least one picture.

    Returns
    -------
    str
        HTML in which all text is escaped.

    Raises
    ------
    ConfigurationError
        Jinja2 is not installed.
    """
    return environment().get_template("compare.html").render(gallery=gallery)


def environment() -> jinja2.Environment:
    """Return what reads the templates of this folder: text is escaped, and a name that is not known is an error."""
    try:
        import jinja2
    except ImportError as error:
        raise missing("jinja2") from error
    return jinja2.Environment(
        loader=jinja2.FunctionLoader(text_file),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def text_file(name: str) -> str:
    """Read a template, a style sheet or a script of this folder."""
    return files(__package__).joinpath(name).read_text("utf-8")


def missing(package: str) -> ConfigurationError:
    """Return the error for a package of the extra ``report`` that is not installed."""
    return missing_package("report", package, "report")

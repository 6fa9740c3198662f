"""Two images, or two panels of a film, split by a divider, with zoom: a part of the reports and of the app."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import files
from typing import TYPE_CHECKING

from ..core.extras import missing_package

if TYPE_CHECKING:
    import jinja2

    from .film import Film, Layer
    from .pictures import Gallery, Picture, Stretch

_KEYS = "Drag to pan; arrow keys, + and − work on the image."


def comparison(gallery: Gallery) -> str:
    """Return the markup for comparing the images of a gallery; it needs ``compare.css`` and ``compare.js``."""
    pictures = gallery.pictures
    return _markup(pictures, pictures[-1].key, gallery.stretch, f"{_KEYS} {gallery.encoding}.")


def film_comparison(film: Film, address: str) -> str:
    """Return the markup for comparing the panels of a film while it plays; it needs ``film.js`` besides."""
    hint = f"{_KEYS} Space plays, comma and full stop show single frames. This film is compressed."
    return _markup(film.layers, "output", film.stretch, hint, film=film, address=address)


def _markup(
    layers: Sequence[Picture | Layer],
    right: str,
    stretch: Stretch,
    hint: str,
    film: Film | None = None,
    address: str = "",
) -> str:
    """Fill the template that images and films share."""
    template = environment().get_template("compare.html")
    from markupsafe import Markup

    return Markup(template.render(layers=layers, right=right, stretch=stretch, hint=hint, film=film, address=address))


def environment() -> jinja2.Environment:
    """Return what reads the templates of this folder: text is escaped, and a name that is not known is an error."""
    try:
        import jinja2
    except ImportError as error:
        raise missing_package("report", "jinja2", "report") from error
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

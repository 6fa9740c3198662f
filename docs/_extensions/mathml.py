"""Sphinx extension: formulas as MathML, which browsers render themselves, by the converter of docutils.

Brackets and sums have the right size only in fonts for mathematics.  The style sheet names those that are common; where
there is none, browsers use DejaVu Serif, which is part of matplotlib and is copied into the site.
"""

import shutil
from pathlib import Path
from typing import Any

import matplotlib
from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.util.logging import getLogger

LOGGER = getLogger(__name__)


def inline(translator: Any, node: nodes.math) -> None:
    """Write a formula in a line of text."""
    translator.body.append(convert(node, block=False))
    raise nodes.SkipNode


def block(translator: Any, node: nodes.math_block) -> None:
    """Write a formula on a line of its own; wide ones scroll."""
    translator.body.append(f'<div class="math-block">{convert(node, block=True)}</div>\n')
    raise nodes.SkipNode


def convert(node: nodes.Element, block: bool) -> str:
    """Convert a formula to MathML; where it cannot be parsed, warn, which is an error of the strict build."""
    try:
        return tex2mathml(node.astext(), as_block=block)
    except Exception as error:
        LOGGER.warning("formula %r: %s", node.astext(), error, location=node)
        return nodes.literal("", node.astext()).astext()


def copy_font(app: Sphinx, error: Exception | None) -> None:
    """Put the font where the style sheet looks for it."""
    if error is None and app.builder.format == "html":
        font = Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSerif.ttf"
        shutil.copyfile(font, Path(app.outdir) / "_static" / "math.ttf")


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the renderer."""
    app.connect("build-finished", copy_font)
    app.add_html_math_renderer("mathml", inline_renderers=(inline, None), block_renderers=(block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}

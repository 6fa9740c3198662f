"""Sphinx extension: in the types of docstrings only class names are links.

Types are words, such as ``ndarray, float32, shape (H, W)``.  Sphinx would treat each word as a reference, and link
``shape`` to the attribute of any class that has one.
"""

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx


def unlink_words(app: Sphinx, document: nodes.document) -> None:
    """Turn references to lower-case words back into text."""
    for reference in list(document.findall(addnodes.pending_xref)):
        target = reference.get("reftarget", "").rsplit(".", 1)[-1]
        if reference.get("refdomain") == "py" and reference.get("reftype") == "class" and not target[:1].isupper():
            reference.replace_self(reference.children)


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the extension."""
    app.connect("doctree-read", unlink_words)
    return {"parallel_read_safe": True, "parallel_write_safe": True}

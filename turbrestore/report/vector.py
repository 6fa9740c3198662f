"""Figures as SVG elements for the body of a page.

The page's content security policy allows no style attributes, so styles become attributes of the elements. The page's
style sheet replaces the colours of :mod:`turbrestore.display.figure` by its own, which differ between light and dark.
Text remains text, in the font of the page.
"""

from __future__ import annotations

import base64
import io
import re
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import cv2
import numpy as np

from ..display.preview import data_uri

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Quality of the maps inside figures; they are looked at, not compared; chosen.
_MAP_QUALITY = 85
_DROPPED = {"metadata", "style"}
# Matplotlib's font declaration; the page sets the font, only the size is kept.
_FONT = re.compile(r"font:[^;]*?([\d.]+)px[^;]*;?")


def inline_svg(figure: Figure, name: str, description: str) -> str:
    """Draw a figure as an ``<svg>`` element without namespaces, styles or metadata."""
    import matplotlib as mpl

    buffer = io.StringIO()
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    root = ElementTree.fromstring(buffer.getvalue())
    _simplify(root, name)
    box = root.get("viewBox", "")
    root.attrib.clear()
    root.attrib.update({"role": "img", "aria-label": description, "viewBox": box})
    return ElementTree.tostring(root, encoding="unicode")


def _simplify(element: ElementTree.Element, name: str) -> None:
    element.tag = _local(element.tag)
    element.tail = None
    if element.text is not None and not element.text.strip():
        element.text = None
    attributes = {_local(key): value for key, value in element.attrib.items()}
    attributes |= _unstyled(attributes.pop("style", ""))
    element.attrib.clear()
    element.attrib.update({key: _scoped(key, value, name) for key, value in attributes.items()})
    if element.tag == "image":
        element.set("href", _smaller(element.get("href", "")))
    for child in list(element):
        if _local(str(child.tag)) in _DROPPED:
            element.remove(child)
        else:
            _simplify(child, name)


def _local(name: str) -> str:
    """Name without its XML namespace."""
    return name.rpartition("}")[2]


def _unstyled(style: str) -> dict[str, str]:
    """Turn the declarations of a style attribute into single attributes."""
    size = _FONT.search(style)
    rules = (rule.partition(":") for rule in _FONT.sub("", style).split(";"))
    found = {key.strip(): value.strip() for key, _, value in rules if key.strip()}
    return found | ({"font-size": size.group(1)} if size else {})


def _scoped(key: str, value: str, name: str) -> str:
    """Value of an attribute, with the ids in it made unique on the page."""
    if key == "id":
        return f"{name}-{value}"
    if key == "href" and value.startswith("#"):
        return f"#{name}-{value[1:]}"
    return re.sub(r"url\(#([^)]+)\)", rf"url(#{name}-\1)", value)


def _smaller(address: str) -> str:
    """Matplotlib's PNG as WebP, a fifth of the size."""
    data = base64.b64decode(address.partition(",")[2])
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    done, small = cv2.imencode(".webp", pixels, [cv2.IMWRITE_WEBP_QUALITY, _MAP_QUALITY])
    return data_uri(small.tobytes(), "webp") if done and len(small) < len(data) else address

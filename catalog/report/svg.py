"""Figures as markup that lives inside a page with a strict content security policy.

A policy that allows one style sheet by its hash forbids every `style` attribute, and matplotlib writes nothing else.
Here they become presentation attributes, colours become classes of the page (which has a light and a dark theme),
identifiers become unique in the page, and what nobody reads (metadata, group names, the seventh digit) goes.
"""

from __future__ import annotations

import io
import re
from typing import TYPE_CHECKING
from xml.etree import ElementTree
from xml.sax.saxutils import escape, quoteattr

from .style import COLOURS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SVG = "{http://www.w3.org/2000/svg}"
_HREF = "{http://www.w3.org/1999/xlink}href"
_DECIMALS = re.compile(r"-?\d+\.\d+(?:e-?\d+)?")
_REFERENCE = re.compile(r"url\(#([^)]+)\)")
# The page sets the font; the other two are what the page's own style sheet says for every figure.
_DROPPED = {"font-family", "image-rendering", "stroke-linejoin"}


def _shorter(match: re.Match[str]) -> str:
    # Two decimals of a point: a fiftieth of a pixel at 400 % zoom.
    text = f"{float(match[0]):.2f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text


class _Writer:
    def __init__(self, prefix: str, root: ElementTree.Element) -> None:
        self.prefix = prefix
        self.names: dict[str, str] = {}
        self.out: list[str] = []
        for element in root.iter():
            for key, value in element.attrib.items():
                if key == _HREF and value.startswith("#"):
                    self.name(value[1:])
                else:
                    for reference in _REFERENCE.findall(value):
                        self.name(reference)

    def name(self, identifier: str) -> str:
        return self.names.setdefault(identifier, f"{self.prefix}-{len(self.names)}")

    def attributes(self, element: ElementTree.Element) -> dict[str, str]:
        found: dict[str, str] = {}
        classes = []
        for key, value in element.attrib.items():
            if key == "id":
                if value in self.names:
                    found["id"] = self.names[value]
            elif key == _HREF:
                found["href"] = f"#{self.name(value[1:])}" if value.startswith("#") else "".join(value.split())
            elif key == "style":
                for declaration in value.split(";"):
                    name, _, setting = (part.strip() for part in declaration.partition(":"))
                    if name in ("fill", "stroke") and setting in COLOURS:
                        classes.append(f"{name[0]}-{COLOURS[setting]}")
                    elif name and name not in _DROPPED:
                        found[name] = setting
            elif key == "transform":
                if not value.startswith("rotate(-0 "):
                    # Scales of images need their digits: two decimals of a scale are a tenth of a cell.
                    found[key] = value if element.tag == _SVG + "image" else _DECIMALS.sub(_shorter, value)
            elif key in ("d", "x", "y", "width", "height"):
                found[key] = " ".join(_DECIMALS.sub(_shorter, value).split())
            elif key != "type":
                found[key] = value
        for key, value in found.items():
            if "url(#" in value:
                found[key] = _REFERENCE.sub(lambda match: f"url(#{self.name(match[1])})", value)
        if classes:
            found["class"] = " ".join(classes)
        return found

    def element(self, element: ElementTree.Element) -> None:
        if not isinstance(element.tag, str) or not element.tag.startswith(_SVG):
            return
        tag = element.tag.removeprefix(_SVG)
        if tag in ("metadata", "style") or (tag == "defs" and [child.tag for child in element] == [_SVG + "style"]):
            return
        attributes = self.attributes(element)
        if tag == "path" and attributes.get("fill") == "none" and not {"stroke", "class", "id"} & attributes.keys():
            return
        bare = tag == "g" and not attributes
        empty = len(element) == 0 and not (element.text and element.text.strip())
        if bare and empty:
            return
        if not bare:
            written = "".join(f" {key}={quoteattr(value)}" for key, value in attributes.items())
            self.out.append(f"<{tag}{written}{'/' if empty else ''}>")
        if element.text and element.text.strip():
            self.out.append(escape(element.text))
        for child in element:
            self.element(child)
        if not bare and not empty:
            self.out.append(f"</{tag}>")


def inline_svg(figure: Figure, prefix: str, label: str, description: str) -> str:
    """Markup of `figure` for the inside of a page.

    Parameters
    ----------
    figure : Figure
        Figure, drawn inside :func:`coslidar.catalog.report.style.figure_style`.
    prefix : str
        Start of every identifier, unique in the page.
    label, description : str
        Text alternative: what it is, and what it shows.

    Returns
    -------
    str
        An ``<svg>`` element without style attributes, scripts or references to the outside.
    """
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    root = ElementTree.fromstring(buffer.getvalue())
    writer = _Writer(prefix, root)
    for child in root:
        writer.element(child)
    return (
        f'<svg class="plot" xmlns="http://www.w3.org/2000/svg" viewBox={quoteattr(root.attrib["viewBox"])} role="img" '
        f'aria-label={quoteattr(label)} aria-describedby="{prefix}-text">'
        # A title element would follow the pointer around as a tooltip; the label says the same without.
        f'<desc id="{prefix}-text">{escape(description)}</desc>'
        f"{''.join(writer.out)}</svg>"
    )

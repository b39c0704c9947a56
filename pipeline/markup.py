"""Small tables of HTML, for objects that a notebook shows."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape


def table(caption: str, heading: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table; all text is escaped, because names come from headers of somebody's recordings.

    Parameters
    ----------
    caption : str
        What it is.
    heading : sequence of str
        Names of the columns, with units; empty for none.
    rows : iterable of sequences
        Cells.

    Returns
    -------
    str
        HTML.
    """

    def row(cells: Sequence[object], tag: str) -> str:
        scope = ' scope="col"' if tag == "th" else ""
        return "<tr>" + "".join(f"<{tag}{scope}>{escape(str(cell))}</{tag}>" for cell in cells) + "</tr>"

    head = f"<thead>{row(heading, 'th')}</thead>" if heading else ""
    body = "".join(row(cells, "td") for cells in rows)
    return f"<table><caption>{escape(caption)}</caption>{head}<tbody>{body}</tbody></table>"

"""Shared HTML of self-contained pages: the head with colours for light and dark themes, and tables."""

import html
import string
from collections.abc import Sequence
from importlib.resources import files


def page_head(title: str) -> str:
    """Return the HTML from the doctype up to the page's own ``style`` element. The page closes the head.

    ``title`` is plain text.
    """
    template = files("embomatrix.pages").joinpath("head.html").read_text(encoding="utf-8")
    return string.Template(template.rstrip("\n")).substitute(title=html.escape(title))


def html_table(rows: Sequence[Sequence[str]]) -> str:
    """Return a table of plain texts. The first row holds the column titles."""
    top = "".join(f"<th>{html.escape(title)}</th>" for title in rows[0])
    body = "".join("<tr>" + "".join(f"<td>{_cell(cell)}</td>" for cell in row) + "</tr>" for row in rows[1:])
    return f'<div class="scroll"><table><tr>{top}</tr>{body}</table></div>'


def _cell(text: str) -> str:
    """Highlight an estimate against its interval in brackets."""
    value, bracket, rest = html.escape(text).partition(" [")
    return f"<b>{value}</b> <span>[{rest}</span>" if bracket else value

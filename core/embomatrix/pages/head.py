"""Shared HTML head of self-contained pages: colours for light and dark themes, and table styles."""

import html
import string
from importlib.resources import files


def page_head(title: str) -> str:
    """Return the HTML from the doctype up to the page's own ``style`` element. The page closes the head.

    ``title`` is plain text.
    """
    template = files("embomatrix.pages").joinpath("head.html").read_text(encoding="utf-8")
    return string.Template(template.rstrip("\n")).substitute(title=html.escape(title))

"""What the self-contained pages share: the head of an HTML file, with colours for light and dark and one style of tables."""

from __future__ import annotations

import html
import string
from importlib.resources import files


def page_head(title: str) -> str:
    """HTML from the doctype on, up to where a page adds rules of its own in a ``style`` element, then ends its head.

    ``title`` is plain text.
    """
    template = files("embomatrix.pages").joinpath("head.html").read_text(encoding="utf-8")
    return string.Template(template.rstrip("\n")).substitute(title=html.escape(title))

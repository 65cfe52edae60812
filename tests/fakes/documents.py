"""Code blocks of the documents, so that tests run what a reader copies."""

import re
from pathlib import Path

DOCS = Path(__file__).parents[2] / "docs"


def snippets(page, heading, language):
    """Return the code blocks in ``language`` ("" for none) below the heading of a page of docs/, at least one."""
    text = (DOCS / page).read_text(encoding="utf-8")
    (section,) = re.findall(rf"^## {re.escape(heading)}\n(.*?)(?=^## |\Z)", text, re.DOTALL | re.MULTILINE)
    blocks = re.findall(r"^```(\w*)\n(.*?)^```", section, re.DOTALL | re.MULTILINE)
    found = [block for marked, block in blocks if marked == language]
    assert found, f"docs/{page} has no block of {language or 'plain text'} below {heading!r}"
    return found

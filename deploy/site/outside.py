"""Hooks of MkDocs that make the site stand alone.

Links from the pages to files of the repository, which are no pages of the site, become the file's path in words. A page that
would load anything from another site is refused.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

FETCHED: Final = re.compile(
    r"""<(?:script|img|iframe|video|source|link)\b[^>]*?\b(?:src|href)=["']?((?:https?:)?//[^"'\s>]+)""",
    re.IGNORECASE,
)
"""What a browser asks for by itself; a link that a person may follow is none of it."""
SCRIPTED: Final = 'class="mermaid"'
"""The theme answers to it with a script from elsewhere."""
LINK: Final = re.compile(r"(?<!!)\[([^\]]+)\]\(([^)#\s]+)(?:#[^)]*)?\)")


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """The page's text with such links replaced. MkDocs calls it for every page before it becomes HTML."""
    docs = Path(config.docs_dir).resolve()
    here = (docs / page.file.src_uri).parent

    def replaced(found: re.Match[str]) -> str:
        words, target = found[1], found[2]
        path = (here / target).resolve()
        if "://" in target or target.startswith("mailto:") or files.get_file_from_path(_uri(path, docs)):
            return found[0]
        if not path.is_relative_to(docs.parent) or not path.exists():
            return found[0]  # MkDocs says that it leads nowhere
        told = str(path.relative_to(docs.parent))
        return f"`{told}`" if words.strip("`") in (told, path.name) else f"{words} (`{told}`)"

    return LINK.sub(replaced, markdown)


def on_post_page(output: str, page: Page, config: MkDocsConfig) -> str:
    """The page as it is. Raises ValueError for one that would make a browser ask another site."""
    found = FETCHED.findall(output)
    if found or SCRIPTED in output:
        raise ValueError(
            f"{page.file.src_uri} would load {found[0] if found else 'a script for its diagram'} from another site: "
            "put a copy beside the pages"
        )
    return output


def _uri(path: Path, docs: Path) -> str:
    """As MkDocs names its files; empty for one outside."""
    return path.relative_to(docs).as_posix() if path.is_relative_to(docs) else ""

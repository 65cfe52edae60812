"""MkDocs hooks that make the site self-contained.

A link to a repository file outside the site becomes the file's path as text. A page that would load anything from another
site is refused.
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
"""Elements that a browser loads by itself; ordinary links are excluded."""
SCRIPTED: Final = 'class="mermaid"'
"""Class to which the theme responds with a script from another site."""
LINK: Final = re.compile(r"(?<!!)\[([^\]]+)\]\(([^)#\s]+)(?:#[^)]*)?\)")


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Return the page's text with links outside the site replaced. MkDocs calls it for every page before it becomes HTML."""
    docs = Path(config.docs_dir).resolve()
    here = (docs / page.file.src_uri).parent

    def replaced(found: re.Match[str]) -> str:
        words, target = found[1], found[2]
        path = (here / target).resolve()
        if "://" in target or target.startswith("mailto:") or files.get_file_from_path(_uri(path, docs)):
            return found[0]
        if not path.is_relative_to(docs.parent) or not path.exists():
            return found[0]  # MkDocs reports the broken link
        relative = str(path.relative_to(docs.parent))
        return f"`{relative}`" if words.strip("`") in (relative, path.name) else f"{words} (`{relative}`)"

    return LINK.sub(replaced, markdown)


def on_post_page(output: str, page: Page, config: MkDocsConfig) -> str:
    """Return the page unchanged. Raise ValueError if it would load anything from another site."""
    found = FETCHED.findall(output)
    if found or SCRIPTED in output:
        raise ValueError(
            f"{page.file.src_uri} would load {found[0] if found else 'a script for its diagram'} from another site: "
            "put a copy beside the pages"
        )
    return output


def _uri(path: Path, docs: Path) -> str:
    """Return the name that MkDocs uses for a file, or an empty string outside the docs folder."""
    return path.relative_to(docs).as_posix() if path.is_relative_to(docs) else ""

"""A hook of MkDocs: links from the pages to files of the repository, which are no pages of the site.

They become the file's path in words, for the site stands alone.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

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


def _uri(path: Path, docs: Path) -> str:
    """As MkDocs names its files; empty for one outside."""
    return path.relative_to(docs).as_posix() if path.is_relative_to(docs) else ""

"""Diagrams of the documentation site, drawn ahead by Mermaid and shown as pictures, so that no page needs a script.

A page holds a diagram as a Mermaid fence, which code hosts draw themselves. A digest of the fence's text names its light
and dark pictures, so a changed diagram has no picture until it is drawn again.

The MkDocs hook replaces the fences. The command draws: diagrams.py DOCS MERMAID_JS  (`make diagrams`).
"""

from __future__ import annotations

import hashlib
import html
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

FENCE: Final = re.compile(r"^```mermaid\n(.*?)^```$", re.DOTALL | re.MULTILINE)
TITLE: Final = re.compile(r"^\s*accTitle: (.+)$", re.MULTILINE)
FOLDER: Final = Path("pictures", "diagrams")
THEMES: Final = {"light": "neutral", "dark": "dark"}
"""Mermaid theme for each theme of the site."""
BROWSERS: Final = ("chromium", "chromium-browser", "google-chrome")
LIMIT_S: Final = 60.0
_DRAWING: Final = """<!doctype html><meta charset="utf-8"><pre id="drawn"></pre><script src="{script}"></script><script>
mermaid.initialize({{startOnLoad: false, theme: "{theme}", deterministicIds: true, htmlLabels: false,
  fontFamily: "Arial, Liberation Sans, sans-serif", flowchart: {{htmlLabels: false, useMaxWidth: false}},
  sequence: {{useMaxWidth: false}}}});
mermaid.render("diagram", {source}).then(({{svg}}) => {{
  const drawn = new DOMParser().parseFromString(svg, "image/svg+xml").documentElement;
  document.getElementById("drawn").textContent = new XMLSerializer().serializeToString(drawn);
}});
</script>"""


def picture(source: str, theme: str) -> Path:
    """Path of a diagram's picture below the folder of pages."""
    return FOLDER / f"{hashlib.sha256(source.encode('utf-8')).hexdigest()[:16]}-{theme}.svg"


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Return the page's text with pictures instead of fences. MkDocs calls it for every page before it becomes HTML.

    Raises FileNotFoundError for a diagram without its pictures, ValueError for one without a title.
    """
    docs, here = Path(config.docs_dir), Path(page.file.src_uri).parent

    def shown(found: re.Match[str]) -> str:
        title = TITLE.search(found[1])
        if title is None:
            raise ValueError(
                f"{page.file.src_uri} has a diagram without a line 'accTitle: …': add it, for who can't see it"
            )
        drawn = {theme: picture(found[1], theme) for theme in THEMES}
        missing = [path for path in drawn.values() if not (docs / path).is_file()]
        if missing:
            raise FileNotFoundError(
                f"{page.file.src_uri}: its diagram {title[1]!r} was changed and has no pictures yet: run `make diagrams`"
            )
        links = {theme: Path(os.path.relpath(path, here)).as_posix() for theme, path in drawn.items()}
        return " ".join(f"![{title[1]}]({link}#only-{theme})" for theme, link in links.items())

    return FENCE.sub(shown, markdown)


def draw(source: str, theme: str, script: Path, browser: str) -> str:
    """Return the diagram as SVG, drawn in a browser. Raise ValueError for invalid Mermaid source."""
    with tempfile.TemporaryDirectory() as name:
        sheet = Path(name, "sheet.html")
        filled = _DRAWING.format(script=script.resolve().as_uri(), theme=theme, source=json.dumps(source))
        sheet.write_text(filled, encoding="utf-8")
        alone = ("--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={name}/profile")
        command = (browser, *alone, "--virtual-time-budget=20000", "--dump-dom", sheet.as_uri())
        rendered = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, check=True).stdout
    drawn = re.search(r'<pre id="drawn">(.*?)</pre>', rendered, re.DOTALL)
    if drawn is None or not drawn[1].startswith("&lt;svg") or "Syntax error in text" in drawn[1]:
        raise ValueError(f"Mermaid could not draw this diagram: try it in its live editor\n{source}")
    return html.unescape(drawn[1]) + "\n"


def draw_all(docs: Path, script: Path, browser: str) -> list[Path]:
    """Draw missing pictures and remove unused ones. Return the names of the new pictures."""
    found = [
        source for page in sorted(docs.rglob("*.md")) for source in FENCE.findall(page.read_text("utf-8"))
    ]
    wanted = {docs / picture(source, theme): (source, theme) for source in found for theme in THEMES}
    (docs / FOLDER).mkdir(parents=True, exist_ok=True)
    for path in set((docs / FOLDER).glob("*.svg")) - set(wanted):
        path.unlink()
    missing = [path for path in wanted if not path.exists()]
    for path in missing:
        source, theme = wanted[path]
        path.write_text(draw(source, THEMES[theme], script, browser), encoding="utf-8")
    return missing


if __name__ == "__main__":
    installed = next(filter(None, map(shutil.which, BROWSERS)), None)
    if installed is None:
        sys.exit(f"none of {', '.join(BROWSERS)} is installed: install one to draw diagrams")
    for path in draw_all(Path(sys.argv[1]), Path(sys.argv[2]), installed):
        sys.stdout.write(f"drew {path}\n")

"""The documentation site is self-contained: its diagrams are drawn, and its pages request nothing from other sites."""

import importlib.util
import re
from pathlib import Path
from types import SimpleNamespace

import pytest

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGE = SimpleNamespace(file=SimpleNamespace(src_uri="decisions/0001-a-page.md"))
DRAWN = "flowchart LR\n  accTitle: one leads to the other\n  a --> b\n"


def hook(name):
    spec = importlib.util.spec_from_file_location(name, ROOT / "deploy" / "site" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


diagrams, outside = hook("diagrams"), hook("outside")


def test_every_diagram_has_a_title_and_a_picture_per_theme():
    sources = [source for page in DOCS.rglob("*.md") for source in diagrams.FENCE.findall(page.read_text())]
    assert sources
    assert all(diagrams.TITLE.search(source) for source in sources)
    wanted = {DOCS / diagrams.picture(source, theme) for source in sources for theme in diagrams.THEMES}
    assert set((DOCS / diagrams.FOLDER).iterdir()) == wanted, "run `make diagrams`"
    for path in wanted:
        assert not re.search(r"(?:href|src)=\"(?!#)|url\((?!#|\"#)|@import", path.read_text()), path.name


def test_mermaid_fence_becomes_a_light_and_a_dark_picture(tmp_path):
    config = SimpleNamespace(docs_dir=str(tmp_path))
    text = f"Before.\n\n```mermaid\n{DRAWN}```\n\nAfter.\n"
    with pytest.raises(FileNotFoundError, match="run `make diagrams`"):
        diagrams.on_page_markdown(text, PAGE, config, None)
    for theme in diagrams.THEMES:
        path = tmp_path / diagrams.picture(DRAWN, theme)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("<svg/>")
    shown = diagrams.on_page_markdown(text, PAGE, config, None)
    links = re.findall(
        r"!\[one leads to the other\]\(\.\./pictures/diagrams/\w+-(\w+)\.svg#only-(\w+)\)", shown
    )
    assert links == [("light", "light"), ("dark", "dark")]
    assert "mermaid" not in shown


@pytest.mark.parametrize(
    "fetched",
    [
        '<script src="https://cdn.example/x.js"></script>',
        "<link rel=stylesheet href=//fonts.example/f.css>",
        '<img alt="" src="http://pictures.example/p.png">',
        '<pre class="mermaid"><code>a --> b</code></pre>',
    ],
)
def test_page_that_loads_from_another_site_is_refused(fetched):
    with pytest.raises(ValueError, match="from another site"):
        outside.on_post_page(f"<p>words</p>{fetched}", PAGE, None)


def test_ordinary_links_to_other_sites_are_allowed():
    page = (
        '<a href="https://ui.perfetto.dev">Perfetto</a><img src="pictures/a.png"><script src="x.js"></script>'
    )
    assert outside.on_post_page(page, PAGE, None) == page

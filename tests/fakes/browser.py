"""Pages rendered by a real browser, with their text by element id."""

import subprocess
from html.parser import HTMLParser


class Page(HTMLParser):
    """Text of a page by element id, and the number of elements of each class."""

    VOID = frozenset(("meta", "link", "input", "br", "line", "polygon", "polyline"))

    def __init__(self, source):
        super().__init__()
        self._open = []
        self.words = {}
        self.classes = []
        self.feed(source)

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.classes.append(values.get("class") or "")
        if tag not in self.VOID:
            self._open.append((tag, values.get("id")))

    def handle_endtag(self, tag):
        while self._open and self._open.pop()[0] != tag:
            pass

    def handle_data(self, data):
        for _, name in self._open:
            if name:
                self.words[name] = " ".join(f"{self.words.get(name, '')} {data}".split())


def shown(browser, url, folder):
    """Return the page after its scripts ran for a few seconds."""
    result = subprocess.run(
        [
            browser,
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            f"--user-data-dir={folder / 'profile'}",
            "--virtual-time-budget=5000",
            "--dump-dom",
            url,
        ],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    return Page(result.stdout)

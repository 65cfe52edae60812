"""A page in a real browser, after its scripts ran, and its words by the elements that they stand in."""

import subprocess
from html.parser import HTMLParser


class Page(HTMLParser):
    """The words of a page by the id of the element that they stand in, and how often each class of element is there."""

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
    """The page after its scripts ran for a few seconds."""
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

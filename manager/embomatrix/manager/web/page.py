"""The dashboard's files: a page, its scripts and styles, and one library of charts, all from this package."""

from __future__ import annotations

import hashlib
from importlib.resources import files
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Final

from fastapi import APIRouter, HTTPException, Request, Response

from embomatrix.manager.web.packing import packed

if TYPE_CHECKING:
    from collections.abc import Mapping
    from importlib.resources.abc import Traversable

STATIC: Final = "/static/"
"""Below this lie files that say nothing about the cluster: they are open to whoever reaches the port."""
TYPES: Final[Mapping[str, str]] = {".js": "text/javascript", ".css": "text/css", ".html": "text/html"}
GUARDED: Final[Mapping[str, str]] = {
    # Nothing from elsewhere, nothing that stands in the page itself, and no other page around it. The chart library sets
    # sizes of its own elements.
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; connect-src 'self'; "
    "img-src 'self' data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    # A browser asks again after an upgrade, and else keeps what it has.
    "cache-control": "no-cache",
}


def page() -> APIRouter:
    """The page at ``/`` and its files below ``STATIC``."""
    router = APIRouter(include_in_schema=False)
    served = {
        path: (content, kind)
        for path, content, kind in _read(files("embomatrix.manager.web") / "dashboard", "")
    }

    @router.get("/")
    async def index(request: Request) -> Response:
        return _answer(request, "index.html")

    @router.get(f"{STATIC}{{path:path}}")
    async def static(request: Request, path: str) -> Response:
        return _answer(request, path)

    def _answer(request: Request, path: str) -> Response:
        if path not in served:
            raise HTTPException(404, f"the page has no file {path[:100]!r}")
        content, kind = served[path]
        headers = {**GUARDED, "etag": f'"{hashlib.sha256(content).hexdigest()[:16]}"'}
        if request.headers.get("if-none-match") == headers["etag"]:
            return Response(status_code=304, headers=headers)
        return packed(request, content, kind, headers)

    return router


def _read(folder: Traversable, prefix: str) -> list[tuple[str, bytes, str]]:
    """Path, content and type of every file that a browser may have: a path that is not among them is no file."""
    found: list[tuple[str, bytes, str]] = []
    for item in folder.iterdir():
        kind = TYPES.get(PurePosixPath(item.name).suffix)
        if item.is_dir():
            found += _read(item, f"{prefix}{item.name}/")
        elif kind is not None:
            found.append((f"{prefix}{item.name}", item.read_bytes(), kind))
    return found

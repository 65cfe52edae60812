"""Answers of the HTTP port, compressed for who takes that: once for all who get the same."""

from __future__ import annotations

import functools
import gzip
from typing import TYPE_CHECKING, Final

from fastapi import Response

if TYPE_CHECKING:
    from collections.abc import Mapping

    from fastapi import Request

LEAST_BYTES: Final = 1024
"""What is smaller fits a packet as it is."""
LEVEL: Final = 4
KEPT: Final = 64
"""Compressed answers in memory: the page's own files, and snapshots of a moment."""
JSON: Final = "application/json"


def packed(
    request: Request, body: bytes, kind: str = JSON, headers: Mapping[str, str] | None = None
) -> Response:
    """The answer to a request, of the media type ``kind``; caches are told that it depends on what the request takes."""
    told = {**(headers or {}), "vary": "accept-encoding"}
    if len(body) >= LEAST_BYTES and "gzip" in request.headers.get("accept-encoding", ""):
        body = _compressed(body)
        told["content-encoding"] = "gzip"
    return Response(body, media_type=kind, headers=told)


@functools.lru_cache(maxsize=KEPT)
def _compressed(body: bytes) -> bytes:
    return gzip.compress(body, LEVEL, mtime=0)

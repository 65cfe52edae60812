"""Request bodies within budgets of bytes and time, for all clients together and for each address."""

from __future__ import annotations

import asyncio
from collections import Counter
from typing import Final

from fastapi import HTTPException, Request
from starlette.requests import ClientDisconnect

LARGEST_BYTES: Final = 16 * 1024 * 1024
"""Bytes of one body."""
PER_ADDRESS_BYTES: Final = 32 * 1024 * 1024
ALL_BYTES: Final = 64 * 1024 * 1024
"""Bytes of all bodies that are being received or parsed."""
BODY_S: Final = 30.0
"""Seconds from the head of a request to the end of its body."""


class BodyBudget:
    """Receives bodies. Bytes count until ``release``, so slow and unfinished requests can't fill the memory."""

    def __init__(self, *, body_s: float = BODY_S, all_bytes: int = ALL_BYTES) -> None:
        self._body_s = body_s
        self._all_bytes = all_bytes
        self._held: Counter[str] = Counter()

    async def receive(self, request: Request) -> bytes:
        """Return the body. Raise HTTP 413, 429 or 503 beyond a budget, 408 for a body that does not end in time, and 400
        for one whose sender left.

        The caller releases the bytes of a returned body.
        """
        address = request.client.host if request.client else ""
        body = bytearray()
        try:
            async with asyncio.timeout(self._body_s):
                async for chunk in request.stream():
                    self._hold(address, len(chunk))
                    body += chunk
                    if len(body) > LARGEST_BYTES:
                        raise HTTPException(
                            413, f"more than {LARGEST_BYTES >> 20} MiB: send fewer answers at once"
                        )
        except BaseException as error:
            self.release(request, len(body))
            if isinstance(error, TimeoutError):
                text = f"the body did not end within {self._body_s:g} s: send it without pauses"
                raise HTTPException(408, text) from None
            if isinstance(error, ClientDisconnect):
                raise HTTPException(400, "the sender left before the end of the body") from None
            raise
        return bytes(body)

    def release(self, request: Request, size: int) -> None:
        """Count the bytes of a body no longer: once for each body that was received, with its size."""
        address = request.client.host if request.client else ""
        self._held[address] -= size
        if self._held[address] <= 0:
            del self._held[address]

    def _hold(self, address: str, size: int) -> None:
        if self._held[address] + size > PER_ADDRESS_BYTES:
            raise HTTPException(
                429, f"{address} sends more than {PER_ADDRESS_BYTES >> 20} MiB at a time: wait for answers"
            )
        if self._held.total() + size > self._all_bytes:
            raise HTTPException(503, "the manager receives too many requests at a time: try again")
        self._held[address] += size

"""Limits on a bundle before it is trusted: its digest, its size, its growth in decompression, and its values.

Services that only relay bundles need this module alone, without numpy.
"""

import hashlib
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

_CHUNK: Final = 1 << 20
"""Growth allowed beyond the ratio: small bundles compress best."""
_PIECE: Final = 1 << 16


class BundleError(ValueError):
    """Unacceptable bundle. The message says what was found and what was expected."""


@dataclass(frozen=True, slots=True)
class BundleLimits:
    """Limits on the size of a bundle and on its growth."""

    compressed_bytes: int = 8 * 1024 * 1024
    ratio: float = 100.0
    """Decompressed bytes per compressed byte; scenes need about ten."""
    content_bytes: int = 16 * 1024 * 1024
    """Decompressed bytes. The largest shipped bundle has 1.7 MB; each becomes up to four in memory."""
    values: int = 400_000
    """Values of its JSON text. The largest shipped bundle has 29,000; each becomes an object of some hundred bytes."""


DEFAULT_LIMITS: Final = BundleLimits()


def bundle_digest(data: bytes) -> str:
    """Content address of a bundle: ``sha256:`` and the hash of its compressed bytes in hexadecimal digits."""
    return f"sha256:{hashlib.sha256(data).hexdigest()}"


class Inflation:
    """Streaming decompression that refuses a bundle at the first piece that breaks a limit.

    All receivers of bundles use this class and so accept the same bundles.
    """

    def __init__(self, limits: BundleLimits = DEFAULT_LIMITS) -> None:
        self._limits = limits
        self._decoder = zlib.decompressobj()
        self._taken = 0
        self._grown = 0

    def feed(self, data: bytes) -> Iterator[bytes]:
        """Decompress the next bytes of a bundle in pieces that fit in memory. Raises BundleError."""
        for start in range(0, len(data), _PIECE):
            yield self._inflate(data[start : start + _PIECE])

    def finish(self) -> None:
        """Raise BundleError unless the compressed stream ended with the last byte."""
        if not self._decoder.eof or self._decoder.unused_data:
            raise BundleError("it is cut short, or bytes follow its end: fetch it again")

    def _inflate(self, piece: bytes) -> bytes:
        self._taken += len(piece)
        if self._taken > self._limits.compressed_bytes:
            raise too_large(self._limits)
        bound = min(int(self._taken * self._limits.ratio) + _CHUNK, self._limits.content_bytes)
        try:
            content = self._decoder.decompress(piece, bound - self._grown + 1)
        except zlib.error as error:
            raise BundleError(f"it is not zlib-compressed ({error}): fetch it again") from error
        self._grown += len(content)
        if self._grown > bound or self._decoder.unconsumed_tail:
            raise BundleError(
                f"the bundle grows beyond {bound:,} bytes in its first {self._taken:,}: expected at most "
                f"{self._limits.ratio:g} to 1, and {self._limits.content_bytes:,} in all"
            )
        return content


def too_large(limits: BundleLimits) -> BundleError:
    """Error for a bundle with more bytes than the limits allow."""
    return BundleError(
        f"the bundle has over {limits.compressed_bytes:,} bytes: expected at most {limits.compressed_bytes:,}"
    )


def check_values(text: bytes | memoryview, limits: BundleLimits) -> None:
    """Raise BundleError if the JSON text may hold too many values, before any of them becomes an object.

    Each value but the first follows a comma or an opening bracket. Those inside texts are counted too, and the parentheses
    of goals, which are lists of their own.
    """
    content = bytes(text)
    count = 1 + sum(map(content.count, (b",", b"[", b"{", b"(")))
    if count > limits.values:
        raise BundleError(
            f"its JSON has up to {count:,} values: expected at most {limits.values:,}; split the scene or its tasks"
        )


def decompress(data: bytes, limits: BundleLimits) -> bytes:
    """Content of a whole bundle. Raises BundleError."""
    inflation = Inflation(limits)
    content = b"".join(inflation.feed(data))
    inflation.finish()
    return content

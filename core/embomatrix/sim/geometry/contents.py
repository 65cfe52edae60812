"""What an asset is made of, as a key: equal content, equal key, whatever scene it is in."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from embomatrix.world.asset import Asset


class Contents:
    """Digests of assets, each worked out once."""

    def __init__(self) -> None:
        self._known: dict[int, tuple[Asset, str]] = {}

    def of(self, asset: Asset) -> str:
        """Digest of everything in the asset. The asset is kept, so that its id can't pass to another one."""
        known = self._known.get(id(asset))
        if known is None:
            known = (asset, hashlib.sha256(repr(asset).encode()).hexdigest())
            self._known[id(asset)] = known
        return known[1]

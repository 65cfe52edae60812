"""Content keys of assets: equal content gives an equal key in every scene."""

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
        """Return the digest of everything in the asset. The asset is kept, because a freed id could be reused."""
        known = self._known.get(id(asset))
        if known is None:
            # Pose caches draw with seeds from this digest. `Part` is the former name of `ConvexPart`: the digest keeps it.
            content = repr(asset).replace("ConvexPart(", "Part(")
            known = (asset, hashlib.sha256(content.encode()).hexdigest())
            self._known[id(asset)] = known
        return known[1]

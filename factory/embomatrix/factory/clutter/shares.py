"""Contents of real rooms by room type: total objects, objects by category, and where each category is found."""

import functools
import json
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from typing import Final

from embomatrix.factory.furnish.small_objects import (
    MEMBERS,
    ItemKind,
    groups_for,
    is_usual_host,
    preferred_hosts,
)

ROOM_TYPES: Final[Mapping[str, str]] = {
    "living_room": "living_room",
    "television_room": "living_room",
    "dining_room": "living_room",
    "bedroom": "bedroom",
    "childs_room": "bedroom",
    "playroom": "bedroom",
    "private_office": "bedroom",
    "bathroom": "bathroom",
    "kitchen": "kitchen",
}
"""Type of real rooms that stands for a room type of the catalog. Other rooms get no background."""
_HOST_KINDS: Final[Mapping[str, str]] = {
    "ArmChair": "armchair",
    "Bathtub": "bathtub",
    "Bed": "bed",
    "Cabinet": "bottom_cabinet",
    "CoffeeTable": "coffee_table",
    "CounterTop": "countertop bottom_cabinet furniture_sink pedestal_sink bar",
    "Desk": "desk breakfast_table",
    "DiningTable": "dining_table breakfast_table pedestal_table",
    "Dresser": "bottom_cabinet cedar_chest console_table",
    "Shelf": "shelf bookcase",
    "ShelvingUnit": "bookcase shelf",
    "SideTable": "nightstand console_table pedestal_table bottom_cabinet",
    "Sofa": "sofa",
    "TVStand": "bottom_cabinet console_table",
    "Toilet": "toilet",
}
"""Categories of the catalog for iTHOR's furniture."""
ANY_SHELF: Final = "shelf"
_SOFT_HOSTS: Final = frozenset(("bed", "sofa", "armchair", "straight_chair"))
_SOFT: Final = frozenset(("pillow", "teddy_bear", "newspaper", "hardback"))
"""Objects that lie on beds and seats; the others are there in real rooms only for a while."""
_KNOWN_HOST: Final = 0.25
"""Weight of the best host that only the knowledge base names; the next ones weigh less."""
_FILLER: Final = 0.3
"""Mean number of a category that only the knowledge base names for a room."""
_ON_SHELVES: Final = (ItemKind.BOOKS, ItemKind.DECORATION, ItemKind.TOYS, ItemKind.TOILETRIES)
_GROUPS: Final = frozenset(
    (ItemKind.BOOKS, ItemKind.DECORATION, ItemKind.TOILETRIES, ItemKind.TOYS, ItemKind.OFFICE)
)
"""Groups that fill a room; food, tableware and devices are left to tasks."""


@dataclass(frozen=True, slots=True)
class RoomShares:
    """Contents of one type of real rooms. ``hosts`` maps a category to the share of each kind of furniture."""

    rooms: int
    quartiles: tuple[float, float, float]
    means: Mapping[str, float]
    hosts: Mapping[str, Mapping[str, float]]


@functools.cache
def all_shares() -> Mapping[str, RoomShares]:
    """Return the committed table by type of real rooms."""
    text = (resources.files("embomatrix.factory.clutter") / "shares.json").read_text(encoding="ascii")
    return {
        kind: RoomShares(entry["rooms"], tuple(entry["quartiles"]), entry["means"], entry["hosts"])
        for kind, entry in json.loads(text).items()
    }


def shares_for(room_type: str) -> RoomShares | None:
    """Return the contents of real rooms of this type; None for a room that gets no background."""
    kind = ROOM_TYPES.get(room_type)
    return all_shares()[kind] if kind is not None else None


@functools.cache
def wanted(room_type: str) -> Mapping[str, float]:
    """Return the mean number of each category in a room: as in real rooms, then what else belongs there."""
    found = shares_for(room_type)
    if found is None:
        return {}
    groups = [group for group in groups_for(room_type) if group in _GROUPS]
    fillers = {category: _FILLER for group in groups for category in MEMBERS[group]}
    return {**fillers, **found.means}


@functools.cache
def host_weight(category: str, host: str, room_type: str) -> float:
    """Return the preference of a category for a kind of furniture; 0 if it does not belong there."""
    if host in _SOFT_HOSTS and category not in _SOFT:
        return 0.0
    found = shares_for(room_type)
    shares = found.hosts.get(category, {}) if found is not None else {}
    real = sum(share for kind, share in shares.items() if host in _HOST_KINDS.get(kind, "").split())
    if host == ANY_SHELF and any(category in MEMBERS[group] for group in _ON_SHELVES):
        real = max(real, _KNOWN_HOST)
    ranks = preferred_hosts(category)
    if host in ranks and is_usual_host(host, category):
        return real + _KNOWN_HOST / (1 + ranks.index(host))
    return real

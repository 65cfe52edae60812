"""Derivation of ``shares.json`` from the hand-made rooms of iTHOR: `python -m embomatrix.factory.clutter.tables ROOMS OUT`.

The result holds counts and means of room types, and no room. The factory reads only the result.
"""

import gzip
import json
import sys
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

Json = Any

ROOM_KINDS: Final[Mapping[str, str]] = {
    "living_rooms": "living_room",
    "bedrooms": "bedroom",
    "bathrooms": "bathroom",
    "kitchens": "kitchen",
}
_CATEGORIES: Final[Mapping[str, str]] = {
    "AlarmClock": "alarm_clock", "BaseballBat": "baseball_bat", "Book": "hardback", "Bottle": "water_bottle",
    "Bowl": "bowl", "Box": "storage_box", "CD": "cd", "Candle": "pillar_candle", "CellPhone": "cell_phone",
    "Cloth": "rag", "CoffeeMachine": "coffee_maker", "CreditCard": "credit_card", "Cup": "teacup",
    "DeskLamp": "table_lamp", "DishSponge": "sponge", "HandTowel": "hand_towel", "HandTowelHolder": "towel_rack",
    "HousePlant": "pot_plant", "KeyChain": "key_chain", "Laptop": "laptop", "Mirror": "mirror", "Mug": "mug",
    "Newspaper": "newspaper", "Painting": "painting", "Pen": "pen", "Pencil": "pencil", "PepperShaker": "pepper_shaker",
    "Pillow": "pillow", "Plate": "plate", "Poster": "poster", "RemoteControl": "cell_phone", "SaltShaker": "salt_shaker",
    "SoapBar": "bar_soap", "SoapBottle": "soap_dispenser", "SprayBottle": "spray_bottle", "Statue": "statue",
    "TeddyBear": "teddy_bear", "TissueBox": "box_of_tissues", "Toaster": "toaster", "ToiletPaper": "toilet_paper",
    "Towel": "bath_towel", "TowelHolder": "towel_rack", "Vase": "vase", "Watch": "watch", "WineBottle": "bottle_of_wine",
    "LightSwitch": "electric_switch",
}  # fmt: skip
"""Catalog categories of iTHOR's object types that do not stand on the floor. Food and cutlery are left to tasks."""
ON_WALL: Final = frozenset(
    ("mirror", "painting", "poster", "towel_rack", "hand_towel", "bath_towel", "electric_switch")
)
_DECIMALS: Final = 3


def main(rooms: Path, out: Path) -> None:
    """Write the shares of the rooms in a table as described in `docs/scenes.md`."""
    value = json.loads(gzip.decompress(rooms.read_bytes()))
    out.write_text(json.dumps(shares_of(value["rooms"]), indent=1) + "\n", encoding="ascii")


def shares_of(rooms: Sequence[Json]) -> Json:
    """Return for each room type the quartiles of its objects, means by category, and the share of each host."""
    by_type: defaultdict[str, list[Json]] = defaultdict(list)
    for room in rooms:
        if room["kind"] in ROOM_KINDS:
            by_type[ROOM_KINDS[room["kind"]]].append(room["objects"])
    return {kind: _shares(by_type[kind]) for kind in ROOM_KINDS.values()}


def _shares(rooms: Sequence[Json]) -> Json:
    found: Counter[str] = Counter()
    hosts: defaultdict[str, Counter[str]] = defaultdict(Counter)
    for kind, *_, parents, _mass in (row for room in rooms for row in room):
        category = _CATEGORIES.get(kind)
        if category is not None:
            found[category] += 1
            if parents and category not in ON_WALL:
                hosts[category][parents[0]] += 1
    return {
        "rooms": len(rooms),
        "quartiles": np.quantile([len(room) for room in rooms], (0.25, 0.5, 0.75)).round().tolist(),
        "means": {name: round(found[name] / len(rooms), _DECIMALS) for name in sorted(found)},
        "hosts": {
            name: {host: round(count / found[name], _DECIMALS) for host, count in sorted(counts.items())}
            for name, counts in sorted(hosts.items())
        },
    }


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))

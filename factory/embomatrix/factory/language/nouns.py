"""English nouns of categories and rooms, with their plurals and articles by the library inflect."""

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import inflect

EVERYDAY: Final[Mapping[str, str]] = {
    "bottom_cabinet": "low cabinet",
    "bottom_cabinet_no_top": "base cabinet",
    "metal_bottom_cabinet": "low metal cabinet",
    "top_cabinet": "wall cabinet",
    "furniture_sink": "sink unit",
    "multi_station_furniture_sink": "long sink unit",
    "multi_station_tabletop_sink": "long sink",
    "multi_station_wall_mounted_sink": "long wash trough",
    "wall_mounted_sink": "wall sink",
    "drop_in_sink": "built-in sink",
    "tabletop_sink": "washbowl",
    "commercial_kitchen_sink": "kitchen sink",
    "commercial_kitchen_table": "steel worktable",
    "commercial_kitchen_shelf": "kitchen shelf",
    "wall_mounted_tv": "TV on the wall",
    "standing_tv": "TV",
    "wall_mounted_loudspeaker": "loudspeaker on the wall",
    "hardback": "hardback book",
    "carpet": "rug",
    "floors": "floor",
    "tablefork": "fork",
    "table_knife": "table knife",
    "public_trash_can": "rubbish bin",
    "trash_can": "waste bin",
    "clothes_dryer": "tumble dryer",
    "washer": "washing machine",
    "pot_plant": "potted plant",
    "rolled_yoga_mat": "yoga mat",
    "wicker_basket": "wicker basket",
    "hingeless_jar": "jar",
    "hinged_jar": "clip-top jar",
    "bottle_of_pop": "bottle of pop",
    "standing_loudspeaker": "floor speaker",
    "desktop_computer": "computer",
    "gym_shoe": "trainer",
    "pack_of_bread": "pack of bread",
    "breakfast_table": "table",
    "commercial_kitchen_table_top": "worktop",
    "bunch_of_bananas": "bunch of bananas",
    "dip_candle": "dip candle",
    "cup_of_yogurt": "cup of yogurt",
    "baseball_cap": "baseball cap",
    "free_weight": "dumbbell",
    "cellulose_tape": "roll of sticky tape",
    "vidalia_onion": "onion",
    "cantaloup": "melon",
    "white_turnip": "turnip",
    "bap": "bread roll",
}
"""Everyday nouns of categories with technical names."""
_ENGINE: Final = inflect.engine()


@dataclass(frozen=True, slots=True)
class Noun:
    """Count noun in both numbers."""

    one: str
    many: str

    def at(self, count: int) -> str:
        """Return the form for this number of objects."""
        return self.one if count == 1 else self.many


@functools.cache
def noun_of(category: str) -> Noun:
    """Return the everyday noun of a category."""
    return noun(EVERYDAY.get(category, category.replace("_", " ")))


def everyday_noun(category: str) -> str:
    """Return the everyday noun of a category in the singular."""
    return noun_of(category).one


@functools.cache
def noun(words: str) -> Noun:
    """Return the noun with its plural. The head stands before a preposition: ``TVs on the wall``."""
    for preposition in (" on ", " of ", " with ", " for "):
        head, found, rest = words.partition(preposition)
        if found:
            return Noun(words, f"{noun(head).many}{found}{rest}")
    if words.endswith("TV"):
        return Noun(words, f"{words}s")  # inflect writes TVS
    return Noun(words, words if words in _PLURALS else str(_ENGINE.plural_noun(words)))


_PLURALS: Final = frozenset(
    {"eyeglasses", "sunglasses", "keys", "shorts", "jeans", "pajamas", "goggles", "tongs", "shears"}
)
"""Nouns without a singular. `is_plural` tells their number."""


def is_plural(words: str) -> bool:
    """True for a noun without a singular."""
    return words in _PLURALS


def with_article(words: str) -> str:
    """Return the noun with ``a`` or ``an``."""
    return str(_ENGINE.a(words))


def number_word(count: int) -> str:
    """Return a number in words."""
    return str(_ENGINE.number_to_words(str(count)))


def listed(items: Sequence[str], conjunction: str = "and") -> str:
    """Return ``a, b and c``."""
    return str(_ENGINE.join(tuple(items), conj=conjunction, final_sep=""))


_GERUNDS: Final[Mapping[str, str]] = {
    "open": "opening",
    "deposit": "depositing",
    "transfer": "transferring",
    "position": "positioning",
    "soak": "soaking",
}
"""Verbs whose last consonant inflect doubles, or fails to double, wrongly."""


def gerund(verb: str) -> str:
    """Return the ``-ing`` form of a verb."""
    return _GERUNDS.get(verb) or str(_ENGINE.present_participle(verb))


def room_noun(room: str, rooms: Sequence[str]) -> str:
    """Return ``the kitchen`` for the only kitchen among the rooms, otherwise ``bedroom 1`` with its number."""
    stem, _, number = room.rpartition("_")
    if not number.isdigit():
        stem = room
    alike = [other for other in rooms if other.rpartition("_")[0] == stem or other == stem]
    words = stem.replace("_", " ").replace("childs", "child's")
    return f"the {words}" if len(alike) <= 1 else f"{words} {number}"

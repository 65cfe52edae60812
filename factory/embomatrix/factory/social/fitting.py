"""Plausibility of requests: a request must suit an activity of the cast and household conventions."""

from collections.abc import Mapping, Sequence
from typing import Final

from embomatrix.factory.furnish.small_objects import COOKWARE, FOR_DRINKS, MEMBERS, ItemKind
from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.social.occasions import Theme, occasion_of
from embomatrix.factory.social.values import Cast, DaySlot
from embomatrix.factory.writer.goals import GoalConjunct
from embomatrix.world.state import Relation

_GROUP_OF: Final[Mapping[str, ItemKind]] = {
    category: group for group, members in MEMBERS.items() for category in members
}


def _themes(words: str) -> frozenset[Theme]:
    return frozenset(map(Theme, words.split()))


GROUP_THEMES: Final[Mapping[ItemKind, frozenset[Theme]]] = {
    ItemKind.FOOD: _themes("cooking meals stock guests"),
    ItemKind.FRUIT: _themes("cooking meals stock guests"),
    ItemKind.TABLEWARE: _themes("cooking meals guests tidying"),
    ItemKind.PACKAGES: _themes("cooking meals stock guests screens"),
    ItemKind.BOOKS: _themes("reading papers sleep tidying"),
    ItemKind.TOYS: _themes("play tidying"),
    ItemKind.DEVICES: _themes("screens papers leaving tidying"),
    ItemKind.OFFICE: _themes("papers teaching tidying"),
    ItemKind.TOILETRIES: _themes("washing"),
    ItemKind.DECORATION: _themes("guests tidying leaving"),
}
"""Themes of a request to move an object of the group."""

_KITCHEN: Final = frozenset(
    {"kitchen", "bar", "break_room", "pantry_room", "dining_room", "garden", "grocery_store"}
)
_EATING: Final = _KITCHEN | {"living_room", "television_room"}
_WASHING: Final = frozenset(
    {
        "bathroom",
        "spa",
        "locker_room",
        "bedroom",
        "closet",
        "utility_room",
        "infirmary",
        "hammam",
        "sauna",
        "gym",
    }
)
_WORKING: Final = frozenset({"private_office", "shared_office", "meeting_room", "lobby"})
GROUP_ROOMS: Final[Mapping[ItemKind, frozenset[str]]] = {
    ItemKind.FOOD: _EATING,
    ItemKind.FRUIT: _EATING | _WORKING,
    ItemKind.PACKAGES: _EATING | _WORKING | {"storage_room"},
    ItemKind.TABLEWARE: _EATING | _WORKING | {"storage_room"},
    ItemKind.TOILETRIES: _WASHING,
}
"""Room types that people bring objects of a group to. Groups without an entry go to any room not in `EXCLUDED_ROOMS`."""
_WET: Final = frozenset({"bathroom", "spa", "hammam", "sauna", "locker_room"})
EXCLUDED_ROOMS: Final[Mapping[ItemKind, frozenset[str]]] = {
    **dict.fromkeys((ItemKind.DEVICES, ItemKind.OFFICE, ItemKind.TOYS), _WET),
    ItemKind.BOOKS: frozenset({"hammam", "sauna"}),
}
"""Room types that people bring no objects of the group to."""
FOR_DISHES: Final = frozenset({"dishwasher", "dish_rack", "dish_rack_cart"})
NOT_FOR_FOOD: Final = frozenset({"bookcase", "piano"})
_EATEN: Final = frozenset({ItemKind.FOOD, ItemKind.FRUIT, ItemKind.PACKAGES})
PLURAL_NOUNS: Final = frozenset({"eyeglasses"})
"""Plural nouns, which the sentence templates don't support."""
NOT_ON_SOFT: Final = frozenset(
    {
        ItemKind.DECORATION,
        ItemKind.TABLEWARE,
        ItemKind.FOOD,
        ItemKind.FRUIT,
        ItemKind.PACKAGES,
        ItemKind.OFFICE,
    }
)
SOFT: Final = frozenset({"bed", "sofa", "armchair", "ottoman", "carpet", "hospital_bed"})
SEATS: Final = frozenset({"taboret", "bench", "booth", "bar_stool"})
"""Seats besides chairs."""
BASIN: Final = "_sink"
"""Ending of the categories of basins."""
NO_HOSTS: Final = frozenset(
    {
        "urinal",
        "toilet",
        "bathtub",
        "shower_stall",
        "radiator",
        "wood_fireplace",
        "gas_fireplace",
        "charcoal_grill",
        "sauna_heater",
        "drink_dispenser",
        "espresso_machine",
        "photocopier",
        "printer",
    }
)
COLD: Final = frozenset({"fridge", "freezer", "cooler", "wine_fridge", "display_fridge", "grocery_fridge"})
OVENS: Final = frozenset({"oven", "microwave", "toaster_oven"})
HOBS: Final = frozenset({"stove", "flat_top_grill", "burner", "charcoal_grill"})
_INTO_BASINS: Final = frozenset(
    {
        *MEMBERS[ItemKind.FRUIT],
        *MEMBERS[ItemKind.TABLEWARE],
        "sponge",
        "hand_towel",
        "bar_soap",
        "broccoli",
        "carrot",
        "potato",
    }
)
_ON_OVENS: Final = frozenset({ItemKind.PACKAGES, ItemKind.TABLEWARE})
_PANS: Final = frozenset({"frying_pan", "saucepan"})
NOT_COOKED: Final = frozenset({"avocado", "banana", "lemon", "orange", "bagel", "croissant"})

SWITCHES: Final[Mapping[str, frozenset[Theme]]] = {
    **dict.fromkeys(
        ("wall_mounted_tv", "standing_tv", "laptop", "monitor", "desktop_computer", "projection_screen"),
        _themes("screens papers guests teaching"),
    ),
    **dict.fromkeys(
        ("jukebox", "radio", "loudspeaker", "standing_loudspeaker"), _themes("screens guests meals play")
    ),
    **dict.fromkeys(
        (*OVENS, *HOBS, "range_hood", "coffee_maker", "toaster", "deep_fryer"), _themes("cooking meals")
    ),
    "dishwasher": _themes("cooking meals tidying"),
    **dict.fromkeys((*COLD, "popcorn_machine", "espresso_machine"), _themes("cooking meals stock guests")),
    **dict.fromkeys(("table_lamp", "floor_lamp"), _themes("reading sleep papers leaving guests")),
    **dict.fromkeys(("washer", "clothes_dryer"), _themes("laundry leaving")),
    **dict.fromkeys(
        ("printer", "photocopier", "desk_phone", "calculator", "shredder", "cell_phone"),
        _themes("papers leaving"),
    ),
    **dict.fromkeys(("electric_fan", "air_conditioner"), _themes("guests leaving sleep")),
    "locker": _themes("leaving tidying laundry"),
    "digital_camera": _themes("guests"),
}
"""Themes of a request to open or switch an object of the category. Basins have their own."""
NEVER_REQUESTED: Final = frozenset({"fire_extinguisher", "pay_phone", "vending_machine", "water_cooler"})
_NEVER_REQUESTED_ENDINGS: Final = ("_shaker", "_atomizer", "_bottle", "_grinder", "_dispenser", "_can")
"""Categories, and endings of categories, that no request opens or switches. In the catalog, a salt shaker has a switch."""
STORAGE_THEMES: Final[Mapping[str, frozenset[Theme]]] = {
    **dict.fromkeys(_KITCHEN, _themes("cooking meals tidying stock guests")),
    **dict.fromkeys(
        ("private_office", "shared_office", "meeting_room", "copy_room", "classroom"),
        _themes("papers tidying teaching"),
    ),
    **dict.fromkeys(_WASHING, _themes("washing leaving tidying")),
}
_GENERAL: Final = _themes("tidying leaving")


def fits(conjunct: GoalConjunct, view: SceneView, slot: DaySlot) -> bool:
    """True if the activity of a rule-based slot suits the request."""
    occasion = occasion_of(slot.activity)
    return occasion is not None and bool(themes_of(conjunct, view) & occasion.themes)


def themes_of(conjunct: GoalConjunct, view: SceneView) -> frozenset[Theme]:
    """Return the themes of a request; empty if the request is implausible."""
    thing = view.category(conjunct.objects[0])
    if thing in PLURAL_NOUNS:
        return frozenset()
    if conjunct.kind == "thermal":
        warmed = any(sign.startswith(("cooked", "hot")) for sign in conjunct.signs)
        by_coffee = any(view.category(name) in FOR_DRINKS for name in conjunct.objects)
        odd = (
            by_coffee
            or (warmed and thing in NOT_COOKED)
            or not _is_served_well(conjunct, view, warmed=warmed)
        )
        return frozenset() if odd else _themes("cooking meals")
    room_type = _room_type(view, conjunct.objects[0])
    if conjunct.kind == "switch":
        if thing in NEVER_REQUESTED or thing.endswith(_NEVER_REQUESTED_ENDINGS):
            return frozenset()
        if thing.endswith(BASIN):
            return _themes("washing cooking laundry")
        return SWITCHES.get(thing, STORAGE_THEMES.get(room_type, _GENERAL))
    places = conjunct.objects[1:]
    inside = any(sign.startswith("inside") for sign in conjunct.signs)
    if not places or not is_plausible(
        thing, view.category(places[0]), _room_type(view, places[0]), inside=inside
    ):
        return frozenset()
    return GROUP_THEMES.get(_GROUP_OF[thing], _GENERAL) if thing in _GROUP_OF else _GENERAL


def _is_served_well(conjunct: GoalConjunct, view: SceneView, *, warmed: bool) -> bool:
    """True if heated, cooked or frozen food ends up in a plausible place, or if the request names no place."""
    for sign in conjunct.signs:
        relation, _, names = sign.rstrip(")").partition("(")
        food, _, host = names.partition(",")
        if relation not in (Relation.INSIDE, Relation.ONTOP):
            continue
        inside = relation == "inside"
        if inside and host not in (OVENS if warmed else COLD):
            return False
        room = next(_room_type(view, name) for name in conjunct.objects if view.category(name) == host)
        if not is_plausible(food, host, room, inside=inside):
            return False
    return True


def is_plausible(thing: str, host: str, room_type: str, *, inside: bool) -> bool:
    """True if people put such an object on or in such a host in such a room."""
    group = _GROUP_OF.get(thing)
    if group is not None and (
        room_type not in GROUP_ROOMS.get(group, {room_type}) or room_type in EXCLUDED_ROOMS.get(group, ())
    ):
        return False
    if host in NOT_FOR_FOOD and group in _EATEN:
        return False
    if thing in COOKWARE and room_type not in _KITCHEN:
        return False
    if host in SEATS or host in SOFT or host.endswith("_chair"):
        return host in SOFT and group not in NOT_ON_SOFT
    if host in FOR_DISHES:
        return group is ItemKind.TABLEWARE
    if host in NO_HOSTS:
        return False
    if host.endswith(BASIN):
        return inside and thing in _INTO_BASINS
    if host in COLD:
        return not inside or group in {ItemKind.FOOD, ItemKind.FRUIT, ItemKind.PACKAGES}
    if host in OVENS:
        return group is ItemKind.FOOD or thing in _PANS if inside else group in _ON_OVENS
    return host not in HOBS or thing in _PANS


def best_slot(
    cast: Cast, conjuncts: Sequence[GoalConjunct], view: SceneView, request_counts: Mapping[str, int]
) -> tuple[float, DaySlot] | None:
    """Return the slot that suits all requests best, with its score; None without a suitable slot.

    Slots in the rooms of the objects score higher. People and activities with earlier requests score lower.
    """
    rooms = [[view.room(name) for name in conjunct.objects] for conjunct in conjuncts]
    found: list[tuple[float, DaySlot]] = []
    for slot in cast.day:
        if not all(fits(conjunct, view, slot) for conjunct in conjuncts):
            continue
        here = sum(slot.room in each for each in rooms) / len(conjuncts)
        owned = sum(bool({*each} & {*cast.of(slot.person).rooms}) for each in rooms) / len(conjuncts)
        if here or owned:
            repeated = 0.5 * request_counts.get(slot.person, 0)
            score = 2 * here + owned - repeated - request_counts.get(slot.activity, 0)
            found.append((score, slot))
    return max(found, key=lambda item: item[0], default=None)


def reasons_for(activity: str) -> tuple[str, ...]:
    """Return reasons for needing help during an activity; empty for an unknown activity."""
    occasion = occasion_of(activity)
    return occasion.why if occasion is not None else ()


def _room_type(view: SceneView, name: str) -> str:
    return {room.name: room.type for room in view.scene.rooms}.get(view.room(name), "")

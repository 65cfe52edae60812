"""Rule-based Role-Playing Agent: roles by kind of place, and a seeded cast with a schedule that covers every room."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from embomatrix.factory.social.occasions import ELSEWHERE, Occasion, occasions_in
from embomatrix.factory.social.values import Cast, DaySlot, Person
from embomatrix.world.scene import Room, Scene


@dataclass(frozen=True, slots=True)
class SocialRole:
    """Role of a cast member. ``tie`` is the relation to the first member, ``back`` the inverse relation.

    ``apart`` is the minimum age difference to the first person in years; negative means younger, 0 means any age.
    """

    job: tuple[str, ...]
    age: tuple[int, int]
    tie: str
    back: str
    rooms: tuple[str, ...] = ()
    """Types of rooms that belong to the person, if the scene has them."""
    apart: int = 0


@dataclass(frozen=True, slots=True)
class Milieu:
    """Kind of place. The first role is always cast, others are drawn. The first matching household becomes the setting."""

    setting: tuple[str, ...]
    roles: tuple[SocialRole, ...]
    lived_in: bool = False
    """True if people sleep and wash there."""
    households: Mapping[str, frozenset[str]] = field(default_factory=dict)
    """Settings of casts that contain all of these ties to the first person."""


GENERATION: Final = 20
"""Minimum age difference between parents and children, in years."""
_OFFICES: Final = ("private_office", "shared_office", "meeting_room", "break_room", "copy_room", "phone_room")
_HOME: Final = Milieu(
    ("a home",),
    (
        SocialRole(("nurse", "architect", "bus driver", "tax adviser", "carpenter"), (36, 55), "partner", "partner",
             ("bedroom", "kitchen", "private_office")),
        SocialRole(("teacher", "cook", "translator", "electrician", "librarian"), (30, 58), "partner", "partner",
             ("bedroom", "living_room", "garden")),
        SocialRole(("pupil",), (6, 12), "child", "parent", ("childs_room", "playroom", "bedroom"), -GENERATION),
        SocialRole(("student", "apprentice"), (16, 22), "child", "parent", ("childs_room", "bedroom", "television_room"),
             -GENERATION),
        SocialRole(("pensioner",), (66, 84), "parent", "grown-up child", ("bedroom", "living_room", "garden"), GENERATION),
        SocialRole(("student", "musician", "paramedic"), (21, 34), "lodger", "landlord", ("bedroom", "bathroom")),
    ),
    lived_in=True,
    households={
        "a home that three generations share": frozenset({"parent", "child"}),
        "a family home": frozenset({"child"}),
        "a home that somebody shares with a parent": frozenset({"parent"}),
        "a house with a lodger": frozenset({"lodger"}),
        "a home that two people share": frozenset({"partner"}),
    },
)  # fmt: skip
_RESTAURANT: Final = Milieu(
    (
        "a restaurant before the evening service",
        "a restaurant on a quiet afternoon",
        "a restaurant that opens at noon",
    ),
    (
        SocialRole(
            ("head chef",), (30, 58), "colleague", "colleague", ("kitchen", "pantry_room", "storage_room")
        ),
        SocialRole(("waiter", "waitress"), (19, 45), "waiter", "chef", ("dining_room", "bar", "lobby")),
        SocialRole(
            ("kitchen hand",), (18, 40), "kitchen hand", "chef", ("kitchen", "bathroom", "storage_room")
        ),
        SocialRole(("owner",), (38, 66), "boss", "chef", ("private_office", "dining_room", "bar")),
        SocialRole(("regular guest",), (25, 80), "guest", "chef", ("dining_room", "bathroom")),
    ),
)
_GROCERY: Final = Milieu(
    ("a grocery store before it opens", "a grocery store on a Saturday"),
    (
        SocialRole(
            ("shop manager",),
            (30, 60),
            "colleague",
            "colleague",
            ("grocery_store", "private_office", "storage_room"),
        ),
        SocialRole(("cashier",), (18, 50), "cashier", "manager", ("grocery_store", "break_room")),
        SocialRole(
            ("shelf stacker",),
            (18, 45),
            "shelf stacker",
            "manager",
            ("grocery_store", "storage_room", "corridor"),
        ),
        SocialRole(("customer",), (20, 85), "customer", "manager", ("grocery_store", "bathroom")),
    ),
)
_OFFICE: Final = Milieu(
    ("an office on a Monday morning", "an office before a visit of clients", "an office late in the day"),
    (
        SocialRole(("team lead",), (32, 58), "colleague", "colleague", _OFFICES),
        SocialRole(("programmer", "accountant", "designer"), (23, 50), "colleague", "team lead", _OFFICES),
        SocialRole(
            ("receptionist",),
            (22, 60),
            "receptionist",
            "team lead",
            ("lobby", "copy_room", "break_room", "entryway"),
        ),
        SocialRole(
            ("trainee",), (17, 24), "trainee", "team lead", ("shared_office", "copy_room", "corridor")
        ),
        SocialRole(
            ("caretaker",), (35, 63), "caretaker", "team lead", ("utility_room", "storage_room", "bathroom")
        ),
    ),
)
_SCHOOL: Final = Milieu(
    ("a school before the first lesson", "a school during the long break", "a school on the eve of an open day"),
    (
        SocialRole(("teacher",), (26, 62), "colleague", "colleague",
             ("classroom", "biology_lab", "chemistry_lab", "computer_lab", "gym", "private_office")),
        SocialRole(("pupil",), (11, 17), "pupil", "teacher", ("classroom", "gym", "locker_room", "corridor")),
        SocialRole(("school nurse",), (28, 60), "school nurse", "teacher", ("infirmary", "bathroom")),
        SocialRole(("caretaker",), (35, 63), "caretaker", "teacher", ("utility_room", "storage_room", "locker_room")),
        SocialRole(("head teacher",), (42, 64), "head", "teacher", ("private_office", "meeting_room")),
    ),
)  # fmt: skip
_HOTEL: Final = Milieu(
    ("a hotel on the day of arrival", "a hotel between two conferences"),
    (
        SocialRole(
            ("housekeeper",),
            (22, 58),
            "colleague",
            "colleague",
            ("bedroom", "bathroom", "closet", "living_room"),
        ),
        SocialRole(
            ("receptionist",),
            (20, 50),
            "receptionist",
            "housekeeper",
            ("lobby", "entryway", "private_office"),
        ),
        SocialRole(
            ("guest",), (24, 75), "guest", "housekeeper", ("bedroom", "bathroom", "spa", "sauna", "gym")
        ),
        SocialRole(
            ("masseur", "fitness coach"),
            (24, 50),
            "coach",
            "housekeeper",
            ("spa", "gym", "hammam", "locker_room"),
        ),
    ),
    lived_in=True,
)
_HALL: Final = Milieu(
    ("a hall on the morning of a conference", "a hall while a fair is being set up"),
    (
        SocialRole(
            ("organiser",), (28, 58), "colleague", "colleague", ("conference_hall", "lobby", "meeting_room")
        ),
        SocialRole(
            ("sound engineer",), (22, 55), "sound engineer", "organiser", ("conference_hall", "storage_room")
        ),
        SocialRole(("speaker",), (26, 70), "speaker", "organiser", ("conference_hall", "bathroom")),
        SocialRole(("visitor",), (18, 75), "visitor", "organiser", ("lobby", "corridor", "bar")),
    ),
)
# By the first word of a base scene's name. Scenes named after towns are homes.
_BY_STEM: Final[Mapping[str, Milieu]] = {
    "restaurant": _RESTAURANT,
    "grocery": _GROCERY,
    "office": _OFFICE,
    "school": _SCHOOL,
    "hotel": _HOTEL,
    "hall": _HALL,
}

NAMES: Final = (
    "Aiko", "Amara", "Anton", "Bela", "Carla", "Chidi", "Clara", "Dario", "Elif", "Emil", "Farid", "Greta", "Hana", "Hugo",
    "Ines", "Ivo", "Jonas", "Kalea", "Kofi", "Lena", "Liam", "Lucia", "Maja", "Malik", "Mia", "Nadia", "Niko", "Noor", "Olga",
    "Omar", "Pablo", "Petra", "Priya", "Quinn", "Rafael", "Rosa", "Samira", "Sven", "Tariq", "Tess", "Theo", "Ulla", "Viktor",
    "Wanda", "Xenia", "Yusuf", "Zoe", "Zuri",
)  # fmt: skip
HOBBIES: Final = (
    "baking bread", "chess", "bird watching", "drawing comics", "the piano", "running", "old radios", "gardening", "swimming",
    "jigsaw puzzles", "photography", "football", "knitting", "model trains", "pottery", "crime novels", "cycling", "karaoke",
)  # fmt: skip


MIN_SLOTS: Final = 5
"""Number of activities of a cast member in their own rooms. Further activities cover the remaining rooms."""


def draw_cast(scene: Scene, rng: np.random.Generator) -> Cast:
    """Return two to five people whose roles suit the place. Every room has an owner or a visitor on this day."""
    milieu = _BY_STEM.get(scene.base.split("_")[0], _HOME)
    count = int(rng.integers(2, min(5, len(milieu.roles)) + 1))
    others = rng.permutation(len(milieu.roles) - 1)[: count - 1]
    roles = [milieu.roles[0], *(milieu.roles[1 + int(at)] for at in sorted(others))]
    names = [str(name) for name in rng.permutation(NAMES)[:count]]
    hobbies = [str(hobby) for hobby in rng.permutation(HOBBIES)[:count]]
    people: list[Person] = []
    for role, name, hobby in zip(roles, names, hobbies, strict=True):
        people.append(_person(role, name, hobby, people[0] if people else None, scene.rooms, rng))
    people[0] = people[0].model_copy(
        update={"ties": {name: role.back for role, name in zip(roles[1:], names[1:], strict=True)}}
    )
    ties = {role.tie for role in roles[1:]}
    households = [words for words, needed in milieu.households.items() if needed <= ties]
    settings = households[:1] or milieu.setting
    setting = settings[int(rng.integers(len(settings)))]
    return Cast(setting=setting, people=tuple(people), day=_day(people, scene.rooms, milieu, rng))


def _person(
    role: SocialRole,
    name: str,
    hobby: str,
    first: Person | None,
    rooms: Sequence[Room],
    rng: np.random.Generator,
) -> Person:
    low, high = role.age
    if first is not None and role.apart > 0:
        low = max(low, first.age + role.apart)
    elif first is not None and role.apart < 0:
        high = min(high, first.age + role.apart)
    return Person(
        name=name,
        age=int(rng.integers(low, high + 1)),
        job=role.job[int(rng.integers(len(role.job)))],
        hobby=hobby,
        rooms=tuple(room.name for room in rooms if room.type in role.rooms),
        ties={} if first is None else {first.name: role.tie},
    )


def _day(
    people: Sequence[Person], rooms: Sequence[Room], milieu: Milieu, rng: np.random.Generator
) -> tuple[DaySlot, ...]:
    """Return the schedule.

    It holds activities in the people's own rooms, then every other activity of each room, then unvisited rooms.
    """
    types = {room.name: _activities_in(room.type, milieu) for room in rooms}
    slots = []
    for person in people:
        own = person.rooms or tuple(types)
        for _ in range(MIN_SLOTS):
            slots.append(_slot(person, own[int(rng.integers(len(own)))], types, rng))
    for room, done in types.items():
        for occasion in done:
            able = [person for person in people if occasion.suits(person)]
            owners = [person for person in able if room in person.rooms] or able
            if owners and (room, occasion.doing) not in {(slot.room, slot.activity) for slot in slots}:
                slots.append(_at(occasion, owners[int(rng.integers(len(owners)))], room, rng))
        if not any(slot.room == room for slot in slots):
            slots.append(_slot(people[int(rng.integers(len(people)))], room, types, rng))
    return tuple(sorted(dict.fromkeys(slots), key=lambda slot: (slot.time, slot.person, slot.room)))


def _activities_in(room_type: str, milieu: Milieu) -> tuple[Occasion, ...]:
    """Return the activities of a room type in this kind of place."""
    return tuple(each for each in occasions_in(room_type) if milieu.lived_in or not each.private)


def _slot(
    person: Person, room: str, types: Mapping[str, tuple[Occasion, ...]], rng: np.random.Generator
) -> DaySlot:
    """Return a slot with an activity of the room that suits the person, or a general activity if none does."""
    options = [each for each in types[room] if each.suits(person)] or occasions_in(ELSEWHERE)
    return _at(options[int(rng.integers(len(options)))], person, room, rng)


def _at(occasion: Occasion, person: Person, room: str, rng: np.random.Generator) -> DaySlot:
    """Return a slot at the activity's hour."""
    minute = 15 * int(rng.integers(4))
    return DaySlot(
        time=f"{occasion.hour:02d}:{minute:02d}", person=person.name, room=room, activity=occasion.doing
    )

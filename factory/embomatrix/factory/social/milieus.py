"""Who is found in which kind of scene: roles with ages, jobs and ties."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping


@dataclass(frozen=True, slots=True)
class CastSetting:
    """A setting for a cast in which all of some ties to the first one are found."""

    words: str
    ties: frozenset[str]


@dataclass(frozen=True, slots=True)
class SocialRole:
    """A part that a person can play. ``tie`` is what they are to the first of the cast, ``back`` what that one is to them.

    ``apart`` is how many years older they are than the first at least, younger where it is negative; 0: any.
    """

    job: tuple[str, ...]
    age: tuple[int, int]
    tie: str
    back: str
    rooms: tuple[str, ...] = ()
    """Types of rooms that are theirs, as far as the scene has them."""
    apart: int = 0


@dataclass(frozen=True, slots=True)
class Milieu:
    """The first role is always played; others are drawn. The first household whose ties a cast has is its setting."""

    setting: tuple[str, ...]
    roles: tuple[SocialRole, ...]
    lived_in: bool = False
    """Whether people sleep and wash there."""
    households: tuple[CastSetting, ...] = ()


GENERATION: Final = 20
"""Years between parents and children at least."""
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
    households=(
        CastSetting("a home that three generations share", frozenset({"parent", "child"})),
        CastSetting("a family home", frozenset({"child"})),
        CastSetting("a home that somebody shares with a parent", frozenset({"parent"})),
        CastSetting("a house with a lodger", frozenset({"lodger"})),
        CastSetting("a home that two people share", frozenset({"partner"})),
    ),
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


def milieu_of(base: str) -> Milieu:
    """Of a base scene, by the first word of its name; houses that are named after places are homes."""
    return _BY_STEM.get(base.split("_")[0], _HOME)

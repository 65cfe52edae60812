"""What people ask of a robot that it can't do, and why not: its limits, in words."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from embomatrix.factory.social.phrases import called
from embomatrix.skills.limits import ROBOT

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np

    from embomatrix.factory.scenes.view import SceneView

_ANYWHERE: Final = (
    ("vacuum the floor", "I have one arm with a gripper, and no vacuum cleaner"),
    ("answer the door and sign for the parcel", "I don't write"),
    ("take the bags upstairs", "stairs are not for my wheels"),
    ("change the light bulb", "my gripper can't screw one in"),
)
_BY_ROOM: Final[Mapping[str, tuple[tuple[str, str], ...]]] = {
    "kitchen": (
        ("peel the potatoes", "peeling takes two hands, and I have one"),
        ("taste whether it is salty enough", "I can't taste"),
    ),
    "bathroom": (("unblock the drain", "I don't reach into pipes"),),
    "bedroom": (("make the bed", "sheets slip out of my gripper"),),
    "garden": (("mow the lawn", "I stay on the paths"),),
    "classroom": (("wipe the board", "I don't wipe"),),
    "private_office": (("call them back", "I don't use the telephone"),),
}
HEAVY_KG: Final = 2.0
"""So many times the arm's load: nobody doubts that it is too heavy."""


def impossible_chore(view: SceneView, room: str, rng: np.random.Generator) -> tuple[str, str]:
    """A chore and why the robot can't do it; furniture of the room counts, if it is too heavy."""
    types = {item.name: item.type for item in view.scene.rooms}
    options = [*_ANYWHERE, *_BY_ROOM.get(types.get(room, ""), ())]
    options += [
        (
            f"push the {called(view.category(name))} to the other wall",
            f"it weighs more than the {ROBOT.mass_kg:g} kg that my arm lifts",
        )
        for name in view.in_room.get(room, ())
        if view.asset(name).mass_kg > HEAVY_KG * ROBOT.mass_kg and len(view.alike(name)) == 1
    ]
    return options[int(rng.integers(len(options)))]

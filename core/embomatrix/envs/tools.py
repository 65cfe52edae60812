"""Skills as methods, for libraries that let a language model call an object's methods as tools.

Such libraries describe a tool to the model by the types of its arguments and by its docstring, in Google's style: this module
keeps to it. A method returns what the policy is told, in the words of other [episodes](../episodes.md).
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, ClassVar, Final, Literal

from embomatrix.envs.rules import Visibility
from embomatrix.skills.episode_text import system_for_tools
from embomatrix.skills.syntax import Skill
from embomatrix.world.task import Profile

if TYPE_CHECKING:
    from embomatrix.envs.environment import Environment, PlayedEpisode

OVER: Final = "The episode is over: answer without a call."


class PaperTools:
    """Skills of the profile ``paper``, in one episode after another. All public methods but ``reset`` are tools."""

    profile: ClassVar[Profile] = Profile.PAPER

    def __init__(self, environment: Environment) -> None:
        self._environment = environment
        self._episode: PlayedEpisode | None = None

    def reset(self, task_id: str, seed: int = 0, **_: object) -> str:
        """Begin an episode of a task, and return the text that opens it.

        Raises DatasetError for an unknown task, and what executing a turn raises.
        """
        (self._episode,) = self._environment.begin([(task_id, seed)])
        return self._episode.prompt.user

    @property
    def episode(self) -> PlayedEpisode:
        """Episode that ``reset`` began. Raises RuntimeError before."""
        if self._episode is None:
            raise RuntimeError("no episode was begun: call reset first")
        return self._episode

    def move(self, object_index: int) -> str:
        """Go to an object and face it. Needed before the robot can use it.

        Args:
            object_index: Number that follows the object's name.
        """
        return self._call(Skill.MOVE, object_index=object_index)

    def turn(self, yaw: float) -> str:
        """Turn in place.

        Args:
            yaw: Angle in radians, counter-clockwise seen from above.
        """
        return self._call(Skill.TURN, yaw=yaw)

    def pick_up(self, object_index: int) -> str:
        """Take an object into the empty hand.

        Args:
            object_index: Number that follows the object's name.
        """
        return self._call(Skill.PICK_UP, object_index=object_index)

    def place(self, object_index: int, relation: Literal["ontop", "inside", "under", "nextto"]) -> str:
        """Put the object in the hand on, into, under or next to another one.

        Args:
            object_index: Number that follows the name of that other object.
            relation: Where to put it.
        """
        return self._call(Skill.PLACE, object_index=object_index, relation=relation)

    def move_forward(self, distance: float, yaw: float) -> str:
        """Turn, then drive straight ahead.

        Args:
            distance: Distance in metres.
            yaw: Angle of the turn in radians, counter-clockwise seen from above.
        """
        return self._call(Skill.MOVE_FORWARD, distance=distance, yaw=yaw)

    def open(self, object_index: int) -> str:
        """Open the doors, drawers or lid of an object, with the empty hand.

        Args:
            object_index: Number that follows the object's name.
        """
        return self._call(Skill.OPEN, object_index=object_index)

    def close(self, object_index: int) -> str:
        """Close the doors, drawers or lid of an object, with the empty hand.

        Args:
            object_index: Number that follows the object's name.
        """
        return self._call(Skill.CLOSE, object_index=object_index)

    def toggle_on(self, object_index: int) -> str:
        """Switch an object on, with the empty hand.

        Args:
            object_index: Number that follows the object's name.
        """
        return self._call(Skill.TOGGLE_ON, object_index=object_index)

    def toggle_off(self, object_index: int) -> str:
        """Switch an object off, with the empty hand.

        Args:
            object_index: Number that follows the object's name.
        """
        return self._call(Skill.TOGGLE_OFF, object_index=object_index)

    def heat_object_with_source(self, object_index: int, source_index: int) -> str:
        """Wait until an object is hot that lies in or on a running heat source.

        Args:
            object_index: Number that follows the object's name.
            source_index: Number that follows the name of the heat source.
        """
        return self._call(Skill.HEAT, object_index=object_index, source_index=source_index)

    def cook_object_with_tool(self, object_index: int, source_index: int) -> str:
        """Wait until food is cooked that lies in or on a running heat source.

        Args:
            object_index: Number that follows the name of the food.
            source_index: Number that follows the name of the heat source.
        """
        return self._call(Skill.COOK, object_index=object_index, source_index=source_index)

    def froze_object_with_source(self, object_index: int, source_index: int) -> str:
        """Wait until an object is frozen that lies in a freezer.

        Args:
            object_index: Number that follows the object's name.
            source_index: Number that follows the name of the freezer.
        """
        return self._call(Skill.FREEZE, object_index=object_index, source_index=source_index)

    def go_to_room(self, room_name: str) -> str:
        """Go to another room.

        Args:
            room_name: Name of the room, such as kitchen_0.
        """
        return self._call(Skill.GO_TO_ROOM, room_name=room_name)

    def _call(self, skill: Skill, **arguments: object) -> str:
        """Execute one call and return what the policy is told.

        The call goes the way of a text answer, so arguments of wrong types and unknown skills are answered like there.
        """
        if self.episode.player.end is not None:
            return OVER
        text = json.dumps({"action": skill.value, **arguments}, default=str)
        (observation,) = self._environment.answer([self.episode], [text])
        return observation.text


class HouseholdTools(PaperTools):
    """Skills of the profile ``household``, in one episode after another. All public methods but ``reset`` are tools."""

    profile = Profile.HOUSEHOLD

    def slice_object_with_tool(self, object_index: int, source_index: int) -> str:
        """Slice an object with the knife in the hand.

        Args:
            object_index: Number that follows the object's name.
            source_index: Number that follows the name of the knife.
        """
        return self._call(Skill.SLICE, object_index=object_index, source_index=source_index)

    def clean_object_with_tool(self, object_index: int, source_index: int) -> str:
        """Clean an object with the cloth or brush in the hand, or with the sink or machine that it lies in.

        Args:
            object_index: Number that follows the object's name.
            source_index: Number that follows the name of the cloth, brush, sink or machine.
        """
        return self._call(Skill.CLEAN, object_index=object_index, source_index=source_index)

    def soak_object_in_source(self, object_index: int, source_index: int) -> str:
        """Hold a cloth or vessel under the liquid that runs from a sink or another source.

        Args:
            object_index: Number that follows the object's name.
            source_index: Number that follows the name of the source.
        """
        return self._call(Skill.SOAK, object_index=object_index, source_index=source_index)


def system_text(environment: Environment, profile: Profile) -> str:
    """System text of the environment's episodes for a model that calls the tools of a profile."""
    return system_for_tools(profile, seen=environment.rules.visibility is Visibility.SEEN)


TOOLS: Final = {kind.profile: kind for kind in (PaperTools, HouseholdTools)}
"""Tools of each profile."""

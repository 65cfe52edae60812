"""Interfaces of the layout agents: briefs and answers as JSON, validated by pydantic.

The four agents follow the paper. Three of them can be a language model; poses are always sampled by code.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final, Self, get_type_hints

import numpy as np
from pydantic import TypeAdapter, ValidationError

from embomatrix.factory.layout.constraints import choose_constraints
from embomatrix.factory.layout.distribution import distribute
from embomatrix.factory.layout.organization import organize
from embomatrix.factory.layout.planar import arrange
from embomatrix.factory.layout.sampling import ObjectSampler
from embomatrix.factory.layout.values import Branch, RoomBrief, SampleBrief, SampledPose
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.scenes.editor import PlacementError, SceneEditor
from embomatrix.world.state import Relation


class AgentName(StrEnum):
    """Layout agent that ``factory agent`` can run."""

    DISTRIBUTOR = "scene-distributor"
    ORGANIZER = "room-organizer"
    PLANNER = "planar-constraints"
    SOLVER = "planar-generator"
    SAMPLER = "object-sampler"


class BriefError(ValueError):
    """Brief that an agent can't read. The message is one sentence for the user."""


@dataclass(frozen=True, slots=True)
class AgentInterface:
    """Types of an agent's brief and answer, and the rules that answer without a language model."""

    about: str
    brief: TypeAdapter[Any]
    answer: TypeAdapter[Any]
    rules: Callable[[Any], Any]

    @classmethod
    def of(cls, rules: Callable[[Any], Any], about: str) -> Self:
        """Return the interface of rules whose signature names the types of brief and answer."""
        brief, answer = get_type_hints(rules).values()
        return cls(about, TypeAdapter(brief), TypeAdapter(answer), rules)

    def read(self, text: str) -> Any:
        """Parse a brief from JSON. Raise BriefError that names the field."""
        try:
            return self.brief.validate_json(text)
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            where = ".".join(map(str, first["loc"])) or "the brief"
            raise BriefError(
                f"{where}: {first['msg'].lower()}; `--schema` prints the expected schema"
            ) from error

    def to_json(self, answer: Any) -> str:
        """Return an answer as JSON."""
        return self.answer.dump_json(answer, indent=1).decode()


def _branches(brief: RoomBrief) -> tuple[Branch, ...]:
    return tuple(organize(brief).branches())


def sample(brief: SampleBrief) -> SampledPose:
    """Sample one pose in a base scene with the object-level agent."""
    editor = SceneEditor(build_base_scene(brief.scene, seed=brief.seed))
    sampler = ObjectSampler(editor, np.random.default_rng((brief.seed, 3)))
    relation = Relation(brief.relation.value) if brief.relation else None
    try:
        name = sampler.add(brief.category, brief.model or None, relation, brief.host)
    except PlacementError as error:
        return SampledPose(reason=error.reason, detail=str(error))
    pose = editor.objects[name].pose_world_asset
    return SampledPose(name, pose.position_m, pose.quat_xyzw, editor.objects[name].room)


LAYOUT_AGENTS: Final[Mapping[AgentName, AgentInterface]] = {
    AgentName.DISTRIBUTOR: AgentInterface.of(
        distribute, "Scene-level Distribution Agent: room of each object"
    ),
    AgentName.ORGANIZER: AgentInterface.of(
        _branches, "Room-level Organization Agent: branches of a layout tree"
    ),
    AgentName.PLANNER: AgentInterface.of(
        choose_constraints, "Planar-Level Placement Generator, choice of constraints"
    ),
    AgentName.SOLVER: AgentInterface.of(arrange, "Planar-Level Placement Generator, solver"),
    AgentName.SAMPLER: AgentInterface.of(sample, "Object-level Sampling Agent: pose in a base scene"),
}
MODEL_BACKED: Final = frozenset({AgentName.DISTRIBUTOR, AgentName.ORGANIZER, AgentName.PLANNER})
"""Agents that can be a language model."""

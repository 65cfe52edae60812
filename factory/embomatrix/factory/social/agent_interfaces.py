"""Interfaces of the social agents: briefs and answers as JSON, by rules or with a language model.

The answer of one agent is the brief of the next: scene, people, conversation, instruction.
"""

import zlib
from collections.abc import Mapping
from enum import StrEnum
from typing import Any, Final

import numpy as np

from embomatrix.factory.layout.agent_interfaces import AgentInterface, BriefError
from embomatrix.factory.pictures.sights import sights_of
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.social.facts import SceneFacts, facts_of, with_sights
from embomatrix.factory.social.fitting import reasons_for
from embomatrix.factory.social.model.agents import SocialModelAgents
from embomatrix.factory.social.model.answers import Household
from embomatrix.factory.social.model.dialogue import conversation_of, converse
from embomatrix.factory.social.scene_kinds import SceneKinds, kinds_of
from embomatrix.factory.social.summary import instruction_of
from embomatrix.factory.social.values import RequestSummary, SceneBrief, SummaryBrief, TalkBrief
from embomatrix.factory.social.writer import SocialWriter
from embomatrix.factory.writer.variant import Variant, build_variant
from embomatrix.factory.writer.words import Voice
from embomatrix.world.scene import Scene

ROOMS: Final = 3
"""Number of a scene's rooms that a conversation is about."""
MAX_CONVERSATIONS: Final = 40
"""Maximum number of conversations tried. Not every goal of a scene suits one of its people."""
NO_REASON: Final = "there is much to do today"


class SocialAgent(StrEnum):
    """Agent of the social simulation."""

    EXTRACTOR = "scene-extractor"
    PLAYER = "role-player"
    SIMULATOR = "social-simulator"
    SUMMARIZER = "summarizer"


def extract(brief: SceneBrief) -> SceneFacts:
    """Extract scene information from the inventory. Raise CatalogError."""
    return _facts(build_base_scene(brief.scene, seed=brief.seed))


def play(brief: SceneBrief) -> TalkBrief:
    """Role-Playing Agent. Raise CatalogError."""
    cast = SocialWriter(brief.seed).cast_of(build_base_scene(brief.scene, seed=brief.seed))
    return TalkBrief(scene=brief.scene, cast=cast, seed=brief.seed)


def simulate(brief: TalkBrief) -> SummaryBrief:
    """Social Simulation Agent. Raise CatalogError, or BriefError if no conversation leads to a request of the category."""
    rng = _rng(brief.scene, brief.seed)
    variant = _variant(brief.scene, brief.seed, rng)
    writer, view = SocialWriter(brief.seed, brief.cast), SceneView(variant.scene)
    for _ in range(MAX_CONVERSATIONS):
        talked = writer.talk(variant, view, brief.category, rng)
        if talked is not None:
            return SummaryBrief(
                scene=brief.scene, cast=brief.cast, conversation=talked.conversation, seed=brief.seed
            )
    raise BriefError(
        f"no conversation in {brief.scene} leads to a request of the category {brief.category.value!r} in "
        f"{MAX_CONVERSATIONS} tries: try another seed, which selects other rooms"
    )


def summarise(brief: SummaryBrief) -> RequestSummary:
    """Summarization Agent. Raise CatalogError."""
    rng = _rng(brief.scene, brief.seed)
    view = SceneView(build_base_scene(brief.scene, seed=brief.seed))
    voice = Voice(rng)
    why = voice.choose(reasons_for(brief.conversation.slot.activity) or (NO_REASON,))
    instruction = instruction_of(brief.conversation, brief.cast, view, voice, why)
    return RequestSummary(instruction=instruction, wishes=brief.conversation.last_wishes)


async def answer_with_model(agents: SocialModelAgents, name: SocialAgent, brief: Any) -> Any:
    """Answer a brief with a language model. Raise LlmError or CatalogError."""
    scene = build_base_scene(brief.scene, seed=brief.seed)
    kinds = kinds_of(SceneView(scene))
    if name is SocialAgent.EXTRACTOR:
        sight = await agents.describe(kinds, sights_of(scene), brief.seed)
        return with_sights(_facts(scene), sight.rooms)
    if name is SocialAgent.PLAYER:
        household = await agents.people(kinds, brief.seed)
        day = await agents.plan_day(kinds, household, (), brief.seed)
        cast = household.cast(tuple(event.slot() for event in day))
        return TalkBrief(scene=brief.scene, cast=cast, seed=brief.seed)
    if name is SocialAgent.SIMULATOR:
        return await _talk(agents, kinds, brief)
    summary = await agents.summarise(kinds, brief.conversation.turns, brief.seed)
    wishes = tuple(request.wish.model_dump_json(exclude_defaults=True) for request in summary.requests)
    return RequestSummary(instruction=summary.requests[0].instruction, wishes=wishes)


async def _talk(agents: SocialModelAgents, kinds: SceneKinds, brief: TalkBrief) -> SummaryBrief:
    """Return a conversation about the first event of a day that the model plans. Raise LlmError."""
    household = Household(brief.cast.setting, brief.cast.people, dict.fromkeys(brief.cast.names, ()))
    event = (await agents.plan_day(kinds, household, (), brief.seed))[0]
    turns = await converse(agents, kinds, household, event, lambda number: brief.seed + number)
    conversation = conversation_of(event, turns, (turns[-1].text,))
    return SummaryBrief(scene=brief.scene, cast=brief.cast, conversation=conversation, seed=brief.seed)


def _facts(scene: Scene) -> SceneFacts:
    return facts_of(SceneView(scene), [room.name for room in scene.rooms])


def _rng(scene: str, seed: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence((seed, zlib.crc32(scene.encode()))))


def _variant(name: str, seed: int, rng: np.random.Generator) -> Variant:
    """Return a variant of random rooms of a base scene, with small objects."""
    base = build_base_scene(name, seed=seed)
    rooms = [str(room) for room in rng.permutation([room.name for room in base.rooms])[:ROOMS]]
    return build_variant(base, rooms, f"{base.base}-alone", rng)


SOCIAL_AGENTS: Final[Mapping[SocialAgent, AgentInterface]] = {
    SocialAgent.EXTRACTOR: AgentInterface.of(
        extract, "scene information extraction: rooms, objects and possible actions"
    ),
    SocialAgent.PLAYER: AgentInterface.of(play, "Role-Playing Agent: people of a scene and their schedule"),
    SocialAgent.SIMULATOR: AgentInterface.of(
        simulate, "Social Simulation Agent: conversation that leads to a request"
    ),
    SocialAgent.SUMMARIZER: AgentInterface.of(summarise, "Summarization Agent: instruction"),
}

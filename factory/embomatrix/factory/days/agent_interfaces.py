"""Interfaces of the social agents: briefs and answers as JSON, by rules or with a language model.

The answer of one agent is the brief of the next: scene, people, conversation, instruction.
"""

from collections.abc import Iterator, Mapping
from enum import StrEnum
from typing import Any, Final

from embomatrix.factory.admission import TaskRefusal
from embomatrix.factory.days.drafts import PlannedTask
from embomatrix.factory.days.planning import people_of, plan_day
from embomatrix.factory.layout.agent_interfaces import AgentInterface, BriefError
from embomatrix.factory.pictures.sights import sights_of
from embomatrix.factory.pipeline.variants import VariantOrder
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.social.facts import SceneFacts, facts_of, with_sights
from embomatrix.factory.social.model.agents import SocialModelAgents
from embomatrix.factory.social.model.answers import Household
from embomatrix.factory.social.model.dialogue import conversation_of, converse
from embomatrix.factory.social.scene_kinds import SceneKinds, kinds_of
from embomatrix.factory.social.values import RequestSummary, SceneBrief, SummaryBrief, TalkBrief
from embomatrix.world.scene import Scene
from embomatrix.world.task import TaskCategory

MAX_DAYS: Final = 8
"""Number of days in which a request of the category is looked for."""


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
    scene = build_base_scene(brief.scene, seed=brief.seed)
    return TalkBrief(scene=brief.scene, cast=people_of(_order(scene), brief.seed), seed=brief.seed)


def simulate(brief: TalkBrief) -> SummaryBrief:
    """Social Simulation Agent. Raise CatalogError, or BriefError if no day leads to a request of the category."""
    planned = next((task for task in _tasks(brief) if task.draft.task.category is brief.category), None)
    if planned is None:
        raise BriefError(
            f"no day of {MAX_DAYS} in {brief.scene} leads to a request of the category {brief.category.value!r}: try "
            "another seed"
        )
    return SummaryBrief(
        scene=brief.scene, cast=brief.cast, conversation=planned.conversation, seed=brief.seed
    )


def summarise(brief: SummaryBrief) -> RequestSummary:
    """Summarization Agent. Raise CatalogError, or BriefError for a conversation that the rules did not make."""
    talk = TalkBrief(scene=brief.scene, cast=brief.cast, seed=brief.seed)
    for task in _tasks(talk):
        if task.conversation == brief.conversation:
            return RequestSummary(
                instruction=task.draft.task.instruction, wishes=brief.conversation.last_wishes
            )
    raise BriefError(
        "the rules summarise only conversations that `social-simulator` made with the same scene and seed: give --llm for "
        "others"
    )


def _tasks(brief: TalkBrief) -> Iterator[PlannedTask]:
    """Yield the tasks of the first days of a cast."""
    scene = build_base_scene(brief.scene, seed=brief.seed)
    for number in range(MAX_DAYS):
        planned = plan_day(_order(scene, number), scene, brief.seed, cast=brief.cast)
        if not isinstance(planned, TaskRefusal):
            yield from planned.tasks


def _order(scene: Scene, number: int = 0) -> VariantOrder:
    rooms = tuple(room.name for room in scene.rooms)
    return VariantOrder("train", number, scene.base, rooms, dict.fromkeys(TaskCategory, 1), frozenset())


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

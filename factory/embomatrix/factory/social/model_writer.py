"""Task writer by social simulation with a language model. The scene decides which requests become drafts."""

import asyncio
import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractAsyncContextManager
from typing import Final

from embomatrix.factory.admission import RefusalReason, TaskRefusal
from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.social.conversing import starting_slots
from embomatrix.factory.social.facts import SceneFacts, facts_of, with_sights
from embomatrix.factory.social.model_agents import SocialModelAgents
from embomatrix.factory.social.requests import conjunct_of
from embomatrix.factory.social.summary import transcript_of
from embomatrix.factory.social.values import Cast
from embomatrix.factory.writer.goals import GoalContext
from embomatrix.factory.writer.tasks import Draft, DraftOrder, draft_of
from embomatrix.factory.writer.variant import Variant
from embomatrix.llm.batch import FailureLimit, OnOneLoop
from embomatrix.llm.values import EndpointError, LlmError, UnusableReplyError
from embomatrix.world.scene import Scene

logger = logging.getLogger(__name__)
SEEDS = 2**31
CONCURRENT_DRAFTS: Final = 8
"""Number of concurrent drafts, equal to the endpoint's limit of concurrent requests."""


class ModelWriter(OnOneLoop):
    """Task writer on the social agents. An unusable or missing answer costs only its draft.

    ``look`` renders pictures of a scene for a vision model, once per base scene.
    """

    at_once = CONCURRENT_DRAFTS

    def __init__(
        self,
        agents: SocialModelAgents,
        endpoint: AbstractAsyncContextManager[object] | None = None,
        look: Callable[[Scene], tuple[bytes, ...]] | None = None,
    ) -> None:
        super().__init__(endpoint)
        self._agents = agents
        self._look = look
        self._failure_limit = FailureLimit()
        self._casts: dict[str, Cast] = {}
        self._sights: dict[str, Mapping[str, str]] = {}

    def write(self, variant: Variant, view: SceneView, order: DraftOrder) -> Draft | TaskRefusal:
        """Return a draft, or the reason for its absence. Raise EndpointError after several missing answers in a row."""
        return self.write_all(variant, view, [order])[0]

    def write_all(
        self, variant: Variant, view: SceneView, orders: Sequence[DraftOrder]
    ) -> list[Draft | TaskRefusal]:
        """Return the drafts of concurrent orders; only the first one if the model gives no cast.

        Raise EndpointError after several missing answers in a row.
        """
        answers = self._runner.run(self._drafts(variant, view, orders))
        return [self._outcome(order, answer) for order, answer in zip(orders, answers, strict=False)]

    def _outcome(self, order: DraftOrder, answer: Draft | LlmError) -> Draft | TaskRefusal:
        if isinstance(answer, EndpointError):
            self._failure_limit.unanswered(answer)
            return _refused(order.task_id, RefusalReason.NO_ANSWER, answer)
        self._failure_limit.answered()
        if isinstance(answer, LlmError):
            return _refused(order.task_id, RefusalReason.UNUSABLE_ANSWER, answer)
        return answer

    async def _drafts(
        self, variant: Variant, view: SceneView, orders: Sequence[DraftOrder]
    ) -> list[Draft | LlmError]:
        seeds = [int(order.rng.integers(SEEDS)) for order in orders]
        try:
            cast = await self._cast(variant, view, seeds[0])
        except LlmError as error:
            return [error]
        return await asyncio.gather(
            *(
                self._draft(variant, view, order, cast, seed)
                for order, seed in zip(orders, seeds, strict=True)
            )
        )

    async def _cast(self, variant: Variant, view: SceneView, seed: int) -> Cast:
        """Return the cast of the base scene, which is requested once."""
        base = variant.scene.base
        if base not in self._casts:
            everywhere = facts_of(view, [room.name for room in variant.scene.rooms])
            sights = self._sights[base] = await self._sights_of(variant.scene, everywhere, seed)
            self._casts[base] = await self._agents.cast(with_sights(everywhere, sights), seed)
        return self._casts[base]

    async def _draft(
        self, variant: Variant, view: SceneView, order: DraftOrder, cast: Cast, seed: int
    ) -> Draft | LlmError:
        facts = with_sights(facts_of(view, variant.rooms), self._sights[variant.scene.base])
        slot = starting_slots(cast, variant.rooms, order.rng)[0]
        try:
            conversation = await self._agents.converse(facts, cast, slot, order.category, seed)
            request = await self._agents.summarise(facts, view, conversation, seed)
        except LlmError as error:
            return error
        conjuncts = [conjunct_of(wish, view) for wish in request.wishes]
        transcript = transcript_of(cast, conversation, request.instruction, conjuncts)
        context = GoalContext(view, variant, order.rng)
        return draft_of(context, order, conjuncts, request.instruction, transcript)

    async def _sights_of(self, scene: Scene, facts: SceneFacts, seed: int) -> Mapping[str, str]:
        """Return the appearance of each room; empty without ``look`` or after an unusable answer."""
        if self._look is None:
            return {}
        try:
            return (await self._agents.describe(facts, self._look(scene), seed)).rooms
        except UnusableReplyError as error:
            logger.warning("%s is described by its inventory alone: %s", scene.base, error)
            return {}


def _refused(task_id: str, reason: RefusalReason, error: LlmError) -> TaskRefusal:
    logger.warning("no draft %s: %s", task_id, error)
    return TaskRefusal(reason, str(error))

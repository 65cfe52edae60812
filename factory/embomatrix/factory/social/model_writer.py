"""Tasks by social simulation with a language model: its agents make up people, talk and request; the scene decides."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from embomatrix.factory.refusal import Refusal, RefusalReason
from embomatrix.factory.social.conversing import starting_slots
from embomatrix.factory.social.facts import facts_of, with_sights
from embomatrix.factory.social.requests import piece_of
from embomatrix.factory.social.transcript import transcript_of
from embomatrix.factory.writer.goals import Workshop
from embomatrix.factory.writer.tasks import Draft, draft_of
from embomatrix.llm.loop import OnOneLoop
from embomatrix.llm.patience import Patience
from embomatrix.llm.values import EndpointError, UnusableReplyError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from contextlib import AbstractAsyncContextManager

    import numpy as np

    from embomatrix.factory.social.facts import SceneFacts
    from embomatrix.factory.social.model_agents import ModelAgents
    from embomatrix.factory.social.values import Cast
    from embomatrix.factory.writer.variant import Variant
    from embomatrix.factory.writer.view import SceneView
    from embomatrix.llm.values import LlmError
    from embomatrix.world.scene import Scene
    from embomatrix.world.task import TaskCategory

logger = logging.getLogger(__name__)
SEEDS = 2**31


class ModelWriter(OnOneLoop):
    """Writes drafts by what the agents answer. An answer that stays unusable, or does not come, costs its draft and no more.

    ``look`` gives pictures of a scene, for a model that sees: then each base scene is looked at once, before anything is asked.
    """

    def __init__(
        self,
        agents: ModelAgents,
        endpoint: AbstractAsyncContextManager[object] | None = None,
        look: Callable[[Scene], tuple[bytes, ...]] | None = None,
    ) -> None:
        super().__init__(endpoint)
        self._agents = agents
        self._look = look
        self._patience = Patience()
        self._casts: dict[str, Cast] = {}
        self._sights: dict[str, Mapping[str, str]] = {}

    def write(
        self,
        variant: Variant,
        view: SceneView,
        category: TaskCategory,
        task_id: str,
        rng: np.random.Generator,
    ) -> Draft | Refusal:
        """A draft, or why the model gave none. Raises EndpointError where nobody answered a few times in a row."""
        try:
            draft = self._runner.run(self._write(variant, view, category, task_id, rng))
        except UnusableReplyError as error:
            self._patience.answered()
            return _refused(task_id, RefusalReason.UNUSABLE_ANSWER, error)
        except EndpointError as error:
            self._patience.unanswered(error)
            return _refused(task_id, RefusalReason.NO_ANSWER, error)
        self._patience.answered()
        return draft

    async def _write(
        self,
        variant: Variant,
        view: SceneView,
        category: TaskCategory,
        task_id: str,
        rng: np.random.Generator,
    ) -> Draft:
        base, seed = variant.scene.base, int(rng.integers(SEEDS))
        if base not in self._casts:
            everywhere = facts_of(view, [room.name for room in variant.scene.rooms])
            sights = self._sights[base] = await self._seen(variant.scene, everywhere, seed)
            self._casts[base] = await self._agents.cast(with_sights(everywhere, sights), seed)
        cast = self._casts[base]
        facts = with_sights(facts_of(view, variant.rooms), self._sights[base])
        slot = starting_slots(cast, variant.rooms, rng)[0]
        conversation = await self._agents.converse(facts, cast, slot, category, seed)
        request = await self._agents.summarise(facts, view, conversation, seed)
        pieces = [piece_of(wish, view) for wish in request.wishes]
        transcript = transcript_of(cast, conversation, request.instruction, pieces)
        shop = Workshop(view, variant, rng)
        return draft_of(shop, category, task_id, pieces, request.instruction, transcript)

    async def _seen(self, scene: Scene, facts: SceneFacts, seed: int) -> Mapping[str, str]:
        """What each room looks like; nothing where nobody looks, or what the model says of it can't be used."""
        if self._look is None:
            return {}
        try:
            return (await self._agents.describe(facts, self._look(scene), seed)).rooms
        except UnusableReplyError as error:
            logger.warning("%s is told of by its inventory alone: %s", scene.base, error)
            return {}


def _refused(task_id: str, reason: RefusalReason, error: LlmError) -> Refusal:
    logger.warning("no draft %s: %s", task_id, error)
    return Refusal(reason, str(error))

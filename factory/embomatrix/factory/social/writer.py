"""Task writer by rule-based social simulation: a cast for each scene, a conversation for each task."""

import dataclasses
import zlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.social.casting import draw_cast
from embomatrix.factory.social.conversing import ConversationScenario, GrammarConversation
from embomatrix.factory.social.fitting import best_slot, reasons_for
from embomatrix.factory.social.phrases import (
    CLAUSES,
    MANNER_CLAUSES,
    NOUNS,
    ROOM_OF_OBJECT,
    ROOM_OF_ORIGIN,
    room_called,
)
from embomatrix.factory.social.summary import instruction_of, transcript_of
from embomatrix.factory.social.values import Cast, Conversation, DaySlot
from embomatrix.factory.writer.goals import GoalConjunct, GoalContext
from embomatrix.factory.writer.tasks import Draft, DraftOrder, draft_of, draw_conjuncts
from embomatrix.factory.writer.variant import Variant
from embomatrix.factory.writer.words import FreshVoice
from embomatrix.world.scene import Scene
from embomatrix.world.task import TaskCategory

MAX_EQUAL_WISHES: Final = 2
"""Maximum number of equal requests in one variant."""
GOALS_TRIED: Final = 10
"""Number of goals considered for one task. Each must suit one of the people."""


@dataclass(frozen=True, slots=True)
class Talk:
    """Conversation with its scenario. ``context`` and ``voice`` serve the texts that follow."""

    scenario: ConversationScenario
    conversation: Conversation
    context: GoalContext
    voice: FreshVoice


class SocialWriter:
    """Task writer that simulates the people of a scene. Equal seeds give a base scene the same cast in all variants."""

    def __init__(self, seed: int, cast: Cast | None = None) -> None:
        """``cast`` replaces the drawn casts of all scenes."""
        self._seed = seed
        self._given_cast = cast
        self._casts: dict[str, Cast] = {}
        self._said: tuple[str, Counter[str]] = ("", Counter())

    def cast_of(self, scene: Scene) -> Cast:
        """Return the cast of a base scene."""
        if self._given_cast is not None:
            return self._given_cast
        if scene.base not in self._casts:
            sequence = np.random.SeedSequence((self._seed, zlib.crc32(scene.base.encode())))
            self._casts[scene.base] = draw_cast(scene, np.random.default_rng(sequence))
        return self._casts[scene.base]

    def _said_in(self, variant: Variant) -> Counter[str]:
        """Return the phrases used in this variant.

        Other variants don't count, so that a resumed build writes the same tasks.
        """
        if self._said[0] != variant.scene.scene_id:
            self._said = (variant.scene.scene_id, Counter())
        return self._said[1]

    def write(self, variant: Variant, view: SceneView, order: DraftOrder) -> Draft | None:
        """Return a draft of a request by one of the people."""
        talked = self.talk(variant, view, order.category, order.rng)
        if talked is None:
            return None
        context, cast, talk = talked.context, talked.scenario.cast, talked.conversation
        conjuncts = talked.scenario.conjuncts
        instruction = instruction_of(talk, cast, view, talked.voice, talked.scenario.why)
        transcript = transcript_of(cast, talk, instruction, conjuncts)
        return draft_of(context, order, conjuncts, instruction, transcript)

    def talk(
        self, variant: Variant, view: SceneView, category: TaskCategory, rng: np.random.Generator
    ) -> Talk | None:
        """Return a conversation that leads to a request of this category; None if no goal suits the cast."""
        cast = self.cast_of(variant.scene)
        said = self._said_in(variant)
        voice = FreshVoice(rng, said)
        phrases = {**CLAUSES, **MANNER_CLAUSES}
        context = GoalContext(
            view,
            variant,
            rng,
            phrases=phrases,
            where=ROOM_OF_OBJECT,
            whence=ROOM_OF_ORIGIN,
            nouns=NOUNS,
            room_called=room_called,
            voice=voice,
        )
        chosen = _scenario(cast, context, category, said)
        if chosen is None:
            return None
        conjuncts, slot = chosen.conjuncts, chosen.slot
        said.update((slot.person, slot.activity, _signature_of(conjuncts)))
        used = frozenset(name for conjunct in conjuncts for name in conjunct.objects)
        talk = GrammarConversation(chosen, dataclasses.replace(context, used=used), voice).run()
        return Talk(chosen, talk, context, voice)


def _signature_of(conjuncts: Sequence[GoalConjunct]) -> str:
    """Return the signature of a goal. Repeated signatures are avoided while others are available."""
    return " ".join(sign for conjunct in conjuncts for sign in conjunct.signs)


def _scenario(
    cast: Cast, context: GoalContext, category: TaskCategory, said: Counter[str]
) -> ConversationScenario | None:
    """Return the scenario of the goal that suits a cast member's schedule best; None without a suitable goal.

    Clauses of rejected goals count as used, which keeps the wording varied.
    """
    best: tuple[float, tuple[GoalConjunct, ...], DaySlot] | None = None
    for _ in range(GOALS_TRIED):
        conjuncts = tuple(draw_conjuncts(context, category))
        found = best_slot(cast, conjuncts, context.view, said) if conjuncts else None
        if found is None or said[_signature_of(conjuncts)] >= MAX_EQUAL_WISHES:
            continue
        score, slot = found[0] - said[_signature_of(conjuncts)], found[1]
        if best is None or score > best[0]:
            best = (score, conjuncts, slot)
    if best is None:
        return None
    _, conjuncts, slot = best
    return ConversationScenario(
        cast, slot, conjuncts, FreshVoice(context.rng, said).choose(reasons_for(slot.activity))
    )

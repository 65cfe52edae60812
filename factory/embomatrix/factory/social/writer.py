"""Tasks by social simulation: a cast for each scene, a conversation for each task."""

from __future__ import annotations

import dataclasses
import zlib
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.factory.social.casting import GrammarRolePlayer
from embomatrix.factory.social.conversing import ConversationScenario, GrammarConversation
from embomatrix.factory.social.fitting import best_slot, reasons_for
from embomatrix.factory.social.phrases import CLAUSES, MANNERS, NOUNS, WHENCE, WHERE, room_called
from embomatrix.factory.social.summary import instruction_of, transcript_of
from embomatrix.factory.writer.goals import GoalContext
from embomatrix.factory.writer.tasks import Draft, draft_of, draw_conjuncts
from embomatrix.factory.writer.words import FreshVoice

if TYPE_CHECKING:
    from collections.abc import Sequence

    from embomatrix.factory.scenes.view import SceneView
    from embomatrix.factory.social.casting import RolePlayingAgent
    from embomatrix.factory.social.values import Cast, Conversation, DaySlot
    from embomatrix.factory.writer.goals import GoalConjunct
    from embomatrix.factory.writer.variant import Variant
    from embomatrix.world.scene import Scene
    from embomatrix.world.task import TaskCategory

SAME_WISHES: Final = 2
"""Wishes of one kind in one variant: a third person who wants a sink running is one too many."""
GOALS_TRIED: Final = 10
"""Goals that are looked at for one task: somebody must want it."""


@dataclass(frozen=True, slots=True)
class Talk:
    """A conversation with what led to it; ``shop`` and ``voice`` are for what is still to be said."""

    scenario: ConversationScenario
    conversation: Conversation
    shop: GoalContext
    voice: FreshVoice


class SocialWriter:
    """Plays the people of a scene. The same seed gives a base scene the same cast, whichever variant is asked about."""

    def __init__(self, seed: int, role_player: RolePlayingAgent | None = None) -> None:
        self._seed = seed
        self._role_player = role_player or GrammarRolePlayer()
        self._casts: dict[str, Cast] = {}
        self._said: tuple[str, Counter[str]] = ("", Counter())

    def cast_of(self, scene: Scene) -> Cast:
        """The people of a base scene."""
        if scene.base not in self._casts:
            sequence = np.random.SeedSequence((self._seed, zlib.crc32(scene.base.encode())))
            self._casts[scene.base] = self._role_player.cast(scene, np.random.default_rng(sequence))
        return self._casts[scene.base]

    def _said_in(self, variant: Variant) -> Counter[str]:
        """What was said in this variant so far. Others don't count: a build that is resumed writes the same again."""
        if self._said[0] != variant.scene.scene_id:
            self._said = (variant.scene.scene_id, Counter())
        return self._said[1]

    def write(
        self,
        variant: Variant,
        view: SceneView,
        category: TaskCategory,
        task_id: str,
        rng: np.random.Generator,
    ) -> Draft | None:
        """What somebody who is in one of the variant's rooms on this day comes to ask for."""
        talked = self.talk(variant, view, category, rng)
        if talked is None:
            return None
        shop, cast, talk = talked.shop, talked.scenario.cast, talked.conversation
        pieces = talked.scenario.pieces
        instruction = instruction_of(talk, cast, view, talked.voice, talked.scenario.why)
        transcript = transcript_of(cast, talk, instruction, pieces)
        return draft_of(shop, category, task_id, pieces, instruction, transcript)

    def talk(
        self, variant: Variant, view: SceneView, category: TaskCategory, rng: np.random.Generator
    ) -> Talk | None:
        """A conversation that comes to a wish of this category; None where nobody would have one."""
        cast = self.cast_of(variant.scene)
        said = self._said_in(variant)
        voice = FreshVoice(rng, said)
        phrases = {**CLAUSES, **MANNERS}
        shop = GoalContext(
            view,
            variant,
            rng,
            phrases=phrases,
            where=WHERE,
            whence=WHENCE,
            nouns=NOUNS,
            room_called=room_called,
            voice=voice,
        )
        chosen = _scenario(cast, shop, category, said)
        if chosen is None:
            return None
        pieces, slot = chosen.pieces, chosen.slot
        said.update((slot.person, slot.activity, _wish_of(pieces)))
        used = frozenset(name for piece in pieces for name in piece.objects)
        talk = GrammarConversation(chosen, dataclasses.replace(shop, used=used), voice).run()
        return Talk(chosen, talk, shop, voice)


def _wish_of(pieces: Sequence[GoalConjunct]) -> str:
    """The kind of a goal: nobody asks for the same again while there is something else to ask for."""
    return " ".join(sign for piece in pieces for sign in piece.signs)


def _scenario(
    cast: Cast, shop: GoalContext, category: TaskCategory, said: Counter[str]
) -> ConversationScenario | None:
    """Of some goals that the scene allows, that which suits best somebody's day; None where nobody would wish for any.

    The clauses of goals that are not taken count as said: so the words stay fresh for whatever is tried next.
    """
    best: tuple[float, tuple[GoalConjunct, ...], DaySlot] | None = None
    for _ in range(GOALS_TRIED):
        pieces = tuple(draw_conjuncts(shop, category))
        found = best_slot(cast, pieces, shop.view, said) if pieces else None
        if found is None or said[_wish_of(pieces)] >= SAME_WISHES:
            continue
        score, slot = found[0] - said[_wish_of(pieces)], found[1]
        if best is None or score > best[0]:
            best = (score, pieces, slot)
    if best is None:
        return None
    _, pieces, slot = best
    return ConversationScenario(
        cast, slot, pieces, FreshVoice(shop.rng, said).choose(reasons_for(slot.activity))
    )

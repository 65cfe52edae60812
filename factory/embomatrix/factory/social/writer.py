"""Tasks by social simulation: a cast for each scene, a conversation for each task."""

from __future__ import annotations

import dataclasses
import zlib
from collections import Counter
from typing import TYPE_CHECKING

import numpy as np

from embomatrix.factory.social.casting import GrammarRolePlayer
from embomatrix.factory.social.conversing import GrammarConversation, Scenario, starting_slots
from embomatrix.factory.social.phrases import CLAUSES, WHERE
from embomatrix.factory.social.summary import instruction_of
from embomatrix.factory.social.transcript import transcript_of
from embomatrix.factory.writer.goals import Workshop
from embomatrix.factory.writer.tasks import Draft, draft_of, pieces_of
from embomatrix.factory.writer.words import FreshVoice

if TYPE_CHECKING:
    from embomatrix.factory.social.casting import RolePlayingAgent
    from embomatrix.factory.social.values import Cast
    from embomatrix.factory.writer.variant import Variant
    from embomatrix.factory.writer.view import SceneView
    from embomatrix.world.scene import Scene
    from embomatrix.world.task import TaskCategory


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
        cast = self.cast_of(variant.scene)
        voice = FreshVoice(rng, self._said_in(variant))
        shop = Workshop(view, variant, rng, phrases=CLAUSES, where=WHERE, voice=voice)
        pieces = pieces_of(shop, category)
        if not pieces:
            return None
        about = {view.room(name) for piece in pieces for name in piece.objects}
        slot = starting_slots(cast, tuple(about), rng)[0]
        used = frozenset(name for piece in pieces for name in piece.objects)
        talk = GrammarConversation(
            Scenario(cast, slot, tuple(pieces)), dataclasses.replace(shop, used=used), voice
        ).run()
        instruction = instruction_of(talk, cast, view, voice)
        transcript = transcript_of(cast, talk, instruction, pieces)
        return draft_of(shop, category, task_id, pieces, instruction, transcript)

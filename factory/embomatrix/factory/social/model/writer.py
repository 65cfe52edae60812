"""Writer of requests by social simulation with a language model: people, day, dialogues, requests, validation.

Rules and a validation agent decide which requests are admitted. A refused request is corrected once.
"""

import asyncio
import logging
import zlib
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from embomatrix.factory.admission import RefusalReason, TaskRefusal
from embomatrix.factory.social.model.agents import SocialModelAgents
from embomatrix.factory.social.model.answers import EventAnswer, Household, RequestAnswer, SummaryAnswer
from embomatrix.factory.social.model.dialogue import conversation_of, converse
from embomatrix.factory.social.rules.demands import differences
from embomatrix.factory.social.rules.faults import Fault, FaultKind
from embomatrix.factory.social.rules.nouns import named
from embomatrix.factory.social.rules.validation import faults_of
from embomatrix.factory.social.scene_kinds import SceneKinds
from embomatrix.factory.social.values import Cast, DialogueTurn
from embomatrix.factory.social.wish import FLOOR, Wish
from embomatrix.factory.social.written import WrittenRequest
from embomatrix.llm.batch import FailureLimit, OnOneLoop
from embomatrix.llm.values import EndpointError, LlmError, UnusableReplyError

logger = logging.getLogger(__name__)

CONCURRENT_DIALOGUES: Final = 8
"""Number of concurrent dialogues, equal to the endpoint's limit of concurrent requests."""
DIALOGUES_PER_REQUEST: Final = 3
"""Maximum number of dialogues for each request that is ordered."""
SEEDS: Final = 2**31

Refused = tuple[RequestAnswer, Sequence[Fault]]
Outcome = WrittenRequest | TaskRefusal


@dataclass(slots=True)
class _Home:
    """People of a base scene, and the events of their days that no dialogue has used yet."""

    household: Household
    sights: Mapping[str, str]
    events: deque[EventAnswer] = field(default_factory=deque)
    days: int = 0
    written: list[str] = field(default_factory=list)


class ModelWriter(OnOneLoop):
    """Writer of requests on the social agents. An unusable or missing answer costs only its dialogue.

    ``look`` renders pictures of a base scene, given by its name, for a vision model, once per scene.
    """

    def __init__(
        self,
        agents: SocialModelAgents,
        endpoint: AbstractAsyncContextManager[object] | None = None,
        look: Callable[[str], tuple[bytes, ...]] | None = None,
    ) -> None:
        super().__init__(endpoint)
        self._agents = agents
        self._look = look
        self._missing = FailureLimit()
        self._garbage = FailureLimit()
        self._homes: dict[str, _Home] = {}

    def write(
        self, scene: SceneKinds, count: int, seed: int, earlier: Sequence[str] = ()
    ) -> list[WrittenRequest | TaskRefusal]:
        """Return requests of the people of a scene, at least ``count`` if the model can, and the refusals on the way.

        ``earlier`` are instructions of admitted tasks of this home, which the people do not repeat. Raise LlmError if
        several answers in a row are missing or unusable.
        """
        return self._runner.run(self._write(scene, count, seed, earlier))

    async def _write(
        self, scene: SceneKinds, count: int, seed: int, earlier: Sequence[str]
    ) -> list[WrittenRequest | TaskRefusal]:
        found: list[WrittenRequest | TaskRefusal] = []
        left = DIALOGUES_PER_REQUEST * count
        while left > 0:
            missing = count - sum(isinstance(each, WrittenRequest) for each in found)
            if missing <= 0:
                break
            try:
                home = await self._home(scene, seed)
                seen = scene.with_sights(home.sights)
                events = await self._events(
                    home, seen, min(missing, left, CONCURRENT_DIALOGUES), seed, earlier
                )
            except LlmError as error:
                found.append(self._counted(error))
                left -= 1
                continue
            left -= len(events)
            outcomes = await asyncio.gather(*(self._requests(home, seen, event, seed) for event in events))
            for outcome in outcomes:
                found += self._told(home, outcome)
        return found

    def _told(self, home: _Home, outcome: Sequence[Outcome | LlmError] | LlmError) -> list[Outcome]:
        """Return the outcome of a dialogue, and remember its instructions. Raise LlmError at the limit of failures."""
        if isinstance(outcome, LlmError):
            return [self._counted(outcome)]
        self._missing.answered()
        self._garbage.answered()
        home.written += [each.instruction for each in outcome if isinstance(each, WrittenRequest)]
        return [self._counted(each) if isinstance(each, LlmError) else each for each in outcome]

    def _counted(self, error: LlmError) -> TaskRefusal:
        """Return the refusal for an error. Raise the error if it is one of several in a row."""
        is_missing = isinstance(error, EndpointError)
        (self._missing if is_missing else self._garbage).unanswered(error)
        logger.warning("no request: %s", error)
        reason = RefusalReason.NO_ANSWER if is_missing else RefusalReason.UNUSABLE_ANSWER
        return TaskRefusal(reason, str(error))

    async def _home(self, scene: SceneKinds, seed: int) -> _Home:
        """Return the people of a base scene, who are invented once."""
        if scene.base not in self._homes:
            sights = await self._sights_of(scene, seed)
            household = await self._agents.people(scene.with_sights(sights), _seed(seed, scene.base))
            self._homes[scene.base] = _Home(household, sights)
        return self._homes[scene.base]

    async def _events(
        self, home: _Home, scene: SceneKinds, wanted: int, seed: int, earlier: Sequence[str]
    ) -> list[EventAnswer]:
        """Return the next events of this home, at least one. A new day is planned when the last one is used up."""
        # Another variant of the scene may lack a room of the day that was planned.
        home.events = deque(event for event in home.events if event.room in scene.rooms)
        if not home.events:
            told = [*earlier, *(line for line in home.written if line not in earlier)]
            day_seed = _seed(seed, scene.base, home.days)
            home.days += 1
            home.events.extend(await self._agents.plan_day(scene, home.household, told, day_seed))
        # A dialogue leads to about two requests.
        number = min(len(home.events), max(1, (wanted + 1) // 2))
        return [home.events.popleft() for _ in range(number)]

    async def _requests(
        self, home: _Home, scene: SceneKinds, event: EventAnswer, seed: int
    ) -> list[Outcome | LlmError] | LlmError:
        """Return the outcome of a dialogue about an event, or the error that ended it.

        An error in the correction of refused requests does not cost the requests that were good already.
        """

        def seeds(number: int) -> int:
            return _seed(seed, scene.base, home.days, event.time, event.person, number)

        try:
            turns = await converse(self._agents, scene, home.household, event, seeds)
            summary = await self._agents.summarise(scene, turns, seeds(100))
            judge = _Judge(self._agents, scene, home.household.cast((event.slot(),)), event)
            good, refused = await judge.judged(summary.requests, seeds(101))
        except LlmError as error:
            return error
        failed: list[LlmError] = []
        if refused:
            try:
                again = await self._corrected(scene, turns, refused, seeds)
                better, refused = await judge.judged(again, seeds(103)) if again else ([], refused)
                good += better
            except LlmError as error:
                if not good:
                    return error
                failed.append(error)
        conversation = conversation_of(event, turns, tuple(each.instruction for each in good) or ("",))
        written = [
            WrittenRequest(
                instruction=each.instruction, wish=each.wish, cast=judge.cast, conversation=conversation
            )
            for each in good
        ]
        return [*written, *(_refusal(faults) for _, faults in refused), *failed]

    async def _corrected(
        self,
        scene: SceneKinds,
        turns: Sequence[DialogueTurn],
        refused: Sequence[Refused],
        seeds: Callable[[int], int],
    ) -> tuple[RequestAnswer, ...]:
        """Return the corrected requests; empty if the model's answer is unusable."""
        problems = [
            f"- {request.instruction!r}: {'; '.join(map(str, faults))}" for request, faults in refused
        ]
        answer = SummaryAnswer(requests=tuple(request for request, _ in refused))
        try:
            return (await self._agents.repair(scene, turns, answer, problems, seeds(102))).requests
        except UnusableReplyError as error:
            logger.warning("no corrected request: %s", error)
            return ()

    async def _sights_of(self, scene: SceneKinds, seed: int) -> Mapping[str, str]:
        """Return the appearance of each room; empty without ``look`` or after an unusable answer."""
        if self._look is None:
            return {}
        try:
            return (await self._agents.describe(scene, self._look(scene.base), _seed(seed, scene.base))).rooms
        except UnusableReplyError as error:
            logger.warning("%s is described by its inventory alone: %s", scene.base, error)
            return {}


class _Judge:
    """Rules, then the validation agent, which sees only the instructions that break no rule."""

    def __init__(self, agents: SocialModelAgents, scene: SceneKinds, cast: Cast, event: EventAnswer) -> None:
        self.cast = cast
        self._agents = agents
        self._scene = scene
        self._event = event

    async def judged(
        self, requests: Sequence[RequestAnswer], seed: int
    ) -> tuple[list[RequestAnswer], list[Refused]]:
        """Return the faultless requests, and the others with their faults."""
        sound: list[RequestAnswer] = []
        refused: list[Refused] = []
        for request in (_resolved(each, self._scene) for each in requests):
            faults = faults_of(request.instruction, request.wish, self._scene, self.cast, self._event.slot())
            if faults:
                refused.append((request, faults))
            else:
                sound.append(request)
        if not sound:
            return [], refused
        read = await self._agents.demands(self._scene, [each.instruction for each in sound], seed)
        good = []
        for request, demands in zip(sound, read.answers, strict=True):
            problems = differences(demands, request.wish, self._scene)
            if problems:
                refused.append((request, [Fault(FaultKind.OTHER_DEMANDS, each) for each in problems]))
            else:
                good.append(request)
        return good, refused


def _resolved(request: RequestAnswer, scene: SceneKinds) -> RequestAnswer:
    """Return the request with everyday names of kinds and rooms replaced by those of catalog and scene."""
    groups = tuple(
        group.model_copy(
            update={
                "kind": group.kind if group.kind == FLOOR else named(group.kind) or group.kind,
                "room": scene.room_called(group.room) if group.room else "",
            }
        )
        for group in request.wish.objects
    )
    wish = Wish(objects=groups, conditions=request.wish.conditions)
    return RequestAnswer(instruction=request.instruction, wish=wish)


def _refusal(faults: Sequence[Fault]) -> TaskRefusal:
    return TaskRefusal(RefusalReason.UNFAITHFUL, "; ".join(map(str, faults)))


def _seed(seed: int, *key: str | int) -> int:
    numbers = [zlib.crc32(part.encode()) if isinstance(part, str) else part for part in key]
    return int(np.random.default_rng(np.random.SeedSequence((seed, *numbers))).integers(SEEDS))

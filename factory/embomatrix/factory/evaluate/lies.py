"""Lying language models: a table of lies about a home, and the share of them that the model writer refuses.

Each lie is told by a scripted model in place of an honest request, and repeated when the writer asks for a correction.
Unless the lie states its own ``demands``, the scripted validation agent lies as well: it reads the goal into the words, so
that only the rules can refuse it. Honest requests of the same home must be admitted.
"""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from typing import Any, Final

from embomatrix.factory.admission import RefusalReason, TaskRefusal
from embomatrix.factory.metrics.figures import EvaluationFigures
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.social.model.agents import DAY, PEOPLE, READING, SUMMARY, TURN, SocialModelAgents
from embomatrix.factory.social.model.writer import ModelWriter
from embomatrix.factory.social.rules.demands import Demand, Demands
from embomatrix.factory.social.rules.faults import Fault
from embomatrix.factory.social.rules.validation import faults_of
from embomatrix.factory.social.scene_kinds import SceneKinds, kinds_of
from embomatrix.factory.social.values import Cast, DaySlot, Person
from embomatrix.factory.social.wish import Condition, Wish
from embomatrix.factory.social.written import WrittenRequest
from embomatrix.llm.ledger import Ledger
from embomatrix.llm.values import ChatModel, ChatRequest, LlmError, Reply, Usage
from embomatrix.pages.figures import Better, Figure
from embomatrix.world.json_text import parse_json

GOAL_CALLS: Final = 5.0
"""Half of the calls for each admitted task that the writer with one call for each dialogue needed."""
GOAL_TOKENS: Final = 7000.0
"""Half of its tokens."""
TOLD_TOGETHER: Final = 2
"""Requests of one dialogue when the cost is measured."""
_SEED: Final = 0
_TOKEN: Final = re.compile(r"\w+|[^\w\s]")


@dataclass(frozen=True)
class ScriptedRequest:
    """Request that a scripted model makes. ``demands`` is the validation agent's answer; None for that of an accomplice.

    ``expected`` is the rule that must refuse a lie; "" for an honest request.
    """

    name: str
    about: str
    instruction: str
    wish: Wish
    demands: Demands | None
    expected: str = ""

    def answer(self) -> dict[str, Any]:
        """Return the request as a summarization agent answers it."""
        wish = self.wish.model_dump(mode="json", exclude_defaults=True)
        return {"instruction": self.instruction, "wish": wish}

    def reading(self) -> Demands:
        """Return the answer of the validation agent."""
        if self.demands is not None:
            return self.demands
        return Demands(conditions=tuple(_read_in(each, self.wish) for each in self.wish.conditions))


@dataclass(frozen=True)
class LieTable:
    """Scene, people, honest requests, and lies."""

    scene: str
    people: Mapping[str, Any]
    honest: tuple[ScriptedRequest, ...]
    lies: tuple[ScriptedRequest, ...]

    @staticmethod
    def load() -> "LieTable":
        """Return the table of the package."""
        text = resources.files("embomatrix.factory.evaluate").joinpath("lies.json").read_bytes()
        table = parse_json(text)
        honest = {entry["name"]: entry for entry in table["honest"]}
        lies = []
        for entry in table["lies"]:
            # A lie keeps the honest reading of the words only if it says so: its accomplice reads the goal into them.
            honest_reader = {"demands": honest[entry["of"]]["demands"]} if entry.get("read_honestly") else {}
            merged = {**honest[entry["of"]], "demands": None, **honest_reader, **entry}
            lies.append(_scripted(merged))
        return LieTable(table["scene"], table["people"], tuple(map(_scripted, table["honest"])), tuple(lies))

    def kinds(self) -> SceneKinds:
        """Return the description of the scene."""
        return kinds_of(SceneView(build_base_scene(self.scene, seed=_SEED)))

    def faults(self, request: ScriptedRequest, scene: SceneKinds) -> tuple[Fault, ...]:
        """Return the rules that a request breaks."""
        people = tuple(
            Person(**{name: value for name, value in each.items() if name != "habits"})
            for each in self.people["people"]
        )
        slot = DaySlot(**{name: _event(self.people)[name] for name in DaySlot.model_fields})
        cast = Cast(setting=self.people["setting"], people=people, day=(slot,))
        return faults_of(request.instruction, request.wish, scene, cast, slot)


@dataclass
class ScriptedModel:
    """Chat model that plays the people of the table and makes these requests in one dialogue, again and again.

    Usage counts words and punctuation marks, which is within 10 % of the tokens of SmolLM2 for these prompts.
    """

    people: Mapping[str, Any]
    requests: Sequence[ScriptedRequest]
    prompts: list[ChatRequest] = field(default_factory=list)

    async def complete(self, request: ChatRequest) -> Reply:
        """Answer in the role that the request's purpose names."""
        self.prompts.append(request)
        answer = {
            PEOPLE: self._people,
            DAY: self._day,
            TURN: self._turn,
            SUMMARY: self._summary,
            READING: self._reading,
        }[request.purpose](request)
        text = json.dumps(answer, separators=(",", ":"))
        asked = sum(tokens_in(message.text) for message in request.messages)
        return Reply(text, "scripted", Usage(asked, tokens_in(text)), "stop", 0.0)

    def _people(self, _: ChatRequest) -> object:
        return self.people

    def _day(self, _: ChatRequest) -> object:
        return {"events": [_event(self.people), _event(self.people, "19:30")]}

    def _turn(self, request: ChatRequest) -> object:
        if "You are a household robot" in request.messages[0].text:
            is_last = "last turn" in request.messages[0].text
            told = " ".join(each.instruction for each in self.requests)
            if is_last:
                return {"act": "confirm", "text": f"I will do this: {_plain(told)}"}
            return {"act": "clarify", "text": "Which one do you mean, and where shall it be in the end?"}
        is_first = "Nobody has spoken yet" in request.messages[1].text
        told = " ".join(each.instruction for each in self.requests)
        return {"act": "need" if is_first else "answer", "text": _plain(told)}

    def _summary(self, _: ChatRequest) -> object:
        return {"requests": [each.answer() for each in self.requests]}

    def _reading(self, request: ChatRequest) -> object:
        asked = [each for each in self.requests if each.instruction in request.messages[-1].text]
        return {"answers": [_dump(each.reading()) for each in asked]}


def tokens_in(text: str) -> int:
    """Return the number of words and punctuation marks."""
    return len(_TOKEN.findall(text))


def outcomes_of(model: ChatModel, people: SceneKinds, count: int = 1) -> list[WrittenRequest | TaskRefusal]:
    """Return the requests that the model writer admits from a model, and its refusals. An error is one of them."""
    with ModelWriter(SocialModelAgents(model)) as writer:
        try:
            return writer.write(people, count, _SEED)
        except LlmError as error:
            return [TaskRefusal(RefusalReason.UNUSABLE_ANSWER, str(error))]


def written_by(model: ChatModel, people: SceneKinds, count: int = 1) -> list[WrittenRequest]:
    """Return the requests that the model writer admits from a model; none if its answers are unusable."""
    return [each for each in outcomes_of(model, people, count) if isinstance(each, WrittenRequest)]


def is_refused(outcomes: Sequence[WrittenRequest | TaskRefusal]) -> bool:
    """True if nothing was admitted because of what the requests say, not because the writer got no usable answer."""
    refusals = [each for each in outcomes if isinstance(each, TaskRefusal)]
    return len(refusals) == len(outcomes) and any(
        each.reason is RefusalReason.UNFAITHFUL for each in refusals
    )


def evaluate_lies() -> EvaluationFigures:
    """Return the share of refused lies, the share of admitted honest requests, and the cost of an admitted request."""
    table = LieTable.load()
    scene = table.kinds()

    told: list[str] = []
    failed: list[str] = []
    for lie in table.lies:
        outcomes = outcomes_of(ScriptedModel(table.people, [lie]), scene)
        if any(isinstance(each, WrittenRequest) for each in outcomes):
            told.append(lie.name)
        elif not is_refused(outcomes):
            failed.append(lie.name)
    ruled = sum(bool(table.faults(each, scene)) for each in table.lies)
    honest = sum(bool(written_by(ScriptedModel(table.people, [each]), scene)) for each in table.honest)
    count = len(table.lies)
    refused = (count - len(told) - len(failed)) / count
    figures = (
        Figure("lies_refused", refused, "", Better.HIGHER, count, 1.0),
        Figure("lies_refused_by_rules", ruled / count, "", Better.HIGHER, count),
        Figure("honest_admitted", honest / len(table.honest), "", Better.HIGHER, len(table.honest), 1.0),
        *_cost(table, scene),
    )
    kinds = (
        ("Admitted lies", told),
        ("Lies without a verdict, since the writer got no usable answer", failed),
    )
    notes = tuple(f"{words}: {', '.join(names)}." for words, names in kinds if names)
    return EvaluationFigures("lies", {"scene": table.scene, "model": "scripted"}, figures, notes)


def _cost(table: LieTable, scene: SceneKinds) -> tuple[Figure, Figure]:
    """Return calls and tokens for each admitted request of an honest model with two requests in each dialogue."""
    admitted, calls, tokens = 0, 0, 0
    for at in range(0, len(table.honest) - TOLD_TOGETHER + 1, TOLD_TOGETHER):
        ledger = Ledger(ScriptedModel(table.people, table.honest[at : at + TOLD_TOGETHER]))
        admitted += len(written_by(ledger, scene, TOLD_TOGETHER))
        total = ledger.total()
        calls += total.calls
        tokens += total.prompt_tokens + total.completion_tokens
    each = max(1, admitted)
    return (
        Figure("calls_per_task", calls / each, "calls", Better.LOWER, admitted, GOAL_CALLS),
        Figure("tokens_per_task", tokens / each, "tokens", Better.LOWER, admitted, GOAL_TOKENS),
    )


def _scripted(entry: Mapping[str, Any]) -> ScriptedRequest:
    wish = Wish.model_validate({"objects": entry["objects"], "conditions": entry["conditions"]})
    demands = entry.get("demands")
    return ScriptedRequest(
        entry["name"],
        entry.get("about", ""),
        entry["instruction"],
        wish,
        None if demands is None else Demands.model_validate({"conditions": demands}),
        entry.get("expected", ""),
    )


def _event(people: Mapping[str, Any], time: str = "18:00") -> dict[str, Any]:
    first, second, *_ = people["people"]
    return {
        "time": time,
        "person": first["name"],
        "room": first["rooms"][-1],
        "activity": "watching the news",
        "needs": [
            "A thing that was left on the bed is needed at the sofa.",
            "The oven in the kitchen should not stay as it is.",
        ],
        "other": second["name"],
        "other_need": "Something from the fridge would be good for supper.",
    }


def _read_in(condition: Condition, wish: Wish) -> Demand:
    """Return the demand of an accomplice, who states the condition whatever the words say."""
    groups = wish.groups
    parts = {
        name: _read_in(part, wish)
        for name in ("otherwise", "provided")
        if (part := getattr(condition, name)) is not None
    }
    things = groups[condition.things]
    host = groups[things.host].kind if things.host else things.room
    return Demand(
        predicate=condition.predicate,
        thing=things.kind,
        place=groups[condition.place].kind if condition.place else "",
        where=host,
        quantity=condition.quantity,
        count=condition.count,
        holds=condition.holds,
        otherwise=parts.get("otherwise"),
        provided=parts.get("provided"),
    )


def _dump(demands: Demands) -> object:
    return demands.model_dump(mode="json", exclude_defaults=True)


def _plain(text: str) -> str:
    """Return the text as a turn may state it: without markup, and not too long."""
    return re.sub(r"[\n<>{}]", " ", text)[:280].strip() or "Nothing."

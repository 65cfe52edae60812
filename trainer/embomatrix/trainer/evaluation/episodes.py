"""Evaluation in episodes: an agent answers call by call and observes what happened.

The answer sheet keeps all answers of an episode as one, a JSON list of texts, so an episode can be judged again: equal answers
lead to equal observations and to the same end.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import logging
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Sequence
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Protocol

from embomatrix.envs.player import EpisodePlayer
from embomatrix.envs.rules import Visibility
from embomatrix.llm.cassette import Cassette
from embomatrix.llm.ledger import Ledger
from embomatrix.llm.values import ChatModel, ChatRequest, EndpointError, LlmError, Message, Reply, Speaker
from embomatrix.scripts.searching import PlacePriors, SearchingScript
from embomatrix.skills.parse import DONE, plan_to_lines
from embomatrix.skills.prompt import Codec, Prompt, prompt_for
from embomatrix.skills.seeds import evaluation_seed
from embomatrix.trainer.config.errors import TrainerError, first_of
from embomatrix.trainer.data.tasks import TrainingTask
from embomatrix.trainer.episodes.terms import EpisodeTerms
from embomatrix.trainer.evaluation.answer_sources import PURPOSE, OnProgress, seed_of
from embomatrix.trainer.evaluation.answers import Answer, AnswerSheet, EvaluationSetup
from embomatrix.trainer.evaluation.benchmark import Benchmark
from embomatrix.trainer.evaluation.exam import ExamResult, Question, success_by_level
from embomatrix.trainer.evaluation.intervals import mean_over_tasks
from embomatrix.trainer.evaluation.pictures import chosen_pictures
from embomatrix.trainer.evaluation.scoreboard import Scoreboard
from embomatrix.trainer.evaluation.taxonomy import Cause, cause_of_trace
from embomatrix.trainer.evaluation.verdicts import AnswerVerdict
from embomatrix.world.json_text import parse_json

if TYPE_CHECKING:
    from embomatrix.envs.simulation import Simulation
    from embomatrix.llm.endpoint import Endpoint
    from embomatrix.skills.syntax import Plan, SkillCall
    from embomatrix.world.task import Task

logger = logging.getLogger(__name__)

_TOO_LONG: Final = frozenset({400, 413, 422})
"""HTTP statuses with which endpoints refuse a conversation that is longer than the model's context."""
TURNS_FILE: Final = "turns.jsonl"
"""Answers of a model within episodes, as they arrive."""


@dataclass(frozen=True, slots=True)
class AgentReply:
    """One answer within an episode. Token counts are 0 if unknown."""

    text: str
    finish: str = ""
    prompt_tokens: int = 0
    completion_tokens: int = 0


class EpisodeAgent(Protocol):
    """Anything that plays one episode."""

    async def answer(
        self, system: str, observations: Sequence[str], answers: Sequence[str], player: EpisodePlayer
    ) -> AgentReply:
        """Return the next answer.

        ``observations`` are the texts so far, the task first, and ``answers`` the answers to them. A model must not look at the
        player, but stops it if it has no room for another answer; then what it returns does not count.
        """
        ...


Play = Callable[[str, int, Prompt, EpisodePlayer], Awaitable[None]]
"""Plays one episode: gets its task, its sample, the opening prompt and the player."""


class EpisodeRunner:
    """Plays episodes of a benchmark's tasks. ``simulate`` returns where they are executed."""

    def __init__(self, bench: Benchmark, simulate: Callable[[], Simulation]) -> None:
        self._bench = bench
        self._simulate = simulate
        self._records = {record.task.task_id: record for record in bench.records}

    def run(
        self,
        setup: EvaluationSetup,
        keys: Iterable[tuple[str, int]],
        play: Play,
        within: Callable[[], AbstractAsyncContextManager[object]] = contextlib.nullcontext,
    ) -> None:
        """Play the episodes of these tasks and samples. Few scenes are used at a time, with all their episodes together.

        ``within`` makes a context in which all are played. Raises what ``play`` raises, ClusterError and EngineError.
        """
        by_scene: dict[str, list[tuple[str, int]]] = {}
        for task_id, sample in keys:
            by_scene.setdefault(self._records[task_id].bundle_digest, []).append((task_id, sample))
        if by_scene:
            try:
                asyncio.run(self._run(setup, list(by_scene.values()), play, within))
            except ExceptionGroup as errors:
                raise first_of(errors) from errors

    async def _run(
        self,
        setup: EvaluationSetup,
        scenes: Sequence[list[tuple[str, int]]],
        play: Play,
        within: Callable[[], AbstractAsyncContextManager[object]],
    ) -> None:
        simulation = self._simulate()
        gate = asyncio.Semaphore(simulation.scenes)

        async def play_scene(members: list[tuple[str, int]]) -> None:
            async with gate, asyncio.TaskGroup() as group:
                for task_id, sample in members:
                    group.create_task(self._play(simulation, setup, task_id, sample, play))

        await simulation.open()
        try:
            async with within(), asyncio.TaskGroup() as group:
                for members in scenes:
                    group.create_task(play_scene(members))
        finally:
            await simulation.close()

    async def _play(
        self, simulation: Simulation, setup: EvaluationSetup, task_id: str, sample: int, play: Play
    ) -> None:
        terms = _terms_of(setup)
        record, task = self._records[task_id], self._bench.tasks[task_id]
        running = await simulation.begin(record, evaluation_seed(setup.seed, task_id), sight=terms.sight)
        player = EpisodePlayer(running, task.situation, terms.rules(task.oracle), Codec(setup.codec))
        await play(task_id, sample, await player.begin(), player)


def _terms_of(setup: EvaluationSetup) -> EpisodeTerms:
    return EpisodeTerms(Visibility(setup.visibility), setup.calls_factor, setup.calls_more)


def play_episodes(
    stage: EpisodeRunner,
    agent_of: Callable[[str, int], EpisodeAgent],
    questions: Sequence[Question],
    sheet: AnswerSheet,
    on_progress: OnProgress,
    within: Callable[[], AbstractAsyncContextManager[object]] = contextlib.nullcontext,
    concurrent: int | None = None,
) -> None:
    """Play the episodes that the sheet lacks, each by its own agent, and store their answers.

    At most ``concurrent`` agents are at work at a time, by default all of the scenes in use. Raises TrainerError with the
    number of stored episodes if a model does not answer, ClusterError and EngineError.
    """
    total = len(questions) * sheet.setup.samples
    keys = [(question.task_id, sample) for question in questions for sample in range(sheet.setup.samples)]

    gate = contextlib.nullcontext() if concurrent is None else asyncio.Semaphore(concurrent)

    async def play(task_id: str, sample: int, prompt: Prompt, player: EpisodePlayer) -> None:
        async with gate:
            await play_one(task_id, sample, prompt, player)

    async def play_one(task_id: str, sample: int, prompt: Prompt, player: EpisodePlayer) -> None:
        agent = agent_of(task_id, sample)
        answers: list[AgentReply] = []
        observations = [prompt.user]
        while player.end is None:
            answer = await agent.answer(prompt.system, observations, [one.text for one in answers], player)
            if player.end is not None:  # the agent has no room for another answer
                break
            answers.append(answer)
            observations.append((await player.answer(answers[-1].text)).text)
        text = json.dumps([one.text for one in answers])
        tokens = (sum(one.prompt_tokens for one in answers), sum(one.completion_tokens for one in answers))
        finish = answers[-1].finish if answers else ""
        sheet.add([Answer(task_id, sample, text, finish, *tokens)])
        on_progress(len(sheet), total)

    try:
        stage.run(sheet.setup, [key for key in keys if key not in sheet], play, within)
    except LlmError as error:
        message = str(error).removeprefix(f"{PURPOSE}: ")  # the command prints its own name
        raise TrainerError(
            f"{message}; {len(sheet)} of {total} episodes are kept in {sheet.path}, and the answers of the others beside it: "
            "the same command continues from there"
        ) from error


class ChatAgent:
    """Model behind an OpenAI-compatible endpoint, asked with the whole conversation so far."""

    def __init__(self, model: ChatModel, setup: EvaluationSetup, task_id: str, sample: int) -> None:
        self._model = model
        self._setup = setup
        self._seed = seed_of(setup.seed, task_id, sample)

    async def answer(
        self, system: str, observations: Sequence[str], answers: Sequence[str], player: EpisodePlayer
    ) -> AgentReply:
        """Ask the model. An endpoint that takes the conversation no more ends the episode. Raises LlmError."""
        turns = itertools.chain.from_iterable(
            itertools.zip_longest(
                (Message(Speaker.USER, text) for text in observations),
                (Message(Speaker.ASSISTANT, text) for text in answers),
            )
        )
        messages = [Message(Speaker.SYSTEM, system), *filter(None, turns)]
        request = ChatRequest(
            PURPOSE,
            tuple(messages),
            max_tokens=self._setup.max_tokens,
            temperature=self._setup.temperature,
            seed=self._seed,
        )
        try:
            reply = await self._model.complete(request)
        except EndpointError as error:
            # It took the conversation before: now it has become longer than the model's context.
            if not answers or error.status not in _TOO_LONG:
                raise
            logger.warning("an episode ends after %d answers: %s", len(answers), error)
            player.stop()
            return AgentReply("")
        return AgentReply(reply.text, reply.finish, reply.usage.prompt_tokens, reply.usage.completion_tokens)


def ask_endpoint_in_episodes(
    open_endpoint: Callable[[], Endpoint],
    folder: Path,
    stage: EpisodeRunner,
    questions: Sequence[Question],
    sheet: AnswerSheet,
    on_progress: OnProgress,
) -> None:
    """Play episodes with a model behind an endpoint. Every answer is kept in ``folder`` at once, and never bought twice."""
    endpoint = _OpenedEndpoint(open_endpoint)
    try:
        model = Cassette(folder / TURNS_FILE, Ledger(endpoint, path=folder / "ledger.jsonl"))
    except LlmError as error:
        raise TrainerError(str(error)) from error
    play_episodes(
        stage,
        lambda task_id, sample: ChatAgent(model, sheet.setup, task_id, sample),
        questions,
        sheet,
        on_progress,
        endpoint.opened,
    )


class _OpenedEndpoint:
    """Endpoint that is open while ``opened`` is."""

    def __init__(self, open_endpoint: Callable[[], Endpoint]) -> None:
        self._open = open_endpoint

    @contextlib.asynccontextmanager
    async def opened(self) -> AsyncIterator[None]:
        async with self._open() as self._endpoint:
            yield

    async def complete(self, request: ChatRequest) -> Reply:
        return await self._endpoint.complete(request)


class SearchingAgent:
    """Oracle: it knows what to do and with which objects, and looks for those that it has not seen."""

    def __init__(self, task: TrainingTask, priors: PlacePriors) -> None:
        self._script = SearchingScript.of(task.oracle, task.situation, priors)

    async def answer(
        self, system: str, observations: Sequence[str], answers: Sequence[str], player: EpisodePlayer
    ) -> AgentReply:
        """Return the script's next call."""
        last = player.steps[-1] if player.steps else None
        return _said(self._script.next_call(player.observer.situation, last))


class PlanAgent:
    """Plan that is written at the start and carried out call by call, whatever happens."""

    def __init__(self, plan: Plan) -> None:
        self._calls = iter(plan)

    async def answer(
        self, system: str, observations: Sequence[str], answers: Sequence[str], player: EpisodePlayer
    ) -> AgentReply:
        """Return the plan's next call."""
        return _said(next(self._calls, None))


def _said(call: SkillCall | None) -> AgentReply:
    return AgentReply(DONE if call is None else plan_to_lines((call,)))


class EpisodeExam:
    """Benchmark of our own tasks, played in episodes."""

    def __init__(self, bench: Benchmark, stage: EpisodeRunner) -> None:
        self.bench = bench
        self.stage = stage
        self.name, self.digest, self.split = bench.name, bench.digest, bench.split
        self.task_ids = tuple(record.task.task_id for record in bench.records)
        self.by_rule = len(bench.failed_by_rule)

    def questions(self, codec: Codec, rows: int) -> tuple[Question, ...]:
        """Return one question per task: its whole situation, of which an episode may show a part."""
        return tuple(
            Question(task_id, prompt_for(task.situation, codec)) for task_id, task in self.bench.tasks.items()
        )

    def judge(
        self, setup: EvaluationSetup, answers: Sequence[Answer], report: Callable[[int, int], None]
    ) -> ExamResult:
        """Play the answers again and judge the ends. Raises TrainerError, ClusterError and EngineError."""
        given = {(answer.task_id, answer.sample): _texts(answer) for answer in answers}
        tasks = {record.task.task_id: record.task for record in self.bench.records}
        verdicts: dict[tuple[str, int], AnswerVerdict] = {}
        plans: dict[tuple[str, int], Plan] = {}
        failed: dict[str, list[float]] = {}

        async def play(task_id: str, sample: int, prompt: Prompt, player: EpisodePlayer) -> None:
            for text in given[task_id, sample]:
                if player.end is not None:
                    break
                await player.answer(text)
            # A stored episode without an end is one whose agent had no room for another answer.
            player.stop()
            key = (task_id, sample)
            verdicts[key] = episode_verdict(tasks[task_id], sample, player)
            plans[key] = tuple(step.call for step in player.steps if step.ok)
            counted = player.reward
            failed.setdefault(task_id, []).append(counted.failures / counted.calls if counted.calls else 0.0)
            report(len(verdicts), len(given))

        self.stage.run(setup, given, play)
        ordered = [verdicts[answer.task_id, answer.sample] for answer in answers]
        categories = {record.task.task_id: record.task.category for record in self.bench.records}
        board = Scoreboard.of(categories, ordered, self.by_rule)
        rates = [sum(shares) / len(shares) for shares in failed.values()]
        others = {
            **success_by_level(self.bench.records, board),
            "share of calls that failed": mean_over_tasks(rates),
        }
        return ExamResult(board, chosen_pictures(self.bench, board, plans), others)


def _texts(answer: Answer) -> list[str]:
    """Return the answers of an episode. Raises TrainerError for another text."""
    try:
        value = parse_json(answer.text.encode("utf-8", errors="replace"))
    except ValueError:
        value = None
    if not isinstance(value, list) or not all(isinstance(text, str) for text in value):
        raise TrainerError(
            f"sample {answer.sample} of the task {answer.task_id[:80]!r} is no list of texts: expected the answers of an "
            "episode; remove its line"
        )
    return value


def episode_verdict(task: Task, sample: int, player: EpisodePlayer) -> AnswerVerdict:
    """Verdict on an episode. The cause of a failure is that of its last call, if that failed."""
    tiers, last = player.reward.tiers, player.steps[-1] if player.steps else None
    failure = last.failure if last is not None else None
    if tiers.success:
        cause = None
    elif last is None:
        cause = Cause.UNPARSABLE
    else:
        cause = cause_of_trace(tuple(step.call for step in player.steps), player.steps, task.table)
    ended = "" if player.end is None else player.end.value
    return AnswerVerdict(
        task.task_id,
        sample,
        success=tiers.success,
        partial=sum(atom.holds for atom in tiers.atoms) / len(tiers.atoms) if tiers.atoms else 0.0,
        cause=cause,
        reason=failure.value if failure is not None else "" if tiers.success else ended,
        step=len(player.steps) if failure is not None else 0,
        sentence=last.message if last is not None and failure is not None else "",
        steps=player.reward.calls,
        done=player.reward.calls - player.reward.failures,
    )

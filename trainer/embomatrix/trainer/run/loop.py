"""Training run: imitation, held-out evaluation, GRPO, held-out evaluation, report."""

from __future__ import annotations

import contextlib
import functools
import logging
import resource
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from embomatrix.skills.seeds import evaluation_seed, training_seed
from embomatrix.trainer.cluster.gateway import Gateway
from embomatrix.trainer.config.settings import SeedPer
from embomatrix.trainer.data.tasks import Curriculum, Schedule
from embomatrix.trainer.episodes.client import EpisodeClient, PlannedEpisode
from embomatrix.trainer.episodes.oracle import OracleExamples, oracle_episodes
from embomatrix.trainer.episodes.teacher import Teacher, TeachingRules
from embomatrix.trainer.episodes.terms import EpisodeTerms
from embomatrix.trainer.evaluation.held_out import HeldOutEvaluation, evaluate_policy
from embomatrix.trainer.evaluation.held_out_episodes import evaluate_in_episodes
from embomatrix.trainer.grpo.records import GroupLog, StepRecord
from embomatrix.trainer.grpo.sampling import EpisodeSampler, Sampler
from embomatrix.trainer.grpo.update import StepPlan, Updater
from embomatrix.trainer.learning.data_parallel import DataParallelWorkers
from embomatrix.trainer.learning.learner import SamplingParams
from embomatrix.trainer.lifecycle.checkpoint import CHECKPOINTS, CheckpointStore, atomic_folder, restore
from embomatrix.trainer.lifecycle.interrupts import DeferredInterrupts
from embomatrix.trainer.lifecycle.stopwatch import Activity, Stopwatch
from embomatrix.trainer.logging.dashboard import DashboardReporter
from embomatrix.trainer.logging.evaluations import AFTER, BEFORE, DURING, EVALUATIONS, read_evaluations
from embomatrix.trainer.logging.outcome import RunOutcome, write_outcome
from embomatrix.trainer.logging.recorder import METRICS, SAMPLES, Recorder, read_metrics
from embomatrix.trainer.logging.report import REPORT, TrainedOn, TrainingSummary, rates_of, write_report
from embomatrix.trainer.logging.trackers import Tracker
from embomatrix.trainer.run.imitation import run_imitation
from embomatrix.trainer.run.starting import REFERENCE, RunStart, imitation_identity
from embomatrix.trainer.serving.sampler import ServerSampler

if TYPE_CHECKING:
    from embomatrix.trainer.logging.display import LineDisplay

logger = logging.getLogger(__name__)
RESERVE_STREAM = 1


class TrainingRun:
    """One run in the folder ``out``. ``server`` samples its plans if one is given; it holds the policy's present weights."""

    def __init__(
        self,
        start: RunStart,
        gateway: Gateway,
        display: LineDisplay,
        out: Path,
        trackers: Sequence[Tracker] = (),
        server: ServerSampler | None = None,
    ) -> None:
        self._start = start
        self._server = server
        self._gateway = gateway
        self._display = display
        self._settings = start.settings
        self._out = out
        self._progress = start.progress
        self._resumed = self._progress.grpo_ready
        self._stopwatch = Stopwatch()
        self._stopwatch.spent_s.update(self._progress.spent_s)
        self._store = CheckpointStore(out / CHECKPOINTS, keep=start.settings.keep_checkpoints)
        self._reporter = DashboardReporter(gateway.report)
        self._recorder = Recorder(out, (*trackers, self._reporter))
        self._terms = EpisodeTerms.of(start.settings.episodes)
        device = next(iter(start.policy.parameters())).device
        self._generator = torch.Generator(device).manual_seed(start.settings.seed)

    def run(self) -> TrainingSummary:
        """Run all phases. Ctrl-C saves a checkpoint for ``--resume`` and is raised again."""
        began_s = time.monotonic()
        earlier_s = sum(self._progress.spent_s.values())
        with DataParallelWorkers.start(self._start.policy, self._settings) as workers:
            if not self._progress.grpo_ready:
                self._prepare(workers)
            if self._settings.grpo.kl_coef:
                reference = self._start.reference or self._start.policy.frozen_copy()
                workers.use_reference(reference, self._out / REFERENCE)
            checkpoint = self._grpo(workers)
            after = self._evaluate(AFTER, self._settings.evaluation.samples, workers)
        summary = self._summary(checkpoint, after, earlier_s + time.monotonic() - began_s)
        source = TrainedOn(self._start.tasks, self._progress.dataset, self._settings.seed)
        write_report(summary, source, read_metrics(self._out), read_evaluations(self._out))
        write_outcome(self._out, summary.outcome)
        return summary

    def _grpo(self, workers: DataParallelWorkers) -> Path:
        """Run GRPO on all data-parallel workers. Return the last checkpoint."""
        start, settings = self._start, self._settings
        updater = Updater(start.policy, workers, self._sampler(workers), settings.grpo, self._stopwatch)
        newest = self._store.latest() if self._resumed else None
        if newest is not None:
            restore(newest, functools.partial(self._load_tensors, updater))
        self._recorder.forget_after(self._progress.step, METRICS, SAMPLES, EVALUATIONS)
        if newest is None:
            self._save(
                updater
            )  # a kill before the first checkpoint of GRPO must not cost the end of imitation
        try:
            self._optimise(updater, workers)
        except BaseException:
            # A step that was taken by half can't be resumed: the checkpoint before it stays the newest.
            if not updater.is_between_updates:
                self._save(updater)
            raise
        return self._save(updater)

    def _sampler(self, workers: DataParallelWorkers) -> Sampler:
        start, settings, builder = self._start, self._settings.grpo, self._start.prompt_builder
        if self._terms is not None:
            return EpisodeSampler(workers, start.policy, builder, self._gateway, settings, self._terms)
        return Sampler(workers, start.policy.codec, builder, self._gateway, settings, self._server)

    def _oracle_and_teacher(
        self, workers: DataParallelWorkers
    ) -> tuple[OracleExamples | None, Teacher | None]:
        """Return examples of the oracle's episodes, played or read, and their teacher, if the policy shall imitate episodes."""
        start, terms, policy = self._start, self._terms, self._start.policy
        budget = self._settings.imitation
        has_budget = budget.seconds > 0 if budget.steps is None else budget.steps > 0
        if terms is None or not has_budget or self._progress.imitation.done:
            return None, None
        planned = [
            PlannedEpisode(task, training_seed(self._settings.seed, task.task.task_id, 0))
            for task in start.tasks.train
            if task.oracle
        ]
        identity = {
            "dataset": self._progress.dataset,
            "seed": self._settings.seed,
            "codec": policy.codec.value,
            "visibility": terms.visibility.value,
            "calls": [terms.calls_factor, terms.calls_more],
        }
        client = EpisodeClient(self._gateway, terms, policy.codec)
        with self._stopwatch.track(Activity.ORACLE):
            episodes = oracle_episodes(self._out, identity, planned, client, self._display.playing_oracle)
        examples = OracleExamples(episodes, policy, start.tasks.train)
        self._display.played_oracle(len(examples.tasks), len(planned))
        rules = TeachingRules.of(self._settings, terms)
        learned = {"dataset": self._progress.dataset, **imitation_identity(self._settings)}
        return examples, Teacher(self._out, learned, rules, policy, workers, client, examples, self._display)

    def _load_tensors(self, updater: Updater, tensors: Mapping[str, Any]) -> None:
        updater.optimiser.load_state_dict(tensors["optimiser"])
        self._generator.set_state(tensors["generator"])

    def _prepare(self, workers: DataParallelWorkers) -> None:
        """Run imitation and the first evaluation, and save the reference policy."""
        policy, progress = self._start.policy, self._progress
        oracle, teacher = self._oracle_and_teacher(workers)
        with self._stopwatch.track(Activity.IMITATION):
            run_imitation(
                self._start, workers, self._out, self._recorder, self._display.imitation, oracle, teacher
            )
        self._publish()
        before = self._evaluate(BEFORE, self._settings.evaluation.samples, workers)
        progress.before = before.as_json() if before else []
        with atomic_folder(self._out / REFERENCE) as folder:
            policy.save(folder)
        progress.grpo_ready = True

    def _evaluate(self, label: str, samples: int, workers: DataParallelWorkers) -> HeldOutEvaluation | None:
        start, settings, step = self._start, self._settings, self._progress.step
        tasks = start.evaluated
        if not tasks:
            return None

        def report(done: int, total: int) -> None:
            self._display.evaluating(label, done, total)

        with self._stopwatch.track(Activity.EVALUATION):
            if self._terms is not None:
                result = self._evaluate_in_episodes(self._terms, samples, workers, report)
            else:
                result = evaluate_policy(
                    workers,
                    start.prompt_builder,
                    tasks,
                    self._gateway,
                    settings.evaluation,
                    samples=samples,
                    max_new=settings.grpo.max_new,
                    seed=settings.seed,
                    label=f"{label.replace(' ', '-')}-{step}",
                    report=report,
                    server=self._server,
                )
        self._display.evaluated(label, result)
        self._recorder.evaluation(step, label, result)
        return result

    def _evaluate_in_episodes(
        self,
        terms: EpisodeTerms,
        samples: int,
        workers: DataParallelWorkers,
        report: Callable[[int, int], None],
    ) -> HeldOutEvaluation:
        start, settings, seed = self._start, self._settings.evaluation, self._settings.seed
        self._gateway.announce({0: start.evaluated}, samples)
        planned = [PlannedEpisode(task, evaluation_seed(seed, task.task.task_id)) for task in start.evaluated]
        return evaluate_in_episodes(
            workers,
            start.policy,
            planned,
            EpisodeClient(self._gateway, terms, start.policy.codec),
            SamplingParams(samples, settings.temperature, terms.answer_tokens),
            chunk=settings.chunk,
            seed=seed,
            report=report,
        )

    def _evaluate_if_due(self, done: set[int], workers: DataParallelWorkers) -> None:
        """Evaluate after every so many steps. ``done`` are the steps with an evaluation; a resumed run repeats none."""
        settings, step = self._settings.evaluation, self._progress.step
        if settings.every and step and step % settings.every == 0 and step not in done:
            self._evaluate(DURING, settings.samples_during, workers)
            done.add(step)

    def _optimise(self, updater: Updater, workers: DataParallelWorkers) -> None:
        settings = self._settings.grpo
        progress = self._progress
        tasks, seed = self._start.tasks.train, self._settings.seed
        curriculum = Curriculum(settings.curriculum_tasks, settings.curriculum_start)
        schedule = Schedule(tasks, seed=seed, cursor=progress.cursor, curriculum=curriculum)
        reserve = Schedule(tasks, seed=seed, cursor=progress.reserve_cursor, stream=RESERVE_STREAM)
        evaluated = {each.step for each in read_evaluations(self._out)}
        while (share := self._share()) < 1.0:
            self._evaluate_if_due(evaluated, workers)
            began_s = time.monotonic()
            self._announce(schedule, reserve, progress.step)
            with DeferredInterrupts() as interrupts:
                with self._rollback_on_error():
                    record, logs = updater.take_step(self._plan(schedule, reserve, share), interrupts)
                seconds = time.monotonic() - began_s
                progress.step = record.step
                progress.cursor, progress.reserve_cursor = schedule.cursor, reserve.cursor
                progress.grpo_s += seconds
                self._record(record, logs, seconds)
            progress.grpo_s += self._publish()
            if progress.step % self._settings.checkpoint_every == 0:
                self._save(updater)

    def _publish(self) -> float:
        """Give the new weights to the model server, if one samples. Return the seconds that it took."""
        began_s = time.monotonic()
        if self._server is not None:
            with self._stopwatch.track(Activity.PUBLISHING):
                self._server.publish()
        return time.monotonic() - began_s

    @contextlib.contextmanager
    def _rollback_on_error(self) -> Iterator[None]:
        """Undo the random draws and seconds of an unfinished step, because a resumed run takes it again."""
        before = self._generator.get_state()
        try:
            with self._stopwatch.discard_on_error():
                yield
        except BaseException:
            self._generator.set_state(before)
            raise

    def _plan(self, schedule: Schedule, reserve: Schedule, share: float) -> StepPlan:
        settings = self._settings.grpo
        end = settings.relevance if settings.relevance_final is None else settings.relevance_final
        step = self._progress.step + 1
        return StepPlan(
            step=step,
            tasks=schedule.take(settings.tasks_per_step),
            upcoming=schedule.peek(settings.tasks_per_step),
            reserve=reserve.take(settings.reserve),
            rng=self._rng,
            generator=self._generator,
            order=self._order,
            seed_of=self._seed_of,
            rate_factor=self._rate_factor(step, share),
            relevance=settings.relevance + (end - settings.relevance) * share,
        )

    def _rng(self, step: int) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence((self._settings.seed, 2, step)))

    def _order(self, step: int) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence((self._settings.seed, 4, step)))

    def _seed_of(self, step: int, task_id: str) -> int:
        """Return the seed of a task's rollouts in a step. An epoch has as many draws as there are tasks."""
        settings = self._settings.grpo
        epoch = 0
        if settings.seed_per is SeedPer.EPOCH:
            epoch = (step - 1) * settings.tasks_per_step // len(self._start.tasks.train)
        return training_seed(self._settings.seed, task_id, epoch)

    def _share(self) -> float:
        """Used share of the GRPO budget, at most 1."""
        settings = self._settings.grpo
        if settings.steps is not None:
            return self._progress.step / settings.steps if settings.steps else 1.0
        return min(1.0, self._progress.grpo_s / (60 * settings.minutes)) if settings.minutes else 1.0

    def _rate_factor(self, step: int, share: float) -> float:
        """Factor of the learning rate: linear warm-up, then linear decay over the budget."""
        settings = self._settings.grpo
        rise = min(1.0, step / (settings.warmup_steps + 1))
        return rise * (1.0 - (1.0 - settings.final_learning_rate_share) * share)

    def _announce(self, schedule: Schedule, reserve: Schedule, step: int) -> None:
        """Announce the whole window: this step's tasks, those of the steps ahead, and the reserve."""
        settings = self._settings.grpo
        size = settings.tasks_per_step
        window = {
            step + 1 + ahead: schedule.peek(size, skip=ahead * size)
            for ahead in range(settings.lookahead + 1)
        }
        if settings.reserve and settings.lookahead:
            # A reserve may be needed in this step already, but it ranks behind the certain tasks.
            window[step + 1 + settings.lookahead] += reserve.peek(settings.reserve)
        self._gateway.announce(window, settings.group)

    def _record(self, record: StepRecord, logs: list[GroupLog], seconds: float) -> None:
        self._progress.rollouts += record.rollouts
        self._progress.lost += record.lost
        self._recorder.step(record, seconds, self._stopwatch.spent_s)
        self._reporter.sampled(record.step, logs)
        if record.step % self._settings.samples_every == 1 or self._settings.samples_every == 1:
            self._recorder.samples(record.step, logs[0])
        logger.info(
            "step done step=%d rollouts=%d lost=%d reward=%.3f success=%.3f seconds=%.2f",
            record.step,
            record.rollouts,
            record.lost,
            record.reward,
            record.success,
            seconds,
        )
        self._display.stepped(record, self._share(), record.rollouts / max(seconds, 1e-9))

    def _save(self, updater: Updater) -> Path:
        with self._stopwatch.track(Activity.SAVING):
            self._progress.spent_s = dict(self._stopwatch.spent_s)
            tensors = {
                "optimiser": updater.optimiser.state_dict(),
                "generator": self._generator.get_state(),
            }
            return self._store.save(self._start.policy, tensors, self._progress, self._settings)

    def _summary(self, checkpoint: Path, after: HeldOutEvaluation | None, wall_s: float) -> TrainingSummary:
        progress = self._progress
        before = HeldOutEvaluation.from_json(progress.before) if progress.before else None
        outcome = RunOutcome(
            model=self._start.policy.name,
            steps=progress.step,
            rollouts=progress.rollouts,
            lost=progress.lost,
            imitation_steps=progress.imitation.step,
            wall_s=wall_s,
            grpo_s=progress.grpo_s,
            spent_s=dict(self._stopwatch.spent_s),
            before=rates_of(before),
            after=rates_of(after),
            peak_mb=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,  # Linux counts in kB
        )
        stats = self._gateway.close_run()
        return TrainingSummary(outcome, before, after, stats, checkpoint, self._out / REPORT)

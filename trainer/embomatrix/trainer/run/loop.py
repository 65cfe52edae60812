"""A training run from end to end: imitation, held-out evaluation, GRPO, held-out evaluation, report."""

from __future__ import annotations

import contextlib
import functools
import logging
import platform
import resource
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from embomatrix.host.cores import usable_cores
from embomatrix.trainer.data.tasks import Curriculum, Schedule
from embomatrix.trainer.evaluation.held_out import HeldOutEvaluation, evaluate_policy
from embomatrix.trainer.grpo.data_parallel import Crew
from embomatrix.trainer.grpo.learner import Learner
from embomatrix.trainer.grpo.update import StepPlan, Updater
from embomatrix.trainer.lifecycle.checkpoint import (
    CHECKPOINTS,
    CheckpointStore,
    TrainingProgress,
    restore,
    whole_folder,
)
from embomatrix.trainer.lifecycle.interrupts import Interrupts
from embomatrix.trainer.lifecycle.stopwatch import Activity, Stopwatch
from embomatrix.trainer.logging.dashboard import Reporter
from embomatrix.trainer.logging.outcome import write_outcome
from embomatrix.trainer.logging.recorder import METRICS, SAMPLES, Recorder, read_metrics
from embomatrix.trainer.logging.report import REPORT, TrainingSummary, outcome_of, write_report
from embomatrix.trainer.run.imitation import warm_up

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path
    from typing import Any

    from embomatrix.trainer.cluster.gateway import Gateway
    from embomatrix.trainer.config.settings import TrainSettings
    from embomatrix.trainer.data.tasks import TaskSet
    from embomatrix.trainer.grpo.records import GroupLog, StepRecord
    from embomatrix.trainer.logging.display import Display
    from embomatrix.trainer.logging.trackers import Tracker
    from embomatrix.trainer.policy.prompts import Teller
    from embomatrix.trainer.policy.protocol import Policy

logger = logging.getLogger(__name__)
REFERENCE = "reference"
RESERVE_STREAM = 1


@dataclass(frozen=True)
class Parts:
    """What a run works with. ``reference`` is given on resuming; otherwise the policy after imitation is copied."""

    policy: Policy
    teller: Teller
    tasks: TaskSet
    gateway: Gateway
    display: Display
    reference: Policy | None = None


class TrainingRun:
    """One run in one folder. ``progress`` is a checkpoint's when the run is resumed."""

    def __init__(
        self,
        parts: Parts,
        settings: TrainSettings,
        out: Path,
        progress: TrainingProgress | None = None,
        trackers: Sequence[Tracker] = (),
    ) -> None:
        self._parts = parts
        self._settings = settings
        self._out = out
        self._progress = progress or TrainingProgress()
        self._restores = self._progress.prepared
        self._stopwatch = Stopwatch()
        self._stopwatch.spent_s.update(self._progress.spent_s)
        self._store = CheckpointStore(out / CHECKPOINTS, keep=settings.keep_checkpoints)
        self._reporter = Reporter(parts.gateway.report)
        self._recorder = Recorder(out, (*trackers, self._reporter))
        device = next(iter(parts.policy.parameters())).device
        self._generator = torch.Generator(device).manual_seed(settings.seed)

    def run(self) -> TrainingSummary:
        """Everything. An interrupt saves a checkpoint, from which ``--resume`` goes on, and is raised again."""
        began_s = time.monotonic()
        earlier_s = sum(self._progress.spent_s.values())
        reference = self._parts.reference or self._prepare()
        checkpoint = self._improve(reference)
        after = self._evaluate("after GRPO")
        summary = self._summary(checkpoint, after, earlier_s + time.monotonic() - began_s)
        write_report(summary, read_metrics(self._out), machine())
        write_outcome(self._out, outcome_of(summary))
        return summary

    def _improve(self, reference: Policy) -> Path:
        """GRPO, in as many processes as are wanted; returns its last checkpoint."""
        parts, settings = self._parts, self._settings
        own = Learner(parts.policy, reference, settings.grpo)
        with Crew.of(own, parts.policy, settings, self._out / REFERENCE) as crew:
            updater = Updater(parts.policy, crew, parts.teller, parts.gateway, settings.grpo, self._stopwatch)
            newest = self._store.latest() if self._restores else None
            if newest is not None:
                restore(newest, functools.partial(self._put_back, updater))
            self._recorder.forget_after(self._progress.step, METRICS, SAMPLES)
            try:
                self._optimise(updater)
            finally:
                checkpoint = self._save(updater)
        return checkpoint

    def _put_back(self, updater: Updater, tensors: Mapping[str, Any]) -> None:
        updater.optimiser.load_state_dict(tensors["optimiser"])
        self._generator.set_state(tensors["generator"])

    def _prepare(self) -> Policy:
        """Imitation and the first evaluation; the policy as it then is becomes the reference."""
        parts, progress = self._parts, self._progress
        with self._stopwatch.spending(Activity.IMITATION):
            warm_up(
                parts.policy,
                parts.teller,
                parts.tasks.train,
                self._settings,
                self._out,
                progress,
                self._recorder,
                parts.display.imitation,
            )
        before = self._evaluate("before GRPO")
        progress.before = before.as_json() if before else []
        with whole_folder(self._out / REFERENCE) as folder:
            parts.policy.save(folder)
        progress.prepared = True
        return parts.policy.frozen_copy()

    def _evaluate(self, label: str) -> HeldOutEvaluation | None:
        parts, settings = self._parts, self._settings
        if not parts.tasks.heldout:
            return None
        with self._stopwatch.spending(Activity.EVALUATION):
            result = evaluate_policy(
                parts.policy,
                parts.teller,
                parts.tasks.heldout,
                parts.gateway,
                settings.evaluation,
                max_new=settings.grpo.max_new,
                seed=settings.seed,
                label=label.replace(" ", "-"),
                report=lambda done, total: parts.display.evaluating(label, done, total),
            )
        parts.display.evaluated(label, result)
        self._recorder.evaluation(label, result)
        return result

    def _optimise(self, updater: Updater) -> None:
        settings = self._settings.grpo
        progress = self._progress
        tasks, seed = self._parts.tasks.train, self._settings.seed
        curriculum = Curriculum(settings.curriculum_tasks, settings.curriculum_start)
        schedule = Schedule(tasks, seed=seed, cursor=progress.cursor, curriculum=curriculum)
        reserve = Schedule(tasks, seed=seed, cursor=progress.reserve_cursor, stream=RESERVE_STREAM)
        while (share := self._share()) < 1.0:
            began_s = time.monotonic()
            self._announce(schedule, reserve, progress.step)
            with Interrupts() as interrupts:
                with self._whole_step():
                    record, logs = updater.take_step(self._plan(schedule, reserve, share), interrupts)
                seconds = time.monotonic() - began_s
                progress.step = record.step
                progress.cursor, progress.reserve_cursor = schedule.cursor, reserve.cursor
                progress.grpo_s += seconds
                self._note(record, logs, seconds)
            if progress.step % self._settings.checkpoint_every == 0:
                self._save(updater)

    @contextlib.contextmanager
    def _whole_step(self) -> Iterator[None]:
        """A step that is broken off is taken again after a resume: it leaves neither draws nor seconds behind."""
        drawn = self._generator.get_state()
        try:
            with self._stopwatch.whole():
                yield
        except BaseException:
            self._generator.set_state(drawn)
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
            rate_factor=self._rate_factor(step, share),
            relevance=settings.relevance + (end - settings.relevance) * share,
        )

    def _rng(self, step: int) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence((self._settings.seed, 2, step)))

    def _share(self) -> float:
        """Share of the GRPO budget that is spent; the last step may end after the minutes do."""
        settings = self._settings.grpo
        if settings.steps is not None:
            return self._progress.step / settings.steps if settings.steps else 1.0
        return min(1.0, self._progress.grpo_s / (60 * settings.minutes)) if settings.minutes else 1.0

    def _rate_factor(self, step: int, share: float) -> float:
        """Of the learning rate: a linear rise over the warm-up, then a linear fall with the budget."""
        settings = self._settings.grpo
        rise = min(1.0, step / (settings.warmup_steps + 1))
        return rise * (1.0 - (1.0 - settings.final_learning_rate_share) * share)

    def _announce(self, schedule: Schedule, reserve: Schedule, step: int) -> None:
        """This step's tasks and those of the steps ahead, then what may replace some: the whole window, every time."""
        settings = self._settings.grpo
        size = settings.tasks_per_step
        window = {
            step + 1 + ahead: schedule.peek(size, skip=ahead * size)
            for ahead in range(settings.lookahead + 1)
        }
        if settings.reserve and settings.lookahead:
            # Needed in this step, if at all: behind what is certain.
            window[step + 1 + settings.lookahead] += reserve.peek(settings.reserve)
        self._parts.gateway.announce(window, settings.group)

    def _note(self, record: StepRecord, logs: list[GroupLog], seconds: float) -> None:
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
        self._parts.display.stepped(record, self._share(), record.rollouts / max(seconds, 1e-9))

    def _save(self, updater: Updater) -> Path:
        with self._stopwatch.spending(Activity.SAVING):
            self._progress.spent_s = dict(self._stopwatch.spent_s)
            tensors = {
                "optimiser": updater.optimiser.state_dict(),
                "generator": self._generator.get_state(),
            }
            return self._store.save(self._parts.policy, tensors, self._progress, self._settings)

    def _summary(self, checkpoint: Path, after: HeldOutEvaluation | None, wall_s: float) -> TrainingSummary:
        progress = self._progress
        return TrainingSummary(
            model=self._parts.policy.name,
            steps=progress.step,
            rollouts=progress.rollouts,
            lost=progress.lost,
            imitation_steps=progress.imitation.step,
            wall_s=wall_s,
            grpo_s=progress.grpo_s,
            spent_s=dict(self._stopwatch.spent_s),
            before=HeldOutEvaluation.from_json(progress.before) if progress.before else None,
            after=after,
            stats=self._parts.gateway.close_run(),
            checkpoint=checkpoint,
            report=self._out / REPORT,
            peak_mb=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,  # Linux counts in kB
        )


def machine() -> str:
    """The machine in words, for reports."""
    return f"{usable_cores()} cores, {platform.machine()}, Python {platform.python_version()}, torch {torch.__version__}"

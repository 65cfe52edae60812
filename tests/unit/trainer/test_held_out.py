"""Progress of an evaluation on held-out tasks, without a cluster."""

from concurrent.futures import Future

from tests.fakes.symbolic_household import make_tasks

from embomatrix.reward.breakdown import RewardBreakdown
from embomatrix.trainer.cluster.gateway import PlanOutcome
from embomatrix.trainer.config.settings import EvaluationSettings, GrpoSettings
from embomatrix.trainer.data.variation import Variation
from embomatrix.trainer.evaluation.held_out import evaluate_policy
from embomatrix.trainer.learning.data_parallel import DataParallelWorkers
from embomatrix.trainer.learning.learner import Learner
from embomatrix.trainer.policy.decoder import DecoderShape
from embomatrix.trainer.policy.prompts import PromptBuilder
from embomatrix.trainer.policy.tiny import TinyPolicy
from embomatrix.trainer.policy.vocabulary import build_vocabulary

TASKS = make_tasks(2, 4, objects=8)
WORDS = build_vocabulary(
    [task.situation for task in TASKS.train], [task.task.instruction for task in TASKS.train]
)
SHAPE = DecoderShape(len(WORDS), layers=1, width=16, heads=2, inner=32)
NO_REWARD = RewardBreakdown(format=0.0, relevance=0.0, goal=0.0, atoms=(), success=False)


class ExecutingGateway:
    """Gateway that notes its submissions and executes a batch when the batch that is ``behind`` later arrives."""

    def __init__(self, noted, behind):
        self.noted = noted
        self.behind = behind
        self.waiting = []

    def announce(self, steps, samples):
        self.expected = sum(map(len, steps.values()))

    def submit(self, batch_id, step, groups, codec):
        self.noted.append("submitted")
        futures = [Future() for _ in groups]
        self.waiting += zip(futures, groups, strict=True)
        self.expected -= len(groups)
        ready = len(self.waiting) - (self.behind if self.expected else 0)
        for future, group in self.waiting[:ready]:
            future.set_result(tuple(PlanOutcome(text, NO_REWARD) for text in group.texts))
        self.waiting = self.waiting[ready:]
        return futures


def noted_while_evaluating(behind):
    noted = []
    policy = TinyPolicy(WORDS, SHAPE, seed=0)
    result = evaluate_policy(
        DataParallelWorkers(Learner(policy, None, GrpoSettings())),
        PromptBuilder(policy, 16, Variation(TASKS.kinds, 0.0, 0.0)),
        TASKS.heldout,
        ExecutingGateway(noted, behind),
        EvaluationSettings(chunk=1),
        samples=2,
        max_new=6,
        seed=0,
        label="before-0",
        report=lambda done, total: noted.append(done),
    )
    assert [score.task_id for score in result.scores] == [task.task.task_id for task in TASKS.heldout]
    return noted


def test_executed_tasks_are_reported_while_later_tasks_are_sampled():
    sampled = "submitted"
    assert noted_while_evaluating(behind=0) == [0, sampled, 1, sampled, 2, sampled, 3, sampled, 4]
    assert noted_while_evaluating(behind=1) == [0, sampled, sampled, 1, sampled, 2, sampled, 3, 4]


def test_each_number_of_tasks_is_reported_once():
    assert [each for each in noted_while_evaluating(behind=3) if each != "submitted"] == [0, 1, 2, 3, 4]

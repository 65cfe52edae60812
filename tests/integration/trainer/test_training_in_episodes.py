"""Training call by call, on a real cluster."""

import asyncio
import json
import shutil
from collections import Counter
from dataclasses import replace

import pytest
import torch
from rich.console import Console
from tests.fakes.datasets import write_kitchen_dataset
from tests.fakes.small_llama import save_small_llama

from embomatrix.envs.rules import EpisodeEnd, EpisodeReward
from embomatrix.reward.hierarchy import unparsable
from embomatrix.reward.settings import PAPER
from embomatrix.rpc.episodes import TurnFailedError
from embomatrix.rpc.status import DeadlineError
from embomatrix.rpc.wire.values import InfraCode, InfraFailure
from embomatrix.skills.parse import DONE, parse_plan
from embomatrix.trainer.cluster.gateway import Gateway
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.config.settings import TrainSettings, read_settings
from embomatrix.trainer.data.tasks import load_tasks
from embomatrix.trainer.episodes import teacher
from embomatrix.trainer.episodes.client import ClusterEpisode
from embomatrix.trainer.episodes.oracle import ORACLE_EPISODES
from embomatrix.trainer.episodes.teacher import TAUGHT_EPISODES, Teacher, TeachingRules
from embomatrix.trainer.grpo.step_advantages import AnswerStates
from embomatrix.trainer.lifecycle.checkpoint import CHECKPOINTS, CheckpointStore, TrainingProgress, read_state
from embomatrix.trainer.lifecycle.stopwatch import Activity
from embomatrix.trainer.logging.display import LineDisplay
from embomatrix.trainer.logging.evaluations import read_evaluations
from embomatrix.trainer.logging.outcome import read_outcome
from embomatrix.trainer.logging.recorder import read_metrics
from embomatrix.trainer.policy.loading import new_policy, saved_policy
from embomatrix.trainer.policy.playing import plays_episodes
from embomatrix.trainer.run.loop import TrainingRun
from embomatrix.trainer.run.starting import RunStart

pytestmark = pytest.mark.timeout(300)
SETTINGS = {
    "tiny.layers": 1,
    "tiny.width": 32,
    "tiny.heads": 2,
    "tiny.inner": 32,
    "episodes.visibility": "seen",
    "episodes.calls_more": 2,
    "imitation.steps": 12,
    "imitation.batch": 4,
    "grpo.steps": 3,
    "grpo.tasks_per_step": 3,
    "grpo.group": 3,
    "grpo.chunk": 1,
    "grpo.kl_coef": 0.05,
    "grpo.zero_variance": "keep",
    "evaluation.samples": 2,
    "samples_every": 1,
    "checkpoint_every": 1,
}
TIMES = ("seconds", "spent_s")


@pytest.fixture(scope="module")
def tasks(tmp_path_factory):
    return load_tasks(write_kitchen_dataset(tmp_path_factory.mktemp("dataset")))


def train(cluster, tasks, out, *, resume=False, **changes):
    """Run a training in ``out``, which it continues from its newest checkpoint with ``resume``. Return its policy."""
    given = {name.replace("__", "."): value for name, value in changes.items()}
    settings = read_settings(None, {**SETTINGS, **given})
    progress = TrainingProgress()
    if resume:
        newest = CheckpointStore(out / CHECKPOINTS, keep=9).latest()
        progress, settings = read_state(newest)
        policy = saved_policy(newest / "policy", settings)
        is_there = (out / "reference").exists()
        reference = saved_policy(out / "reference", settings).frozen_copy() if is_there else None
    else:
        policy, reference = new_policy(settings, tasks), None
    display = LineDisplay(Console(quiet=True))
    out.mkdir(exist_ok=True)
    with Gateway(cluster.client, tasks.bundle_bytes, run_name="episodes") as gateway, display:
        TrainingRun(RunStart(settings, tasks, policy, progress, reference), gateway, display, out).run()
    return policy


def figures(out):
    return [{key: value for key, value in row.items() if key not in TIMES} for row in read_metrics(out)]


def weights(policy):
    return torch.cat([parameter.detach().flatten() for parameter in policy.parameters()])


def test_equal_runs_have_equal_episodes_and_weights_in_any_number_of_processes(cluster, tasks, tmp_path):
    first = train(cluster, tasks, tmp_path / "one")
    second = train(cluster, tasks, tmp_path / "two", processes=2)
    assert torch.equal(weights(first), weights(second))
    assert figures(tmp_path / "one") == figures(tmp_path / "two")
    for row in figures(tmp_path / "one"):
        assert (row["rollouts"], row["lost"]) == (9, 0)
        assert abs(row["kl_to_old"]) < 1e-6  # what was sampled is what is trained on


def test_resumed_run_equals_an_uninterrupted_one(cluster, tasks, tmp_path):
    whole = train(cluster, tasks, tmp_path / "whole")
    train(cluster, tasks, tmp_path / "halves", keep_checkpoints=9)
    for step in (2, 3):  # as if the run had been killed after its first step
        folder = tmp_path / "halves" / CHECKPOINTS / f"step-{step:06d}"
        for path in sorted(folder.rglob("*"), reverse=True):
            path.unlink() if path.is_file() else path.rmdir()
        folder.rmdir()
    resumed = train(cluster, tasks, tmp_path / "halves", resume=True)
    assert torch.equal(weights(whole), weights(resumed))
    assert figures(tmp_path / "whole") == figures(tmp_path / "halves")


def test_imitation_of_the_oracle_s_episodes_solves_the_training_tasks(cluster, tasks, tmp_path):
    known = replace(tasks, heldout=tasks.train)
    changes = {"imitation__steps": 150, "grpo__steps": 0, "evaluation__temperature": 0.0, "tiny__width": 64}
    train(cluster, known, tmp_path / "run", **changes)
    episodes = json.loads((tmp_path / "run" / ORACLE_EPISODES).read_text())["episodes"]
    assert set(episodes) == {task.task.task_id for task in tasks.train}
    assert all(turns[-1][0] == DONE for _, _, _, *turns in episodes.values())
    spent = read_outcome(tmp_path / "run").spent_s
    assert spent[Activity.ORACLE] > 0  # not counted as imitation, whose time `bench first-hour` compares
    assert spent[Activity.IMITATION] > 0
    evaluation = read_evaluations(tmp_path / "run")[-1]
    assert all(answer.verdict.success for answer in evaluation.answers)
    assert json.loads(evaluation.answers[0].text)[-1] == DONE


def test_costs_of_calls_are_subtracted_from_the_reward(cluster, tasks, tmp_path):
    train(cluster, tasks, tmp_path / "free", grpo__steps=1)
    train(cluster, tasks, tmp_path / "dear", grpo__steps=1, episodes__call_cost=0.25)
    (free,), (dear,) = figures(tmp_path / "free"), figures(tmp_path / "dear")
    assert dear["plan_steps"] == free["plan_steps"] > 0
    calls = free["plan_steps"] * free["well_formed"]  # without those that answer nothing
    expected = free["reward"] - 0.25 * calls
    assert dear["reward"] == pytest.approx(expected)


@pytest.mark.parametrize("kind", ["word-level policy", "language model"])
def test_each_answer_has_its_step_advantage(cluster, tasks, tmp_path, monkeypatch, kind):
    changes = {"grpo__steps": 2, "evaluation__samples": 1, "episodes__step_weight": 1.0}
    if kind == "language model":
        save_small_llama(tasks.train, tmp_path / "model")
        changes |= {"model": str(tmp_path / "model"), "codec": "lines", "episodes__answer_tokens": 6}
        # Its random words change no reward, but failures cost something.
        changes["episodes__failure_cost"] = 0.25
    compared = []
    token_advantages = AnswerStates.token_advantages

    def recorded(states, rewards, advantages, mask, floor):
        runs = (mask & ~torch.nn.functional.pad(mask, (1, 0))[:, :-1]).sum(dim=1)
        assert runs.tolist() == [len(answers) for answers in states.states]
        values = token_advantages(states, rewards, advantages, mask, floor)
        compared.append(states.step_advantages(rewards, floor))
        assert not values[~mask].any()
        return values

    monkeypatch.setattr(AnswerStates, "token_advantages", recorded)
    first = train(cluster, tasks, tmp_path / "one", **changes)
    assert len(compared) == 2 * 3  # steps x tasks
    assert any(values.any() for values in compared)
    second = train(cluster, tasks, tmp_path / "two", processes=2, **changes)
    assert torch.equal(weights(first), weights(second))
    assert not torch.equal(
        weights(first),
        weights(train(cluster, tasks, tmp_path / "plain", **{**changes, "episodes__step_weight": 0.0})),
    )


def test_dashboard_gets_episodes_turn_by_turn(cluster, tasks, tmp_path, monkeypatch):
    reports = []
    monkeypatch.setattr(Gateway, "report", lambda _, report: reports.append(report))
    train(cluster, tasks, tmp_path / "run", grpo__steps=1)
    plans = [plan for report in reports for plan in report.plans]
    assert plans
    for plan in plans:
        assert plan.opening.startswith("rooms ")
        assert plan.end in {*EpisodeEnd}
        assert "\n".join(turn.answer for turn in plan.turns) == plan.text
        assert sum(turn.steps for turn in plan.turns) == len(plan.steps)
        assert all("robot " in turn.observation for turn in plan.turns)
        assert [parse_plan(step.call)[0].skill.value for step in plan.steps] == [
            step.skill for step in plan.steps
        ]


@pytest.mark.parametrize(
    ("error", "lost"),
    [
        (
            TurnFailedError("three attempts failed", InfraFailure(InfraCode.SLOT_CRASHED, "it crashed")),
            "slot_crashed: it crashed",
        ),
        (DeadlineError("no result within 120 s"), "deadline: no result within 120 s"),
    ],
)
def test_a_turn_without_a_result_loses_the_episode_and_not_the_run(error, lost):
    class Player:
        end = None
        state = "start"
        steps = ()
        reward = EpisodeReward(unparsable(PAPER))

        async def answer(self, text):
            raise error

    episode = ClusterEpisode(Player())
    assert asyncio.run(episode.answer("move 1")) == ""
    assert episode.is_over
    outcome = episode.outcome()
    assert (outcome.text, outcome.reward, outcome.lost) == ("move 1", None, lost)


def test_episodes_of_the_oracle_are_played_again_if_the_run_is_another(cluster, tasks, tmp_path):
    changes = {"imitation__steps": 1, "grpo__steps": 0, "evaluation__samples": 1}
    train(cluster, tasks, tmp_path / "run", **changes)
    path = tmp_path / "run" / ORACLE_EPISODES
    seen = path.read_text()
    path.write_text(seen.replace("pick_up", "open"))
    kept = path.read_text()
    train(cluster, tasks, tmp_path / "run", **changes)
    assert path.read_text() == kept
    train(cluster, tasks, tmp_path / "run", episodes__visibility="full", **changes)
    told = json.loads(path.read_text())
    assert told["version"]["visibility"] == "full"
    assert "pick_up" in path.read_text()


TAUGHT = {"episodes__teacher_rounds": 2, "episodes__teacher_episodes": 4, "grpo__steps": 1}


def taught(out, number):
    return json.loads((out / TAUGHT_EPISODES.format(number)).read_text())


def test_oracle_finishes_what_the_policy_began_and_that_is_imitated(cluster, tasks, tmp_path, monkeypatch):
    monkeypatch.setattr(teacher, "_BATCH_EPISODES", 2)
    first = train(cluster, tasks, tmp_path / "one", **TAUGHT)
    second = train(cluster, tasks, tmp_path / "two", processes=2, **TAUGHT)
    untaught = train(cluster, tasks, tmp_path / "alone", grpo__steps=1)
    assert torch.equal(weights(first), weights(second))
    assert not torch.equal(weights(first), weights(untaught))
    for number in (1, 2):
        kept = taught(tmp_path / "one", number)
        assert kept == taught(tmp_path / "two", number)
        assert kept["version"]["round"] == number
        episodes = kept["episodes"].values()
        assert len(episodes) == min(4, len(tasks.train))  # whatever an untrained policy did before
        assert any(begun for _, _, begun, *_ in episodes)
        assert all(begun < len(turns) and turns[-1][0] == DONE for _, _, begun, *turns in episodes)
    assert taught(tmp_path / "one", 1)["episodes"] != taught(tmp_path / "one", 2)["episodes"]


def test_run_that_was_interrupted_in_a_round_of_teaching_goes_on_to_the_same_end(
    cluster, tasks, tmp_path, monkeypatch
):
    whole = train(cluster, tasks, tmp_path / "whole", **TAUGHT)

    def interrupted(self, number, planned):
        if number == 2:
            raise KeyboardInterrupt
        return play(self, number, planned)

    play = Teacher._play
    with monkeypatch.context() as patch:
        patch.setattr(Teacher, "_play", interrupted)
        with pytest.raises(KeyboardInterrupt):
            train(cluster, tasks, tmp_path / "halves", **TAUGHT)
    assert not (tmp_path / "halves" / TAUGHT_EPISODES.format(2)).exists()
    resumed = train(cluster, tasks, tmp_path / "halves", resume=True)
    assert torch.equal(weights(whole), weights(resumed))


def test_run_that_was_killed_after_a_round_goes_on_with_the_kept_episodes(
    cluster, tasks, tmp_path, monkeypatch
):
    whole = train(cluster, tasks, tmp_path / "whole", **TAUGHT)
    before = taught(tmp_path / "whole", 1)
    shutil.copytree(tmp_path / "whole", tmp_path / "killed")
    shutil.rmtree(tmp_path / "killed" / CHECKPOINTS)
    played = []
    play = Teacher._play
    monkeypatch.setattr(
        Teacher, "_play", lambda self, number, planned: played.append(number) or play(self, number, planned)
    )
    again = train(cluster, tasks, tmp_path / "killed", **TAUGHT)
    assert (played, taught(tmp_path / "killed", 1)) == ([], before)
    assert torch.equal(weights(whole), weights(again))
    train(cluster, tasks, tmp_path / "killed", tiny__inner=16, **TAUGHT)  # another policy
    assert played == [1, 2]


@pytest.mark.parametrize("times", [1, 2])
def test_episode_that_is_lost_while_the_oracle_finishes_it_is_begun_again(
    cluster, tasks, tmp_path, monkeypatch, times
):
    train(cluster, tasks, tmp_path / "sound", **TAUGHT)
    advise, asked = ClusterEpisode.advise, Counter()

    async def lost_at_first(self):
        name = self.player._running.start.task_id
        asked[name] += 1
        if asked[name] <= times:
            self.lost = InfraFailure(InfraCode.VERSION_SKEW, "w1 does not know the oracle's advice")
            return None
        return await advise(self)

    monkeypatch.setattr(ClusterEpisode, "advise", lost_at_first)
    if times == 1:
        train(cluster, tasks, tmp_path / "repaired", **TAUGHT)
        assert taught(tmp_path / "repaired", 1) == taught(tmp_path / "sound", 1)
    else:
        with pytest.raises(TrainerError, match=r"round 1 .* was lost \(version_skew: w1 does not know"):
            train(cluster, tasks, tmp_path / "lost", **TAUGHT)
        assert not (tmp_path / "lost" / TAUGHT_EPISODES.format(1)).exists()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"imitation.steps": 2}, "fewer than the 2 steps of imitation"),
        ({"imitation.steps": 0}, "fewer than the 0 steps"),
        ({"imitation.seconds": 0}, "expected 0 without imitation"),
        ({"imitation.patience": 3}, "expected imitation.patience = 0"),
        ({"episodes.visibility": None}, "set episodes.visibility"),
    ],
)
def test_rounds_that_teach_nothing_are_refused(changes, words):
    asked = {"episodes.visibility": "seen", "episodes.teacher_rounds": 2}
    with pytest.raises(TrainerError, match=words):
        read_settings(None, {**asked, **changes})


def test_rounds_divide_imitation_into_equal_parts():
    settings = read_settings(None, {"episodes.visibility": "seen", "episodes.teacher_rounds": 3})
    rules = TeachingRules.of(settings, None)
    steps = 12
    due = [rules.due(step / steps) for step in range(steps)]
    assert due == [0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3]
    assert TeachingRules.of(read_settings(None, {}), None).due(0.9) == 0


def test_without_imitation_the_oracle_plays_nothing(cluster, tasks, tmp_path):
    train(cluster, tasks, tmp_path / "run", imitation__steps=0, grpo__steps=0, evaluation__samples=1)
    assert not (tmp_path / "run" / ORACLE_EPISODES).exists()


def test_language_model_learns_in_episodes(cluster, tasks, tmp_path):
    save_small_llama(tasks.train, tmp_path / "model")
    changes = {
        "model": str(tmp_path / "model"),
        "codec": "lines",
        "episodes__answer_tokens": 6,
        "episodes__teacher_rounds": 1,
        "episodes__teacher_episodes": 2,
        "imitation__steps": 3,
        "grpo__steps": 2,
        "evaluation__samples": 1,
        "evaluation__tasks": 2,
    }
    first = train(cluster, tasks, tmp_path / "one", **changes)
    second = train(cluster, tasks, tmp_path / "two", **changes)
    assert torch.equal(weights(first), weights(second))
    assert not torch.equal(weights(first), weights(saved_policy(tmp_path / "model", TrainSettings())))
    for row in figures(tmp_path / "one"):
        assert (row["rollouts"], row["lost"]) == (9, 0)
        assert abs(row["kl_to_old"]) < 1e-5  # what was sampled is what is trained on
    opening = json.loads((tmp_path / "one" / ORACLE_EPISODES).read_text())
    assert "You control a home robot step by step" in opening["systems"][0]
    (_, _, begun, *turns), *_ = opening["episodes"].values()
    assert (begun, turns[-1][0]) == (0, DONE)
    assert len(taught(tmp_path / "one", 1)["episodes"]) == 2
    kept = saved_policy(tmp_path / "one" / "reference", TrainSettings(model=str(tmp_path / "model")))
    assert plays_episodes(kept)


def test_language_model_in_episodes_needs_no_model_server():
    asked = {"model": "some/model", "episodes.visibility": "seen", "sampler.url": "http://127.0.0.1:1"}
    with pytest.raises(TrainerError, match=r"'sampler\.url': expected none in episodes"):
        read_settings(None, asked)

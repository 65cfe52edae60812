"""Episodes without a cluster: rewards equal those of whole plans, and observations reveal no goal."""

import pytest
from tests.fakes.datasets import write_kitchen_dataset
from tests.fakes.documents import snippets

from embomatrix.envs.episode import SCENES_KEPT, Household
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.parse import plan_from_json
from embomatrix.skills.syntax import MAX_STEPS, Skill, SkillCall
from embomatrix.world.dataset import DatasetError


@pytest.fixture(scope="module")
def household(tmp_path_factory):
    with Household(write_kitchen_dataset(tmp_path_factory.mktemp("dataset"))) as opened:
        yield opened


def oracle(record):
    return plan_from_json(list(record.oracle), record.task.profile)


def test_gains_of_an_episode_add_up_to_the_reward_of_its_plan(household):
    for record in household.records:
        episode = household.episode(record.task.task_id)
        trace, whole = episode.run(oracle(record), seed=3)
        episode.reset(seed=3)
        turns = [episode.act(call) for call in oracle(record)]
        assert [turn.step for turn in turns] == list(trace.steps)
        assert turns[-1].reward == whole
        assert sum(turn.gain for turn in turns) == pytest.approx(whole.total)
        assert whole.success


def test_failed_call_changes_nothing_and_the_episode_continues(household):
    record = household.records[0]
    episode = household.episode(record.task.task_id)
    before = episode.state()
    failed = episode.act(SkillCall(Skill.MOVE, object_index=59))
    assert failed.step.failure is FailureReason.UNKNOWN_INDEX
    assert episode.state() == before
    turns = [episode.act(call) for call in oracle(record)]
    assert turns[-1].reward.success


def test_state_lists_every_object_of_the_table_in_order(household):
    episode = household.episode(household.records[0].task.task_id)
    lines = episode.state()
    assert len(lines) == len(episode.task.table)
    assert all(name in line for name, line in zip(episode.task.table, lines, strict=True))


def test_episode_ends_at_the_longest_plan(household):
    episode = household.episode(household.records[0].task.task_id)
    turns = [episode.act(SkillCall(Skill.MOVE, object_index=59)) for _ in range(MAX_STEPS)]
    assert [turn.over for turn in turns] == [False] * (MAX_STEPS - 1) + [True]


def test_unknown_task_raises_a_dataset_error(household):
    with pytest.raises(DatasetError, match="no task 'elsewhere'"):
        household.episode("elsewhere")


class Closing:
    """Fake simulator that executes nothing and records that it was closed."""

    def __init__(self, bundle):
        self.open = True

    def reset(self, task, seed):
        assert self.open

    def close(self):
        self.open = False


def test_few_scenes_are_kept_and_all_are_closed(tmp_path):
    from tests.fakes.datasets import write_flats_dataset

    made = []

    def simulate(bundle):
        made.append(Closing(bundle))
        return made[-1]

    folder = write_flats_dataset(tmp_path, SCENES_KEPT + 2, {"tidy_up": "move fridge_1"})
    digests = {}
    with Household(folder, simulate=simulate) as household:
        for record in household.records:
            digests[record.task.scene_id] = record.bundle_digest
            household._scene(record.bundle_digest)
            assert sum(one.open for one in made) <= SCENES_KEPT
        household._scene(record.bundle_digest)
        assert len(made) == len(digests) == SCENES_KEPT + 2
    assert not any(one.open for one in made)


def test_docs_example_runs(household, capsys):
    (example,) = snippets("adapters.md", "Plain Python", "python")
    folder = household._dataset.folder
    exec(compile(example.replace("build/dataset", str(folder)), "adapters.md", "exec"), {})
    assert "Task: " in capsys.readouterr().out

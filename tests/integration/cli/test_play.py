"""`embomatrix play` with valid, failing and unparsable plans."""

import importlib.util
import json

import av
import pytest
import typer
from PIL import Image
from tests.fakes.scenes import kitchen_scene, kitchen_tasks
from typer.testing import CliRunner

from embomatrix.cli.play import play
from embomatrix.starter.shipped import unpack
from embomatrix.trainer.config.settings import read_settings
from embomatrix.trainer.data.tasks import load_tasks
from embomatrix.trainer.lifecycle.checkpoint import CHECKPOINTS, CheckpointStore, TrainingProgress
from embomatrix.trainer.policy.loading import new_policy
from embomatrix.world.bundle import Bundle, encode_bundle
from embomatrix.world.dataset import TaskRecord, write_dataset
from embomatrix.world.inflation import bundle_digest

GOOD = [
    {"action": "move", "object_index": 10},
    {"action": "pick_up", "object_index": 10},
    {"action": "move", "object_index": 0},
    {"action": "place", "object_index": 0, "relation": "ontop"},
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    scene = kitchen_scene()
    tasks = {task.task_id: task for task in kitchen_tasks(scene)}
    bundle = encode_bundle(Bundle(scene, tasks))
    digest = bundle_digest(bundle)
    root = tmp_path_factory.mktemp("dataset")
    records = [TaskRecord(task, digest, "train", (), ("kitchen_0",), "x") for task in tasks.values()]
    write_dataset(root, records, {digest: bundle})
    return root


@pytest.fixture
def run(folder):
    app = typer.Typer()
    app.command()(play)

    def call(*arguments, text=None, env=None):
        values = {"COLUMNS": "160", "EMBOMATRIX_DATASET": str(folder), **(env or {})}
        return CliRunner().invoke(app, arguments, input=text, env=values)

    return call


def test_successful_plan_is_shown_with_steps_and_reward(run, tmp_path):
    plan = tmp_path / "plan.json"
    plan.write_text(json.dumps(GOOD))
    result = run("apple_to_counter", "--plan", str(plan))
    assert result.exit_code == 0
    assert "put apple_1 on top of countertop_1" in result.output
    assert "✓ (ontop apple_1 countertop_1)" in result.output
    assert "success" in result.output
    assert "30.90" in result.output


def test_plan_is_read_from_standard_input(run):
    assert "success" in run("apple_to_counter", "--plan", "-", text=json.dumps(GOOD)).output


def test_failed_step_is_marked_and_later_steps_are_not_executed(run):
    result = run("apple_to_counter", "--plan", "-", text="pick_up 10\nmove 0")
    assert result.exit_code == 0
    assert "✗ pick_up apple_1" in " ".join(result.output.split())
    assert "out_of_reach: apple_1 is" in result.output
    assert "not executed" in result.output
    assert "the goal is not reached" in result.output


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("I would rather not.", "no plan was found"),
        ("dance 3", "unknown skill 'dance'"),
        ('[{"action": "move"}]', "move has no object_index"),
        ("turn nan", "yaw is nan: expected a finite number"),
        ("turn 1\n" * 65, "expected at most 64"),
        ("x" * 70_000, "expected at most 65536"),
    ],
)
def test_unparsable_text_is_explained_and_earns_minus_one(run, text, words):
    result = run("apple_to_counter", "--plan", "-", text=text)
    assert result.exit_code == 1
    assert words in " ".join(result.output.split())
    assert "-1.00" in result.output


def test_index_outside_the_table_is_a_failed_step(run):
    result = run("apple_to_counter", "--plan", "-", text="move 9999")
    assert result.exit_code == 0
    printed = " ".join(result.output.split())  # however wide the terminal is
    assert "unknown_index: there is no object with index 9999: the table has indices 0 to 14" in printed


def test_empty_plan_is_no_request_for_the_oracle(run):
    result = run("apple_to_counter", "--plan", "-", text="")
    assert result.exit_code == 1
    assert "no plan was found" in " ".join(result.output.split())


def test_words_name_the_task_whose_instruction_is_most_like_them(run):
    result = run("put the apple on the counter, please", "--plan", "-", text=json.dumps(GOOD))
    printed = " ".join(result.output.split())
    assert printed.startswith("the task most like these words, of ")
    assert " apple_to_counter " in printed
    assert "success" in printed


def test_one_word_is_an_id(run):
    result = run("apple", "--oracle")
    assert result.exit_code == 2
    assert "there is no task 'apple'" in " ".join(result.output.split())


def test_shipped_policy_plays_a_shipped_task(tmp_path):
    unpack(tmp_path)
    app = typer.Typer()
    app.command()(play)
    words = "move the meat loaf into the fridge"
    result = CliRunner().invoke(
        app, [words, "--policy", "shipped", "--dataset", str(tmp_path)], env={"COLUMNS": "160"}
    )
    assert result.exit_code == 0, result.output
    assert "put meat_loaf_1 inside fridge_1" in result.output
    assert "success" in result.output


def test_typed_plan_may_name_objects_and_shows_the_lines_that_are_no_calls(run):
    result = run("apple_to_counter", "--plan", "-", text="move apple_1\npick up apple_1\nmove countertop_1\n")
    printed = " ".join(result.output.split())
    assert result.exit_code == 0, result.output
    assert "not a call, and passed over: pick up 10" in printed
    assert "names of objects were read as rows" in printed
    assert "2 ✓ move countertop_1" in printed
    wrong = run("apple_to_counter", "--plan", "-", text="move aple_1\n")
    assert (wrong.exit_code, "did you mean apple_1" in " ".join(wrong.output.split())) == (1, True)


def test_person_explores_with_what_the_robot_has_seen(run):
    typed = "state\nmove 14\nhelp\nmove 10\npick_up 10\nmove 0\nplace 0 ontop\ndone\n"
    result = run("apple_to_counter", "--interactive", "--visibility", "seen", text=typed)
    printed = " ".join(result.output.split())
    assert result.exit_code == 0, result.output
    assert "Rooms: kitchen_0, living_room_0" in printed
    assert "place 0 ontop: put apple 10 on top of countertop 0" in printed
    assert "the episode is over: done" in printed
    assert "total │ success" in printed
    assert (
        "Reward" not in run("apple_to_counter", "--interactive", "--visibility", "seen", text="quit\n").output
    )


def test_nothing_is_seen_before_a_plan_is_written(run):
    result = run("apple_to_counter", "--oracle", "--visibility", "seen")
    assert (
        result.exit_code,
        "--visibility seen is for --interactive" in " ".join(result.output.split()),
    ) == (
        2,
        True,
    )


def test_table_and_prompt_of_a_task_are_shown_without_execution(run):
    result = run("apple_to_counter", "--show")
    assert result.exit_code == 0
    printed = " ".join(result.output.split())
    assert "│ 10 │ apple_1 │ apple │ kitchen_0 │" in printed
    assert "You control a home robot." in printed
    assert "Reward" not in printed


def test_task_is_played_by_hand_call_by_call(run):
    typed = "pick_up apple_1\nturn 90\nturn 6\ndance 3\nfoo\nhelp\npick_up aple_1\n"
    typed += "move apple_1\nstate\npick_up 10\nmove countertop_1\nplace 0 ontop\nmove 1\n"
    result = run("apple_to_counter", "--interactive", text=typed)
    assert result.exit_code == 0, result.output
    printed = " ".join(result.output.split())
    assert "✗ apple_1 is" in printed, "a failed call changes nothing"
    assert "unknown skill 'dance'" in printed
    assert "found 'foo': expected one call, such as `move 3`" in printed
    assert "move object" in printed, "`help` lists the calls"
    assert "turn radians" in printed
    assert "turn by 90 radians, which is more than a full turn; 90 degrees are 1.57" in printed
    assert "did you mean apple_1" in printed
    assert printed.count("full turn") == 1
    assert printed.endswith("for --plan FILE turn 90.0 turn 6.0 move 10 pick_up 10 move 0 place 0 ontop")
    assert "✓ put apple_1 on top of countertop_1 the goal is reached" in printed
    assert "Reward" in printed
    assert "✓ stands at" not in printed.split("the goal is reached")[1], "the task ends at the goal"
    assert "Reward" not in run("apple_to_counter", "--interactive", text="move 10\nrestart\n").output
    ended = run("apple_to_counter", "--interactive", text="move 10\ndone\nmove 0\n").output
    assert ended.count("✓ stands at") == 1


def test_newest_checkpoint_of_a_run_writes_the_plan(run, folder, tmp_path):
    tasks = load_tasks(folder)
    settings = read_settings(None, {"tiny.layers": 1, "tiny.width": 16, "tiny.heads": 2, "tiny.inner": 16})
    store = CheckpointStore(tmp_path / CHECKPOINTS, keep=2)
    for step in (1, 2):
        store.save(new_policy(settings, tasks), {}, TrainingProgress(step=step, grpo_ready=True), settings)
    result = run("apple_to_counter", "--policy", str(tmp_path))
    assert result.exit_code in (0, 1), result.output
    assert "Reward" in result.output
    refused = run("apple_to_counter", "--policy", str(tmp_path / "nothing"))
    assert refused.exit_code == 2
    assert "nothing" in refused.output


def test_policy_for_episodes_plays_and_all_texts_are_printed(run, folder, tmp_path):
    tasks = load_tasks(folder)
    shape = {"tiny.layers": 1, "tiny.width": 16, "tiny.heads": 2, "tiny.inner": 16}
    settings = read_settings(None, {**shape, "episodes.visibility": "seen"})
    progress = TrainingProgress(step=1, grpo_ready=True)
    CheckpointStore(tmp_path / CHECKPOINTS, keep=1).save(new_policy(settings, tasks), {}, progress, settings)
    result = run("apple_to_counter", "--policy", str(tmp_path))
    assert result.exit_code == 0, result.output
    lines = result.output.splitlines()
    assert lines[0].startswith("rooms kitchen_0")
    said = [at for at, line in enumerate(lines) if line.startswith("> ")]
    assert all(lines[at + 1].split()[0] in ("did", "failed", "robot") for at in said)
    assert "Reward" in result.output
    refused = run("apple_to_counter", "--policy", str(tmp_path), "--mode", "physical")
    assert (refused.exit_code, "leave out --film and --mode" in refused.output) == (2, True)


def test_oracle_option_solves_the_task(run):
    result = run("cook_chicken", "--oracle")
    assert result.exit_code == 0
    assert "toggle_on microwave_1" in result.output
    assert "success" in result.output


@pytest.mark.parametrize(
    ("arguments", "env", "words"),
    [
        (("cook_chiken", "--oracle"), {}, "there is no task 'cook_chiken'"),
        (
            ("cook_chicken",),
            {},
            "expected one of --plan FILE, --oracle, --policy FOLDER, --interactive and --show",
        ),
        (
            ("cook_chicken", "--oracle", "--plan", "-"),
            {},
            "expected one of --plan FILE, --oracle, --policy FOLDER, --interactive and --show",
        ),
        (("cook_chicken", "--plan", "/no/such/plan"), {}, "No such file or directory"),
        (
            ("cook_chicken", "--oracle"),
            {"EMBOMATRIX_DATASET": "/no/such"},
            "there is no dataset in /no/such",
        ),
    ],
)
def test_bad_input_gives_one_sentence_without_traceback(run, arguments, env, words):
    result = run(*arguments, env=env)
    assert result.exit_code == 2
    assert words in " ".join(result.output.split())
    assert "Traceback" not in result.output


def test_unknown_task_suggests_close_ids(run):
    assert "did you mean cook_chicken?" in run("cook_chiken", "--oracle").output


def test_dataset_folder_can_be_given_as_an_option(run, folder):
    result = run("cook_chicken", "--oracle", "--dataset", str(folder), env={"EMBOMATRIX_DATASET": "/no/such"})
    assert result.exit_code == 0


def test_plan_is_drawn_as_an_animation(run, tmp_path):
    film = tmp_path / "film.gif"
    plan = tmp_path / "plan.json"
    plan.write_text(json.dumps(GOOD[:2]))
    result = run("apple_to_counter", "--plan", str(plan), "--film", str(film))
    assert result.exit_code == 0, result.output
    with Image.open(film) as picture:
        assert picture.n_frames > 10
        assert picture.size == (896, 480)


def test_plan_is_drawn_as_a_video(run, tmp_path, monkeypatch):
    film = tmp_path / "film.mp4"
    plan = tmp_path / "plan.json"
    plan.write_text(json.dumps(GOOD[:2]))
    result = run("apple_to_counter", "--plan", str(plan), "--film", str(film))
    assert result.exit_code == 0, result.output
    with av.open(str(film)) as video:
        (stream,) = video.streams
        assert (stream.codec_context.name, stream.width, stream.height) == ("h264", 896, 480)
        assert sum(1 for _ in video.decode(stream)) > 20
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    result = run("apple_to_counter", "--oracle", "--film", str(film))
    assert result.exit_code == 2
    assert "pip install embomatrix[film]" in " ".join(result.output.split())


def test_unknown_film_suffix_is_refused_before_execution(run):
    result = run("apple_to_counter", "--oracle", "--film", "film.avi")
    assert result.exit_code == 2
    assert "film.avi" in result.output
    assert ".gif" in result.output
    assert "✓" not in result.output


def test_unwritable_film_is_refused_before_execution(run, tmp_path):
    (tmp_path / "file").touch()
    result = run("apple_to_counter", "--oracle", "--film", str(tmp_path / "file" / "film.gif"))
    assert result.exit_code == 2
    assert "film.gif can't be written" in " ".join(result.output.split())
    assert "✓" not in result.output

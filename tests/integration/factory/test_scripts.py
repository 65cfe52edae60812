"""Scripts on datasets: the template script reads the plain writer's tasks, and measured difficulties are stored."""

import json
import shutil

import numpy as np
import pytest
from tests.fakes.datasets import write_kitchen_dataset
from typer.testing import CliRunner

from embomatrix.factory.commands.app import app
from embomatrix.factory.evaluate.scripts import ScriptName, evaluation_of, run_scripts, write_plans
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.writer.tasks import Draft, DraftOrder, PlainWriter, is_heldout_signature
from embomatrix.factory.writer.variant import build_variant
from embomatrix.host.code_version import commit_here
from embomatrix.scripts.calls import ScriptDemand
from embomatrix.scripts.examples import ScriptExample
from embomatrix.scripts.template import TemplateScript
from embomatrix.skills.prompt import situation_of
from embomatrix.world.dataset import TASKS_FILE, Dataset
from embomatrix.world.intent import IntentClause
from embomatrix.world.task import TaskCategory

VARIANTS = 12
EACH = 10


@pytest.fixture(scope="module")
def kitchen(tmp_path_factory):
    return write_kitchen_dataset(tmp_path_factory.mktemp("kitchen"))


@pytest.fixture
def copied(kitchen, tmp_path):
    """Copy of the kitchen dataset that a command may change."""
    return shutil.copytree(kitchen, tmp_path / "kitchen")


def drafts_in(scene_id):
    """Return drafts of the plain writer over variants of a base scene, with the content of their prompts."""
    base = build_base_scene(scene_id, seed=0)
    found = []
    for number in range(VARIANTS):
        rng = np.random.default_rng(number)
        rooms = [str(name) for name in rng.permutation([room.name for room in base.rooms])[:3]]
        variant = build_variant(base, rooms, f"{scene_id}-{number}", rng)
        view = SceneView(variant.scene)
        for attempt in range(EACH):
            category = [*TaskCategory][attempt % len(TaskCategory)]
            draft = PlainWriter().write(variant, view, DraftOrder(category, f"{number}-{attempt}", rng))
            if isinstance(draft, Draft):
                found.append((draft, situation_of(variant.scene, draft.task)))
    return found


def meets(demand: ScriptDemand, clause: IntentClause) -> bool:
    """Return True if the objects that a script prefers are ones that the words may mean."""
    return (
        (demand.predicate, demand.holds) == (clause.predicate, clause.holds)
        and demand.things[0].name in clause.things
        and ([row.name in clause.places for row in demand.places[:1]] or [False])[0] is bool(clause.places)
    )


def test_template_script_reads_at_least_nine_in_ten_held_out_instructions_of_the_plain_writer() -> None:
    drafts = drafts_in("Rs_int")
    held_out = [is_heldout_signature(draft.signature, 0) for draft, _ in drafts]
    script = TemplateScript.fit(
        [
            ScriptExample(draft.task.task_id, situation, draft.intent, ())
            for (draft, situation), held in zip(drafts, held_out, strict=True)
            if not held
        ]
    )
    read = []
    for (draft, situation), held in zip(drafts, held_out, strict=True):
        if held:
            demands = script.demands(situation)
            read.append(
                len(demands) == len(draft.intent)
                and all(any(meets(demand, clause) for demand in demands) for clause in draft.intent)
            )
    assert len(read) >= 15
    assert sum(read) >= 0.9 * len(read)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_template_script_solves_at_least_nine_in_ten_held_out_tasks_of_the_old_corpus(tmp_path) -> None:
    built = (
        "build",
        f"--out={tmp_path / 'old'}",
        "--train=240",
        "--heldout=40",
        "--no-reachability",
        "--jobs=2",
    )
    assert CliRunner().invoke(app, built).exit_code == 0
    asked = ("evaluate", "scripts", f"--dataset={tmp_path / 'old'}", f"--out={tmp_path}", "--jobs=2")
    result = CliRunner().invoke(app, asked)
    assert result.exit_code == 0, result.output
    figures = {
        figure["name"]: figure for figure in json.loads((tmp_path / "scripts.json").read_text())["figures"]
    }
    assert figures["template_success"]["n"] == 40
    assert figures["template_success"]["value"] >= 0.9
    assert figures["nearest_success"]["value"] >= 0.5


def test_greedy_plan_succeeds_and_idle_plan_fails(kitchen) -> None:
    dataset = Dataset.load(kitchen)
    fetching = [dataset.find("apple_to_counter")]
    plans = write_plans(dataset, fetching, dataset)
    written = {task_id: {**given, ScriptName.NEAREST: ()} for task_id, given in plans.items()}
    results = run_scripts(dataset, fetching, written, jobs=1)["apple_to_counter"]
    assert results[ScriptName.GREEDY]
    assert not results[ScriptName.NEAREST]


def test_figures_have_wilson_intervals_and_goals() -> None:
    results = {
        f"t{at}": {ScriptName.TEMPLATE: at < 8, ScriptName.NEAREST: at < 3, ScriptName.GREEDY: True}
        for at in range(10)
    }
    evaluation = evaluation_of(results, {})
    assert evaluation.figure("template_success").value == 0.8
    assert not evaluation.figure("template_success").is_reached
    assert evaluation.figure("nearest_success").is_reached
    assert evaluation.figure("greedy_success").goal is None
    # Wilson's interval of 8 in 10, from the published formula.
    assert "template_success 0.800 [0.490, 0.943]" in evaluation.notes[0]


def test_evaluate_writes_the_figures_of_scripts(kitchen, tmp_path) -> None:
    result = CliRunner().invoke(app, ["evaluate", "scripts", f"--dataset={kitchen}", f"--out={tmp_path}"])
    assert result.exit_code == 0, result.output
    value = json.loads((tmp_path / "scripts.json").read_text())
    assert value["conditions"] == {
        "dataset": kitchen.name,
        "training tasks": 3,
        "held-out tasks": 1,
        "commit": commit_here(),
    }
    assert [figure["name"] for figure in value["figures"]] == [f"{name}_success" for name in ScriptName]


def test_difficulty_is_stored_and_listed(copied) -> None:
    result = CliRunner().invoke(app, ["difficulty", "--dataset", str(copied), "--jobs=1"])
    assert result.exit_code == 0, result.output
    records = Dataset.load(copied).records
    assert all(record.difficulty is not None for record in records)
    assert [record.difficulty.steps for record in records] == [len(record.oracle) for record in records]
    listed = CliRunner().invoke(app, ["list", "--dataset", str(copied)])
    assert " · hard" in listed.output
    stored = (copied / TASKS_FILE).read_bytes()
    assert CliRunner().invoke(app, ["difficulty", "--dataset", str(copied), "--again"]).exit_code == 0
    assert (copied / TASKS_FILE).read_bytes() == stored


def test_selection_is_a_dataset_of_its_own(copied, tmp_path) -> None:
    options = (f"--out={tmp_path / 'hard'}", "--hard-share=1", "--split=heldout")
    result = CliRunner().invoke(app, ["difficulty", "--dataset", str(copied), *options])
    assert result.exit_code == 0, result.output
    chosen = Dataset.load(tmp_path / "hard")
    assert [record.task.task_id for record in chosen.heldout] == ["tidy_up"]
    assert len(chosen.train) == 3
    chosen.bundle(chosen.records[0].bundle_digest)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--easy-share=0.5",), "--out and the shares belong together"),
        (("--out=new",), "--out and the shares belong together"),
        (("--out=new", "--easy-share=0.8", "--hard-share=0.3"), "add up to 1.1: expected at most 1"),
        (("--out=new", "--easy-share=1", "--split=test"), "unknown split 'test': expected train or heldout"),
        (("--policy=nothing.json",), "expected the report.json that `embomatrix eval` wrote"),
    ],
)
def test_wrong_options_are_refused_before_anything_is_measured(copied, options, words) -> None:
    before = (copied / TASKS_FILE).read_bytes()
    result = CliRunner().invoke(app, ["difficulty", "--dataset", str(copied), *options])
    assert result.exit_code == 2
    assert words in " ".join(result.output.split())
    assert (copied / TASKS_FILE).read_bytes() == before


def test_dataset_without_training_tasks_names_the_remedy(copied) -> None:
    path = copied / TASKS_FILE
    path.write_text("".join(line for line in path.read_text().splitlines(True) if '"heldout"' in line))
    result = CliRunner().invoke(app, ["evaluate", "scripts", f"--dataset={copied}"])
    assert result.exit_code == 2
    assert "give a dataset that has some with --training" in " ".join(result.output.split())

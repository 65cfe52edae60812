"""Invalid input to commands: one sentence with object and remedy, an exit status, and no traceback."""

import json
import shutil

import pytest
from tests.fakes.chat_server import ChatServer, completion
from tests.fakes.commands import background, run, run_anew, without

TASK = "apple_to_counter"
NOWHERE = "127.0.0.1:1"
BDDL = """(define (problem apple-0)
  (:domain omnigibson)
  (:objects
    apple.n.01_1 - apple.n.01
    countertop.n.01_1 - countertop.n.01
    agent.n.01_1 - agent.n.01)
  (:init
    (inroom countertop.n.01_1 kitchen)
    (ontop apple.n.01_1 countertop.n.01_1))
  (:goal (and (inside apple.n.01_1 countertop.n.01_1))))
"""


def assert_ended(result, status, *words):
    assert "Traceback" not in result.text
    assert "should not have happened" not in result.text
    assert result.status == status, result.text
    for word in words:
        assert word in result.text


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("play", "apple_to_countr", "--oracle", "--dataset=DATASET"), "did you mean apple_to_counter?"),
        (("scene", "show", "Rs_imt"), "unknown scene 'Rs_imt' (the catalog holds 51): did you mean Rs_int"),
        (("factory", "build", "--scene=Rs_imt", "--out=OUT"), "unknown scene 'Rs_imt'"),
        (("factory", "import", "--activity=bringin_water"), "did you mean bringing_water"),
        (("train", "--model=tinny", "--dataset=DATASET", "--out=OUT"), "the model 'tinny' is not a folder"),
        (("trian",), "did you mean `train`?"),
    ],
)
def test_unknown_name_error_suggests_similar_names(kitchen, tmp_path, arguments, words):
    out = tmp_path / "out"
    filled = [item.replace("DATASET", str(kitchen)).replace("OUT", str(out)) for item in arguments]
    assert_ended(run(*filled, HF_HUB_OFFLINE="1"), 2, words)
    assert not out.exists()


@pytest.mark.parametrize(
    ("plan", "words"),
    [
        (
            "I would rather not.",
            "no plan was found (the text begins with 'I would rather not.'): expected a JSON array",
        ),
        ('[{"action": "move", "object_index": 3}', "its JSON is invalid at line 1, column 39"),
        (
            '[{"action": "dance", "object_index": 3}]',
            "step 1: found the unknown skill 'dance': expected one of move, turn",
        ),
        ("open 1\n" * 9_000, "the plan has 9000 steps: expected at most 64"),
        (json.dumps([{"action": "open", "object_index": 1}] * 10_000), "expected at most 65536"),
        ('[{"action": "turn", "yaw": NaN}]', "yaw is nan: expected a finite number"),
        ('[{"action": "move"}]', "step 1: move has no object_index: expected `move object_index`"),
        ("", "the text is empty"),
        (bytes(range(256)) * 20, "no plan was found"),
    ],
    ids=["prose", "cut", "skill", "steps", "bytes", "nan", "argument", "empty", "binary"],
)
def test_unparsable_text_earns_minus_one_with_a_reason(kitchen, tmp_path, plan, words):
    file = tmp_path / "plan"
    file.write_bytes(plan if isinstance(plan, bytes) else plan.encode())
    result = run("play", TASK, f"--plan={file}", f"--dataset={kitchen}")
    assert_ended(result, 1, words, "the text is not a plan and was not executed", "-1.00")


@pytest.mark.parametrize(
    ("plan", "words"),
    [
        ("move 9999", "unknown_index: there is no object with index 9999: the table has indices 0 to 14"),
        ("go_to_room attic_0", "unknown_room: "),
        ("pick_up 10", "out_of_reach: "),
    ],
)
def test_failed_step_shows_its_reason_and_ends_the_plan(kitchen, plan, words):
    result = run("play", TASK, "--plan=-", f"--dataset={kitchen}", text=f"{plan}\nmove 0")
    assert_ended(result, 0, words, "not executed", "the goal is not reached")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (
            BDDL.rstrip()[:-1],
            "problem: line 1, column 1: the parenthesis opened here is never closed: add ')'",
        ),
        (
            BDDL.replace("- apple.n.01", "- unicorn.n.01"),
            "type 'unicorn.n.01' of 'apple.n.01_1' is in no catalog",
        ),
        (
            BDDL.replace("inside apple", "inside pear"),
            "object 'pear.n.01_1' is not declared: add it to :objects",
        ),
        ("", "problem: line 1, column 1: the text is empty: expected '(define (problem NAME) ...)'"),
        (b"\xff\xfe\x00", "problem.bddl is not UTF-8 text: expected BDDL problems"),
        (None, "problem.bddl can't be read (No such file or directory)"),
    ],
    ids=["parenthesis", "type", "undeclared", "empty", "binary", "absent"],
)
def test_bddl_error_names_line_and_column(tmp_path, content, words):
    file, out = tmp_path / "problem.bddl", tmp_path / "out"
    if content is not None:
        file.write_bytes(content if isinstance(content, bytes) else content.encode())
    result = run("factory", "import", f"--bddl={file}", "--scene=Rs_int", f"--out={out}")
    assert_ended(result, 2, words)
    assert not (out / "tasks.jsonl").exists()


def test_import_refuses_to_overwrite_a_dataset(kitchen, tmp_path):
    (tmp_path / "problem.bddl").write_text(BDDL)
    before = (kitchen / "tasks.jsonl").read_bytes()
    result = run("factory", "import", f"--bddl={tmp_path / 'problem.bddl'}", f"--out={kitchen}")
    assert_ended(result, 2, f"{kitchen} holds a dataset already: name another folder with --out")
    assert (kitchen / "tasks.jsonl").read_bytes() == before


def _cut(path):
    path.write_bytes(path.read_bytes()[:200])


def _bundle(folder):
    return next((folder / "bundles").iterdir())


DAMAGES = {
    "no folder": (shutil.rmtree, "get the shipped one with `embomatrix factory starter --out="),
    "no records": (lambda folder: (folder / "tasks.jsonl").unlink(), "tasks.jsonl can't be read"),
    "records cut": (lambda folder: _cut(folder / "tasks.jsonl"), "tasks.jsonl:1 is damaged: expected a JSON"),
    "records binary": (
        lambda folder: (folder / "tasks.jsonl").write_bytes(b"\xff"),
        "expected text in UTF-8",
    ),
    "bundle cut": (
        lambda folder: _cut(_bundle(folder)),
        "of the dataset is damaged (the bundle's digest is sha256:",
    ),
    "no bundle": (
        lambda folder: _bundle(folder).unlink(),
        "copy the dataset again, or get the shipped one with",
    ),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_missing_or_damaged_dataset_error_names_the_remedy(kitchen, tmp_path, damage):
    folder = tmp_path / "dataset"
    shutil.copytree(kitchen, folder)
    change, words = DAMAGES[damage]
    change(folder)
    assert_ended(run("play", TASK, "--oracle", f"--dataset={folder}"), 2, str(folder), words)


@pytest.mark.parametrize("damage", ["no folder", "bundle cut"])
def test_trainer_reports_the_same_dataset_errors(kitchen, tmp_path, damage):
    folder = tmp_path / "dataset"
    shutil.copytree(kitchen, folder)
    DAMAGES[damage][0](folder)
    result = run("train", f"--dataset={folder}", f"--manager={NOWHERE}", f"--out={tmp_path / 'out'}")
    assert_ended(result, 2, "embomatrix train:", str(folder), "embomatrix factory starter")


@pytest.mark.parametrize(
    ("package", "arguments", "words"),
    [
        ("torch", ("train",), "the package 'torch' is not installed: install it with `pip install 'embomatrix[trainer]'`"),
        ("uvicorn", ("manager", "serve"), "pip install 'embomatrix[manager]'"),
        ("psutil", ("worker", "run"), "pip install 'embomatrix[worker]'"),
        ("trimesh", ("factory", "build", "--out=no"), "pip install 'embomatrix[factory]'"),
        ("pybullet", ("worker", "run"), "needs the physics engine pybullet, which Python"),
        ("pybullet", ("play", TASK, "--oracle", "--dataset=DATASET"), "the physics engine is missing: expected the package"),
        ("pybullet", ("demo", "--dataset=DATASET", "--out=OUT"), "the cluster can't work, worker-"),
    ],
)  # fmt: skip
def test_missing_package_error_names_the_extra(kitchen, tmp_path, package, arguments, words):
    out = tmp_path / "out"
    filled = [item.replace("DATASET", str(kitchen)).replace("OUT", str(out)) for item in arguments]
    assert_ended(run_anew(*filled, **without(tmp_path, package)), 2, words)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("play", TASK, "--dataset=x"), "expected one of --plan FILE, --oracle, --policy FOLDER"),
        (("factory", "import"), "found 0 sources: expected exactly one of --bddl FILE"),
        (("train", "--minutes=-1"), "Invalid value for '--minutes'"),
        (("demo", "--workers=0"), "Invalid value for '--workers'"),
        (("manager", "serve", "--port=99999"), "--port 99999: input should be less than or equal to 65535"),
        (
            ("manager", "serve", "--port=0", "--http-port=0", "--state=foo:bar"),
            "expected memory:, sqlite:PATH or redis://HOST:PORT/DB",
        ),
        (
            ("status", "--manager=nowhere"),
            "'nowhere' is not a manager address: expected HOST:PORT",
        ),
        (("worker", "run", "--manager=host:99999"), "--manager 'host:99999': expected HOST:PORT"),
        (("worker", "run", "--nice=50"), "--nice 50: input should be less than or equal to 19"),
    ],
)
def test_invalid_option_error_names_the_expected_value(tmp_path, arguments, words):
    assert_ended(run(*arguments, HOME=str(tmp_path)), 2, words)


def test_unknown_training_setting_is_named(kitchen, tmp_path):
    (tmp_path / "settings.toml").write_text("speed = 3")
    result = run(
        "train",
        f"--settings={tmp_path / 'settings.toml'}",
        f"--dataset={kitchen}",
        f"--out={tmp_path / 'out'}",
    )
    assert_ended(result, 2, "unknown setting 'speed': correct its name or remove it")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ("factory", "build", "--scene=Rs_int", "--heldout=0", "--out=OUT"),
            "can't be written (Not a directory)",
        ),
        (("scene", "build", "Rs_int", "--out=OUT"), "can't be written (Not a directory)"),
        (("manager", "serve", "--port=0", "--data-dir=OUT"), "pass another --data-dir"),
        (("worker", "run", "--cache-dir=OUT"), "name another folder with --cache-dir"),
        (
            ("train", "--dataset=DATASET", "--out=OUT"),
            "can't be created (Not a directory): pass another --out",
        ),
        (
            ("demo", "--dataset=DATASET", "--out=OUT"),
            "can't be created (Not a directory): pass another --out",
        ),
    ],
)
def test_unwritable_folder_is_named(kitchen, tmp_path, arguments, words):
    (tmp_path / "file").write_text("no folder")
    out = tmp_path / "file" / "out"
    filled = [item.replace("DATASET", str(kitchen)).replace("OUT", str(out)) for item in arguments]
    assert_ended(run(*filled), 2, str(out), words)


def test_full_disk_leaves_no_partial_scene_file(tmp_path):
    result = run_anew("scene", "build", "Rs_int", f"--out={tmp_path}", largest_file=4096)
    assert_ended(result, 2, "Rs_int.json can't be written (File too large): free disk space")
    assert list(tmp_path.iterdir()) == []


def test_resume_without_checkpoint_is_refused(kitchen, tmp_path):
    result = run("train", "--resume", f"--dataset={kitchen}", f"--out={tmp_path}")
    assert_ended(result, 2, f"no checkpoint in {tmp_path} to resume from: leave out --resume")


def test_folder_of_another_run_stays_unchanged(kitchen, tmp_path):
    (tmp_path / "checkpoints" / "step-000001").mkdir(parents=True)
    result = run("train", f"--dataset={kitchen}", f"--out={tmp_path}")
    assert_ended(result, 2, f"{tmp_path} holds another run: pass --resume to continue it, or another --out")
    assert_ended(
        run("demo", f"--dataset={kitchen}", f"--out={tmp_path}"), 2, "holds another run: pass another --out"
    )


def test_interrupted_evaluation_resumes_from_its_answers(kitchen, tmp_path):
    out = tmp_path / "out"
    arguments = ("eval", f"--bench={kitchen}", "--split=all", "--model-name=m", "--samples=3", f"--out={out}")
    late = (200, {}, json.dumps(completion("move 10")), 6.0)
    server = ChatServer("move 10", "move 10", late)
    with server.serving() as url:
        with background(tmp_path / "log", *arguments, f"--endpoint={url}") as asking:
            asking.wait_for(lambda: (out / "answers.jsonl").exists() and len(_lines(out)) == 3)
            assert_ended(asking.interrupt(), 130, "the same command continues from there")
        server.script = ["move 10"]
        result = run(*arguments, f"--endpoint={url}")
    assert_ended(result, 0, "2 answers are already stored", "12 answers in", "goal not met 12 100.0%")


def _lines(out):
    return (out / "answers.jsonl").read_bytes().splitlines()


def test_interrupted_build_leaves_no_dataset_and_resumes(tmp_path):
    out = tmp_path / "out"
    arguments = (
        "factory", "build", f"--out={out}", "--scene=Rs_int", "--train=8", "--heldout=0", "--no-reachability"
    )  # fmt: skip
    with background(tmp_path / "log", *arguments) as building:
        building.wait_for((out / "build.jsonl").exists)
        result = building.interrupt()
    assert_ended(
        result, 130, "interrupted: finished tasks are kept in", "run the same command again to resume"
    )
    assert not (out / "tasks.jsonl").exists()
    other = run(
        "factory", "build", f"--out={out}", "--scene=Rs_int", "--train=9", "--heldout=0", "--no-reachability"
    )
    assert_ended(other, 2, "holds a run with other settings (train 8, now 9): give the same settings again")

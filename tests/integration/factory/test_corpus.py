"""The corpus joins parts, separates training from held-out tasks, and freezes the hardest of them."""

import dataclasses

import pytest
from tests.fakes.datasets import write_kitchen_dataset
from typer.testing import CliRunner

from embomatrix.factory.commands.app import app
from embomatrix.factory.pipeline.corpus import (
    TASKS,
    freeze_hardest,
    join_parts,
    joined_part,
    part_folder,
    settings_of,
)
from embomatrix.factory.scenes.build import base_scene_of
from embomatrix.starter.archive import content_digest, pack, read_packed
from embomatrix.starter.recipes import PARTS, Recipe
from embomatrix.starter.shipped import frozen_digest, frozen_tasks, unpack
from embomatrix.world.dataset import Dataset, DatasetError, write_dataset
from embomatrix.world.difficulty import Difficulty

EASY = Difficulty(True, True, True, 4, None)
HARD = Difficulty(False, False, True, 4, None)


@pytest.fixture(scope="module")
def kitchen(tmp_path_factory):
    return Dataset.load(write_kitchen_dataset(tmp_path_factory.mktemp("kitchen")))


def _written(folder, kitchen, splits, scene, kinds, words="Request {kind} in {scene}.", room="kitchen_0"):
    """Write a dataset of kitchen tasks with the given scene, signatures and words."""
    records = [
        dataclasses.replace(
            record,
            split=split,
            signature=kind,
            rooms=(room,),
            difficulty=EASY,
            task=dataclasses.replace(
                record.task,
                task_id=f"{scene}-{kind}",
                scene_id=f"{scene}-x",
                instruction=words.format(kind=kind, scene=scene),
            ),
        )
        for record, split, kind in zip(kitchen.records, splits, kinds, strict=False)
    ]
    write_dataset(
        folder,
        records,
        {record.bundle_digest: kitchen.bundle_bytes(record.bundle_digest) for record in records},
    )
    return Dataset.load(folder)


@pytest.fixture
def parts(tmp_path, kitchen):
    """Corpus whose first part has two training tasks in a scene, its second three held-out ones in another."""
    _written(part_folder(tmp_path, 1), kitchen, ("train", "train"), "Rs_int", "ab")
    _written(part_folder(tmp_path, 2), kitchen, ("heldout",) * 3, "Ihlen_1_int", "def")
    return tmp_path


def test_parts_become_one_dataset(parts):
    joined = join_parts(parts, (1, 2))
    tasks = Dataset.load(parts / TASKS)
    assert tasks.records == joined.records
    assert (len(tasks.train), len(tasks.heldout), joined.dropped) == (2, 3, 0)
    assert joined_part(parts, 2).records == tasks.heldout
    assert join_parts(parts, (1, 2)).records == joined.records


def test_a_single_part_is_a_corpus_too(parts):
    joined = join_parts(parts, (1,))
    assert len(joined.records) == 2
    assert joined_part(parts, 1).records == joined.records


def test_a_training_task_that_gives_a_held_out_one_away_is_left_out(parts, kitchen):
    _written(part_folder(parts, 1), kitchen, ("train", "train"), "Rs_int", "ad", "Request {kind}.")
    _written(part_folder(parts, 2), kitchen, ("heldout",) * 3, "Ihlen_1_int", "def", "Request {kind}.")
    joined = join_parts(parts, (1, 2))
    assert joined.dropped == 1
    assert [record.signature for record in joined_part(parts, 1).records] == ["a"]


def test_a_scene_on_both_sides_is_refused(parts, kitchen):
    _written(part_folder(parts, 2), kitchen, ("heldout",), "Rs_int", "c", room="pantry_0")
    with pytest.raises(DatasetError, match="tasks in Rs_int are trained on and held out"):
        join_parts(parts, (1, 2))


def test_tasks_stay_when_parts_cannot_be_joined(parts, kitchen):
    joined = join_parts(parts, (1, 2))
    _written(part_folder(parts, 2), kitchen, ("heldout",), "Rs_int", "c", room="pantry_0")
    with pytest.raises(DatasetError, match="tasks in Rs_int are trained on and held out"):
        join_parts(parts, (1, 2))
    with pytest.raises(DatasetError, match=r"part 3 is not complete .* factory corpus --out \S+ --part 3`"):
        join_parts(parts, (1, 3))
    assert Dataset.load(parts / TASKS).records == joined.records
    assert sorted(path.name for path in parts.iterdir()) == ["parts", "tasks"]


def test_the_hardest_held_out_tasks_are_frozen(parts):
    join_parts(parts, (1, 2))
    hard = {"Ihlen_1_int-e", "Ihlen_1_int-f", "Rs_int-a"}
    records = [
        dataclasses.replace(record, difficulty=HARD if record.task.task_id in hard else EASY)
        for record in Dataset.load(parts / TASKS).records
    ]
    frozen = freeze_hardest(records, 2, parts / "frozen.json")
    assert frozen.tasks == ("Ihlen_1_int-e", "Ihlen_1_int-f")
    assert frozen_tasks(parts / "frozen.json") == frozen
    assert frozen.digest == frozen_digest([r for r in records if r.task.task_id in frozen.tasks])
    with pytest.raises(DatasetError, match="found 3 held-out tasks to freeze: expected at least 4"):
        freeze_hardest(records, 4, parts / "frozen.json")


def test_a_frozen_digest_covers_goals_and_not_difficulties(parts):
    records = Dataset.load(part_folder(parts, 2)).records
    digest = frozen_digest(records)
    assert digest == frozen_digest([dataclasses.replace(record, difficulty=HARD) for record in records])
    other = dataclasses.replace(records[0].task, goal_bddl="(open fridge_1)")
    assert digest != frozen_digest([dataclasses.replace(records[0], task=other), *records[1:]])


@pytest.fixture
def shipping(parts, tmp_path, kitchen, monkeypatch):
    """Folder of archives of both parts, from which the commands unpack."""
    folder = tmp_path / "package"
    folder.mkdir()

    def archive(part):
        return folder / f"tasks-{part}.xz"

    for part in (1, 2):
        pack(Dataset.load(part_folder(parts, part)), archive(part))
    recipes = {
        1: Recipe(2, 0, ("Rs_int",)),
        2: Recipe(0, 3, ("Ihlen_1_int",)),
        3: Recipe(2, 0, ("Rs_garden",)),
    }

    def build(out, settings, **_):
        """Stand-in for a build, which takes an hour."""
        splits, kinds = (("train",) * 2, "gh") if settings.train else (("heldout",) * 3, "def")
        _written(out, kitchen, splits, settings.scenes[0], kinds)
        (out / "build.jsonl").touch()

    commands = "embomatrix.factory.commands.corpus"
    for name, value in (
        (f"{commands}.archive_of", archive),
        ("embomatrix.starter.shipped.archive_of", archive),
        (f"{commands}.PARTS", recipes),
        ("embomatrix.starter.shipped.PARTS", recipes),
        (f"{commands}.make_dataset", build),
        (f"{commands}.script_results", lambda *_: {}),
    ):
        monkeypatch.setattr(name, value)
    return folder


def _run(*options):
    done = CliRunner().invoke(app, ["corpus", *map(str, options)])
    return done.exit_code, " ".join(done.output.split())


def test_a_part_that_does_not_ship_is_built_and_packed(shipping, tmp_path):
    code, said = _run("--out", tmp_path / "c", "--part", 3, "--packed", tmp_path / "packed")
    assert code == 0, said
    assert "7 tasks in" in said
    records, _, digest = read_packed(tmp_path / "packed" / "tasks-3.xz")
    assert [record.signature for record in records] == ["g", "h"]
    assert f"part 3: 2 tasks, {digest}" in said
    assert [path.name for path in (tmp_path / "packed").iterdir()] == ["tasks-3.xz"]
    code, said = _run("--out", tmp_path / "c", "--part", 3, "--packed", tmp_path / "packed")
    assert code == 2
    assert "tasks-3.xz exists: name another folder with --packed, or pass --force" in said


def test_all_parts_are_made_by_default_and_frozen_on_request(shipping, tmp_path):
    code, said = _run("--out", tmp_path / "c", "--freeze", tmp_path / "f.json", "--count", 3)
    assert code == 0, said
    assert len(Dataset.load(tmp_path / "c" / TASKS).records) == 7
    assert frozen_tasks(tmp_path / "f.json").digest in said


def test_a_part_that_is_built_again_is_compared_with_the_shipped_one(shipping, tmp_path):
    code, said = _run("--out", tmp_path / "c", "--check", "--part", 2)
    assert code == 0, said
    shipped = read_packed(shipping / "tasks-2.xz")[2]
    assert f"part 2: 3 tasks, {shipped}, as shipped" in said
    code, said = _run("--out", tmp_path / "d", "--check")
    assert code == 2
    built = content_digest(Dataset.load(part_folder(tmp_path / "d", 1)))
    assert f"part 1: the recipe gives 2 tasks with {built}, and the shipped part has 2 with" in said
    assert "part 2: 3 tasks" in said, "the others are compared all the same"
    assert "this version builds other tasks than the shipped part 1" in said


def test_a_part_is_unpacked_where_its_build_was_interrupted(shipping, tmp_path):
    folder = part_folder(tmp_path / "c", 1)
    folder.mkdir(parents=True)
    (folder / "build.jsonl").touch()
    for _ in range(2):
        code, said = _run("--out", tmp_path / "c", "--part", 1)
        assert code == 0, said
        assert "5 tasks in" in said
    assert [record.signature for record in Dataset.load(folder).records] == ["a", "b"]


def test_a_build_stands_in_for_a_shipped_part_only_if_it_gives_its_tasks(shipping, tmp_path):
    assert _run("--out", tmp_path / "c", "--check", "--part", 2)[0] == 0
    code, said = _run("--out", tmp_path / "c", "--part", 2)
    assert code == 0, said
    assert _run("--out", tmp_path / "d", "--check")[0] == 2
    tasks = Dataset.load(tmp_path / "d" / TASKS).records
    code, said = _run("--out", tmp_path / "d", "--part", 3)
    assert code == 2
    assert "holds a build that differs from part 1 as it ships: name another folder with --out" in said
    assert not part_folder(tmp_path / "d", 3).exists(), "nothing is built first"
    assert Dataset.load(tmp_path / "d" / TASKS).records == tasks


def test_unknown_parts_and_parts_that_cannot_be_checked_are_refused(shipping, tmp_path):
    assert _run("--out", tmp_path / "c", "--part", 9) == (
        2,
        "embomatrix: there is no part 9: name one of 1, 2, 3 with --part",
    )
    code, said = _run("--out", tmp_path / "c", "--part", 3, "--check")
    assert code == 2
    assert "part 3 does not ship, so there is nothing to compare it with: name one of 1, 2" in said
    code, said = _run("--out", tmp_path / "c", "--check", "--packed", tmp_path / "packed")
    assert code == 2
    assert "--check compares builds from scratch: leave --packed" in said
    assert not (tmp_path / "c").exists()


def test_held_out_parts_must_be_there_to_pack_tasks_for_training_and_to_freeze(shipping, tmp_path):
    (shipping / "tasks-2.xz").unlink()
    for option in ("--packed", "--freeze"):
        code, said = _run("--out", tmp_path / "c", "--part", 3, option, tmp_path / "new")
        assert (code, said) == (2, f"embomatrix: {option} needs all held-out tasks: add --part 2")
    code, said = _run("--out", tmp_path / "c", "--part", 2, "--packed", tmp_path / "new")
    assert code == 0, said
    assert read_packed(tmp_path / "new" / "tasks-2.xz")[0]


def test_proofs_that_are_no_dataset_are_refused_before_a_build(shipping, tmp_path):
    code, said = _run("--out", tmp_path / "c", "--part", 3, "--proofs", tmp_path / "nothing")
    assert code == 2
    assert "there is no dataset in" in said
    assert not (tmp_path / "c" / "parts").exists()


def test_all_parts_are_proved_and_gardens_of_held_out_homes_are_held_out(tmp_path):
    assert all(settings_of(recipe).physical and settings_of(recipe).reachability for recipe in PARTS.values())
    unpack(tmp_path)
    homes = {base_scene_of(record.task.scene_id) for record in Dataset.load(tmp_path).heldout}
    gardens = {scene.replace("_int", "_garden") for scene in homes & {*PARTS[1].scenes}}
    assert gardens
    assert gardens <= {*PARTS[2].scenes}  # a garden shows much of its home

"""Dataset pages of the dashboard, and their file access limits."""

import json
import threading
import tracemalloc
from dataclasses import replace

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from tests.fakes.scenes import kitchen_scene, kitchen_tasks
from tests.fakes.tiny_scene import tiny_task
from tests.fuzz.worst_bundle import bundle_with

from embomatrix.manager.web.floor_plan import floor_plan, moments_of, movable_objects
from embomatrix.manager.web.gallery import Gallery, no_tasks_yet
from embomatrix.manager.web.gallery_values import SceneName
from embomatrix.manager.web.rest import answer_errors
from embomatrix.manager.web.rest_tasks import NO_DATASET, task_routes
from embomatrix.rpc.status import NotFoundError, UnavailableError
from embomatrix.skills.parse import parse_plan, plan_to_json
from embomatrix.world.bundle import Bundle, encode_bundle
from embomatrix.world.dataset import TaskRecord, write_dataset
from embomatrix.world.inflation import bundle_digest

SCENE = kitchen_scene()
TASK = kitchen_tasks(SCENE)[0]
EVERY = {"search": "", "scene": "", "category": "", "offset": 0, "limit": 24}


@pytest.fixture
def folder(tmp_path):
    """Dataset whose tasks have a plain name, a name with a meaning in paths, and a script as name."""
    names = ("tidy", "..", "<script>alert(1)<b>")
    tasks = [replace(TASK, task_id=name, instruction=f"Please {name} up") for name in names]
    data = encode_bundle(Bundle(SCENE, {task.task_id: task for task in tasks}))
    digest = bundle_digest(data)
    oracle = tuple(plan_to_json(parse_plan("move 0\npick_up 0")))
    records = [TaskRecord(task, digest, "train", oracle, ("kitchen_0",), "kind") for task in tasks]
    write_dataset(tmp_path / "data", records, {digest: data})
    for name in ("transcripts", "trees", "pictures"):
        (tmp_path / "data" / name).mkdir()
    (tmp_path / "data" / "secret.md").write_text("nobody may read this")
    (tmp_path / "secret.md").write_text("nor this")
    return tmp_path / "data"


def digest_of(folder):
    return f"sha256:{next((folder / 'bundles').iterdir()).stem}"


async def test_tasks_are_found_by_words_and_scene_and_come_in_pages(folder):
    gallery = Gallery(folder)
    page = await gallery.page(**EVERY)
    assert [card.task_id for card in page.items] == ["tidy", "..", "<script>alert(1)<b>"]
    assert [(one.scene_id, one.tasks) for one in page.scenes] == [(SCENE.scene_id, 3)]
    assert page.categories == [TASK.category.value]
    found = await gallery.page(**{**EVERY, "search": "UP tidy"})
    assert [card.task_id for card in found.items] == ["tidy"]
    second = await gallery.page(**{**EVERY, "offset": 1, "limit": 1})
    assert (second.total, [card.task_id for card in second.items]) == (3, [".."])
    assert (await gallery.page(**{**EVERY, "scene": "elsewhere"})).total == 0


async def test_dataset_names_the_scenes_of_bundles(folder):
    gallery = Gallery(folder)
    assert await gallery.scenes(offset=0, limit=9) == [SceneName(digest_of(folder), SCENE.scene_id)]
    assert await gallery.scenes(offset=1, limit=9) == []


def test_manager_without_a_dataset_shows_no_tasks():
    app = FastAPI()
    answer_errors(app)
    app.include_router(task_routes(None))
    http = TestClient(app)
    assert http.get("/api/v1/tasks").json()["notice"] == NO_DATASET
    assert http.get("/api/v1/scenes").json() == []
    assert http.get("/api/v1/tasks/tidy").status_code == 404


async def test_task_page_shows_objects_transcript_and_tree(folder):
    (folder / "transcripts" / "tidy.md").write_text("**Mia** (need): tidy up")
    (folder / "trees" / "tidy.json").write_text(json.dumps({"kitchen_0": ["apple"]}))
    detail = await Gallery(folder).detail("tidy")
    assert (detail.transcript, detail.tree) == ("**Mia** (need): tidy up", {"kitchen_0": ["apple"]})
    assert [row.name for row in detail.objects] == list(TASK.table)
    assert {row.name for row in detail.objects if row.goal} == set(TASK.goal_objects) & set(TASK.table)
    assert len(detail.moments) == 3
    assert "kitchen_0" in detail.rooms


async def test_path_as_name_opens_no_file(folder):
    gallery = Gallery(folder)
    assert (await gallery.detail("..")).transcript == ""
    for name in ("../secret.md", "/etc/passwd", "transcripts/tidy", ""):
        with pytest.raises(NotFoundError, match="no task"):
            await gallery.detail(name)
    for digest in ("../../secret", "sha256:../../secret", f"sha256:{'0' * 64}"):
        with pytest.raises(NotFoundError, match="no task of the dataset"):
            await gallery.floor(digest)


async def test_link_out_of_the_folder_and_a_file_without_end_are_not_read(folder):
    (folder / "transcripts" / "tidy.md").symlink_to(folder.parent / "secret.md")
    (folder / "trees" / "tidy.json").write_text("[" * 400_000)
    detail = await Gallery(folder).detail("tidy")
    assert (detail.transcript, detail.tree) == ("", None)


async def test_picture_is_a_jpeg_or_none(folder):
    gallery, digest = Gallery(folder), digest_of(folder)
    with pytest.raises(NotFoundError, match="factory pictures"):
        await gallery.picture(digest)
    file = folder / "pictures" / f"{digest.removeprefix('sha256:')}.jpg"
    file.write_bytes(b"<svg onload='alert(1)'/>")
    with pytest.raises(NotFoundError, match="factory pictures"):
        await gallery.picture(digest)
    file.write_bytes(b"\xff\xd8\xff\xe0")
    assert await gallery.picture(digest) == b"\xff\xd8\xff\xe0"
    assert (await gallery.page(**EVERY)).items[0].picture


async def test_files_are_looked_at_in_threads_only(folder, monkeypatch):
    threads = []

    def noted(method):
        def called(*given, **named):
            threads.append(threading.get_ident())
            return method(*given, **named)

        return called

    for name in ("_card", "_file", "_path"):
        monkeypatch.setattr(Gallery, name, noted(getattr(Gallery, name)))
    gallery = Gallery(folder)
    await gallery.page(**EVERY)
    paged = len(threads)
    with pytest.raises(NotFoundError):
        await gallery.picture(digest_of(folder))
    assert 0 < paged < len(threads)
    assert threading.get_ident() not in threads


async def test_missing_or_damaged_dataset_is_reported(folder, tmp_path):
    with pytest.raises(UnavailableError, match="--dataset"):
        await Gallery(tmp_path / "nowhere").page(**EVERY)
    gallery = Gallery(folder)
    assert (await gallery.page(**EVERY)).total == 3
    (folder / "tasks.jsonl").write_text("{}\n")
    with pytest.raises(UnavailableError, match=r"tasks\.jsonl:1 is damaged"):
        await gallery.page(**EVERY)


async def test_dataset_is_shown_from_the_moment_that_its_records_are_there_until_they_are_gone(folder):
    records = folder / "tasks.jsonl"
    written = records.rename(folder / "elsewhere.jsonl")
    gallery = Gallery(folder)
    page = await gallery.page(**EVERY)
    assert (page.total, page.items, page.scenes, page.notice) == (0, [], [], no_tasks_yet(folder))
    assert f"factory starter --out={folder}" in page.notice
    assert await gallery.scenes(offset=0, limit=9) == []
    with pytest.raises(NotFoundError, match="no task 'tidy'"):
        await gallery.detail("tidy")
    written.rename(records)
    page = await gallery.page(**EVERY)
    assert (page.total, page.notice) == (3, "")
    assert (await gallery.detail("tidy")).floor.rooms
    records.unlink()
    assert (await gallery.page(**EVERY)).notice == no_tasks_yet(folder)
    with pytest.raises(NotFoundError, match="no task of the dataset"):
        await gallery.floor(digest_of(folder))


async def test_memory_of_a_dataset_with_hostile_bundles_is_bounded(tmp_path):
    bundles = [bundle_with({"abilities": 98_304 - number, "characters": 14_900_000}) for number in range(3)]
    records = [
        TaskRecord(replace(tiny_task(), task_id=f"t{number}"), bundle_digest(data), "train", (), (), "")
        for number, data in enumerate(bundles)
    ]
    write_dataset(tmp_path, records, {bundle_digest(data): data for data in bundles})
    del bundles
    gallery = Gallery(tmp_path)
    tracemalloc.start()
    try:
        for record in records:
            assert (await gallery.detail(record.task.task_id)).floor.rooms
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 200e6


def test_plan_moves_picked_objects_to_their_targets():
    things = movable_objects(SCENE, TASK)
    thing = next(iter(things))
    row = TASK.table.index(thing)
    target = next(name for name in TASK.table if SCENE.by_name[name].fixed)
    to = TASK.table.index(target)
    plan = parse_plan(f"move {row}\npick_up {row}\nmove {to}\nopen {to}\nplace {to} inside\nclose {to}")
    start, at_thing, carried, moved, opened, placed, closed = moments_of(SCENE, TASK, plan)
    assert (start.held, start.things) == ([], {})
    assert at_thing.robot != start.robot
    assert carried.held == [thing]
    assert moved.things[thing] == moved.robot
    assert (opened.active, closed.active) == ([target], [])
    x, y, _ = SCENE.box_of(target).center_m
    assert placed.held == []
    assert placed.things[thing] == pytest.approx([x, y], abs=0.01)


def test_failed_calls_of_a_plan_change_nothing():
    row = next(at for at, name in enumerate(TASK.table) if name in movable_objects(SCENE, TASK))
    plan = parse_plan(f"pick_up {row}\nmove {row}\npick_up {row}")
    start, refused, at_thing, carried = moments_of(SCENE, TASK, plan, failed={0})
    assert (refused.held, refused.robot, refused.call) == ([], start.robot, f"pick_up {TASK.table[row]}")
    assert at_thing.robot != start.robot
    assert carried.held == [TASK.table[row]]


def test_floor_plan_holds_rooms_and_objects():
    plan = floor_plan(SCENE)
    assert [room[0] for room in plan.rooms] == [room.name for room in SCENE.rooms]
    names = {piece[0] for piece in plan.pieces}
    assert {item.name for item in SCENE.objects if item.absent}.isdisjoint(names)
    assert all(west < east and south < north for _, west, south, east, north in (*plan.rooms, *plan.pieces))

"""The paper's judge of scenes: a model gets a labelled plan of each changed room and the layout tree."""

import base64
import io
import json
from importlib import resources

import pytest
from PIL import Image
from tests.fakes.chat_server import ChatServer
from typer.testing import CliRunner

from embomatrix.factory.commands.app import app
from embomatrix.factory.evaluate.judges import Impression, evaluate_looks, impression_of
from embomatrix.factory.evaluate.page import with_factory
from embomatrix.factory.evaluate.scenes import LIST, LayoutMethod
from embomatrix.factory.layout.generator import lay
from embomatrix.factory.layout.request import RequestedObject
from embomatrix.factory.pictures.sights import alone
from embomatrix.factory.scenes.editor import SceneEditor
from embomatrix.factory.task_import.sources import SourceText
from embomatrix.llm.endpoint import Endpoint
from embomatrix.llm.values import UnusableReplyError
from embomatrix.world.catalog import Catalog
from embomatrix.world.scene import Scene

MUG = RequestedObject(
    "mug", (("mug", Catalog.load().models_of("mug")[0].model_id),), rooms=("living_room_0",)
)
POINTS = {"correspondence": 0, "clutter": 1, "placement": 0.5, "explanation": "tidy, but for the corner"}
APPLE = """(define (problem apple)
    (:domain omnigibson)
    (:objects apple.n.01_1 - apple.n.01 breakfast_table.n.01_1 - breakfast_table.n.01)
    (:init (ontop apple.n.01_1 breakfast_table.n.01_1) (inroom breakfast_table.n.01_1 living_room_0))
    (:goal (not (ontop apple.n.01_1 breakfast_table.n.01_1)))
)"""


@pytest.fixture(scope="module")
def laid(flat: Scene) -> tuple[Scene, tuple[str, ...]]:
    editor = SceneEditor(flat)
    names = tuple(lay(editor, [MUG], 0).names.values())
    return editor.freeze("laid"), names


async def asked(laid: tuple[Scene, tuple[str, ...]], *script: str) -> tuple[Impression, ChatServer]:
    server = ChatServer(*script)
    with server.serving() as url:
        async with Endpoint(url, "sees-1") as endpoint:
            return await impression_of(endpoint, *laid, seed=0), server


async def test_judge_gets_the_plan_of_the_room_and_the_tree(laid) -> None:
    impression, server = await asked(laid, json.dumps(POINTS))
    assert impression.score == 8.5
    words, picture = server.requests[0]["messages"][0]["content"]
    scene, (mug,) = laid
    assert f'"{scene.by_name[mug].host}": {{"ontop": {{"{mug}": {{}}}}}}' in words["text"]
    data = base64.b64decode(picture["image_url"]["url"].partition(",")[2])
    assert Image.open(io.BytesIO(data)).format == "PNG"


async def test_points_beyond_the_rubric_are_rejected_and_retried(laid) -> None:
    wrong = json.dumps({**POINTS, "clutter": 5})
    _, server = await asked(laid, wrong, json.dumps(POINTS))
    assert "clutter: input should be less than or equal to 4" in server.requests[1]["messages"][-1]["content"]
    with pytest.raises(UnusableReplyError, match="scene judge"):
        await asked(laid, wrong)


def test_single_room_keeps_its_objects_and_walls(flat: Scene) -> None:
    room = alone(flat, "living_room_0")
    assert [each.name for each in room.rooms] == ["living_room_0"]
    assert {item.room for item in room.objects} == {"living_room_0"}
    assert 0 < len(room.walls) < len(flat.walls)
    with pytest.raises(KeyError):
        alone(flat, "moon_0")


async def test_every_method_has_its_mean_and_unusable_answers_are_counted() -> None:
    server = ChatServer(json.dumps(POINTS), *["no"] * 3)
    task = SourceText("apple", APPLE, "embomatrix", scene="Rs_int")
    done: list[int] = []
    with server.serving() as url:
        async with Endpoint(url, "sees-1") as endpoint:
            found = await evaluate_looks(
                endpoint, [task], [LayoutMethod.TREE, LayoutMethod.RANDOM], 0, done.append
            )
    assert found.figure("judge tree").value == 8.5
    assert found.notes == ("1 scenes got no usable answer.",)
    assert done == [1, 2]
    assert "| judge tree | 8.5 of 10 |" in with_factory("", [found])


def _fixed() -> list[tuple[str, str]]:
    text = (resources.files("embomatrix.factory.evaluate") / LIST).read_text(encoding="utf-8")
    return list(json.loads(text)["sample"])


def test_judging_layouts_without_a_model_is_an_error(tmp_path) -> None:
    sample = tmp_path / "sample.jsonl"
    lines = [json.dumps({"name": name, "bddl": APPLE}) for name, _ in _fixed()]
    sample.write_text("\n".join(lines))
    for command in (
        ["evaluate", "looks", "--sample", str(sample)],
        ["generate", "--out", str(tmp_path), "--look"],
    ):
        answer = CliRunner().invoke(app, command)
        assert answer.exit_code == 2
        assert "--llm URL and --model NAME" in " ".join(answer.output.split())

"""Layout levels one by one: room distribution, layout trees and object poses; then complete layouts in one flat."""

import json
import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
from tests.fakes.chat_server import ChatServer

from embomatrix.factory.assets.library import build_asset
from embomatrix.factory.furnish.roles import wall_height_m
from embomatrix.factory.layout.agent_interfaces import LAYOUT_AGENTS, AgentName, BriefError
from embomatrix.factory.layout.baselines import PoseWriter, lay_at_random
from embomatrix.factory.layout.distribution import DistributionError, distribute
from embomatrix.factory.layout.generator import lay
from embomatrix.factory.layout.hanging import Hanger
from embomatrix.factory.layout.model_agents import ModelLayoutAgents
from embomatrix.factory.layout.organization import LayoutTree, TreeError, organize
from embomatrix.factory.layout.request import RequestedObject
from embomatrix.factory.layout.values import (
    Branch,
    DistributionBrief,
    HostFacts,
    HostOffer,
    LayoutFailure,
    LayoutRelation,
    LayoutRoomFacts,
    ObjectBrief,
    RoomBrief,
)
from embomatrix.factory.scenes.check import check_scene
from embomatrix.factory.scenes.editor import LayoutReason, SceneEditor
from embomatrix.llm.batch import FailureLimit
from embomatrix.llm.endpoint import Endpoint, EndpointLimits
from embomatrix.llm.values import ChatRequest, EndpointError, Reply, Usage
from embomatrix.skills.limits import ROBOT
from embomatrix.world.catalog import Catalog

if TYPE_CHECKING:
    from embomatrix.world.scene import Scene

ON, IN = LayoutRelation.ONTOP, LayoutRelation.INSIDE
KITCHEN = LayoutRoomFacts("kitchen_0", "kitchen", (4.0, 4.0), ("countertop", "fridge"))
BEDROOM = LayoutRoomFacts("bedroom_0", "bedroom", (4.0, 4.0), ("bed", "nightstand"))
TABLE = HostFacts("breakfast_table_1", "breakfast_table", (HostOffer(ON, ((0.8, 1.2, 9.0),), 0.7),))
FRIDGE = HostFacts("fridge_1", "fridge", (HostOffer(IN, ((0.5, 0.5, 0.4),), 0.6),), closed=True)
PLATE = ObjectBrief("plate_1", "plate", (0.24, 0.24, 0.02))


def branch_to(name: str, tree: LayoutTree) -> Branch | None:
    return next((branch for branch in tree.branches() if branch.child == name), None)


def test_tree_round_trips_through_its_branches_with_parents_first():
    branches = [
        Branch("kitchen_0", ON, "table_1"),
        Branch("table_1", ON, "bowl_1"),
        Branch("bowl_1", IN, "apple_1"),
    ]
    tree = LayoutTree.of("kitchen_0", reversed(branches))
    assert list(tree.branches()) == branches
    assert tree.nested() == {
        "kitchen_0": {"ontop": {"table_1": {"ontop": {"bowl_1": {"inside": {"apple_1": {}}}}}}}
    }
    assert list(tree.pruned(["bowl_1"]).branches()) == branches[:2]


@pytest.mark.parametrize(
    ("branches", "problem"),
    [
        ([("a", "b"), ("a", "c"), ("root", "a"), ("c", "b")], "give every object one parent"),
        ([("a", "b"), ("b", "a")], "is not connected to the root"),
        ([("a", "root")], "as the root"),
    ],
)
def test_invalid_branches_raise_tree_error(branches, problem):
    with pytest.raises(TreeError, match=problem):
        LayoutTree.of("root", [Branch(parent, ON, child) for parent, child in branches])


def test_objects_go_to_usual_rooms_and_stay_with_related_objects():
    objects = (
        PLATE,
        ObjectBrief("alarm_clock_1", "alarm_clock", (0.05, 0.1, 0.1)),
        ObjectBrief("apple_1", "apple", (0.07, 0.07, 0.07), relation=ON, host="plate_1"),
    )
    found = distribute(DistributionBrief((KITCHEN, BEDROOM), objects)).rooms
    assert found == {"plate_1": "kitchen_0", "alarm_clock_1": "bedroom_0", "apple_1": "kitchen_0"}


def test_contradicting_room_demands_raise_distribution_error():
    objects = (
        ObjectBrief("plate_1", "plate", (0.24, 0.24, 0.02), rooms=("kitchen_0",)),
        ObjectBrief(
            "apple_1", "apple", (0.07, 0.07, 0.07), rooms=("bedroom_0",), relation=ON, host="plate_1"
        ),
    )
    with pytest.raises(DistributionError, match="belong together"):
        distribute(DistributionBrief((KITCHEN, BEDROOM), objects))


def test_failed_host_is_not_tried_again_and_unplaceable_object_is_left_out():
    brief = RoomBrief(KITCHEN, (TABLE,), (PLATE,))
    assert branch_to("plate_1", organize(brief)) == Branch("breakfast_table_1", ON, "plate_1")
    failed = LayoutFailure("plate_1", ON, "breakfast_table_1", LayoutReason.NO_FREE_SPOT, "full")
    floor = RoomBrief(KITCHEN, (TABLE,), (PLATE,), (failed,))
    assert branch_to("plate_1", organize(floor)) == Branch("kitchen_0", ON, "plate_1")
    nowhere = LayoutFailure("plate_1", ON, "kitchen_0", LayoutReason.BLOCKS_PATH, "")
    assert branch_to("plate_1", organize(RoomBrief(KITCHEN, (TABLE,), (PLATE,), (failed, nowhere)))) is None


def test_task_demands_override_host_choice():
    milk = ObjectBrief("milk_1", "carton_of_milk", (0.1, 0.1, 0.2), relation=IN, host="fridge_1")
    assert branch_to("milk_1", organize(RoomBrief(KITCHEN, (TABLE, FRIDGE), (milk,)))) == Branch(
        "fridge_1", IN, "milk_1"
    )


def models(category: str) -> tuple[tuple[str, str], ...]:
    return tuple((category, model.model_id) for model in Catalog.load().models_of(category)[:3])


def items(flat: "Scene") -> list[RequestedObject]:
    table = next(item.name for item in flat.objects if item.name.startswith("breakfast_table"))
    return [
        RequestedObject("bowl", models("bowl"), ON, table),
        RequestedObject("apple", models("apple"), beside=("bowl",)),
        RequestedObject("book", models("hardback")),
        RequestedObject("chair", models("armchair"), rooms=("living_room_0",)),
        RequestedObject("mirror", models("mirror"), rooms=("bathroom_0",)),
    ]


def test_layout_is_collision_free_and_deterministic(flat: "Scene") -> None:
    editor = SceneEditor(flat)
    layout = lay(editor, items(flat), 3)
    scene = editor.freeze("laid")
    assert not layout.failures
    assert check_scene(scene) == ()
    assert scene.by_name[layout.names["bowl"]].host == scene.by_name[layout.names["apple"]].host
    assert scene.by_name[layout.names["book"]].host
    assert scene.by_name[layout.names["mirror"]].pose_world_asset.position_m[2] > 1.0
    assert layout.names["book"] in layout.trees[scene.by_name[layout.names["book"]].room].drawn()
    again = SceneEditor(flat)
    assert lay(again, items(flat), 3).names == layout.names
    assert again.freeze("laid") == scene


def test_unplaceable_object_is_reported_and_others_are_placed(flat: "Scene") -> None:
    fridge = next(item.name for item in flat.objects if item.name.startswith("fridge"))
    layout = lay(
        SceneEditor(flat),
        [RequestedObject("bed", models("bed"), IN, fridge), RequestedObject("mug", models("mug"))],
        0,
    )
    (failure,) = layout.failures
    assert (failure.object_name, failure.reason) == ("bed", LayoutReason.TOO_LARGE)
    assert "mug" in layout.names


def test_random_layout_accounts_for_every_item(flat: "Scene") -> None:
    layout = lay_at_random(SceneEditor(flat), items(flat), 0)
    assert layout.names.keys() | {failure.object_name for failure in layout.failures} == {
        each.name for each in items(flat)
    }


class _Writer:
    """Model that gives one text after the other and keeps the questions."""

    def __init__(self, *texts: str) -> None:
        self.texts = list(texts)
        self.asked: list[ChatRequest] = []

    async def complete(self, request: ChatRequest) -> Reply:
        self.asked.append(request)
        return Reply(self.texts.pop(0), "writer-1", Usage(), "stop", 0.0)


def test_written_poses_are_taken_as_they_are(flat: "Scene") -> None:
    table = next(item.name for item in flat.objects if item.name.startswith("breakfast_table"))
    mugs = [RequestedObject(f"mug.n.04_{number}", models("mug"), ON, table) for number in (1, 2)]
    editor = SceneEditor(flat)
    writer = _Writer("[50, 50, 90]", "Here: [100, 50.5, 0]")
    with PoseWriter(writer) as poses:
        layout = poses.lay(editor, mugs, 0)
    box = editor.box_of(table)
    first, second = (editor.objects[layout.names[each.name]].pose_world_asset for each in mugs)
    assert first.position_m[:2] == pytest.approx(box.center_m[:2])
    assert first.yaw == pytest.approx(math.pi / 2)
    assert second.position_m[0] == pytest.approx(box.high_m[0])
    asked = [message.text for message in writer.asked[1].messages[-3:]]
    assert asked == ["mug on breakfast_table", "[50, 50, 90]", "mug on breakfast_table"]


@pytest.mark.parametrize("answer", ["Sure! On the table.", "[1, 2]", "[5000, 0, 0]", '{"x": 1}'])
def test_object_without_a_usable_pose_is_left_out(flat: "Scene", answer: str) -> None:
    mugs = [RequestedObject(f"mug_{number}", models("mug")) for number in (1, 2)]
    with PoseWriter(_Writer(answer, "[50, 50, 0]")) as poses:
        layout = poses.lay(SceneEditor(flat), mugs, 0)
    assert list(layout.names) == ["mug_2"]
    assert [failure.reason for failure in layout.failures] == [LayoutReason.NO_POSE]


def test_object_whose_host_has_no_place_is_left_out(flat: "Scene") -> None:
    plate = RequestedObject("plate_1", models("plate"), ON, "table_1")
    with PoseWriter(_Writer("[50, 50, 0]")) as poses:
        (failure,) = poses.lay(SceneEditor(flat), [plate], 0).failures
    assert failure.reason is LayoutReason.UNKNOWN_HOST


@pytest.mark.parametrize("name", AgentName)
def test_agent_interface_names_the_invalid_field_of_a_brief(name):
    with pytest.raises(BriefError, match="--schema"):
        LAYOUT_AGENTS[name].read('{"nonsense": 1}')
    assert LAYOUT_AGENTS[name].about


def test_wall_object_hangs_within_the_robots_reach(home):
    catalog = Catalog.load()
    camera = build_asset(catalog, "security_camera", catalog.models_of("security_camera")[0].model_id)
    editor = SceneEditor(home)
    pose = Hanger(editor, editor.rooms["kitchen_0"], np.random.default_rng(0)).on_wall(camera)
    assert pose.position_m[2] < ROBOT.reach_high_m < wall_height_m("security_camera")


def test_brief_round_trips_through_its_interface():
    interface = LAYOUT_AGENTS[AgentName.ORGANIZER]
    brief = RoomBrief(KITCHEN, (TABLE, FRIDGE), (PLATE,))
    assert interface.read(interface.brief.dump_json(brief).decode()) == brief
    assert json.loads(interface.to_json(interface.rules(brief)))[-1]["child"] == "plate_1"


def organized(*script: object, failure_limit: FailureLimit | None = None) -> tuple[LayoutTree, ChatServer]:
    server = ChatServer(*script)
    with server.serving() as url:
        endpoint = Endpoint(
            url, "small-1", limits=EndpointLimits(attempts=2, first_wait_s=0.01, timeout_s=5.0)
        )
        with ModelLayoutAgents(endpoint, endpoint, failure_limit=failure_limit) as agents:
            return agents.organize(RoomBrief(KITCHEN, (TABLE, FRIDGE), (PLATE,))), server


def branch(parent: str, child: str = "plate_1") -> str:
    return json.dumps({"branches": [{"parent": parent, "relation": "ontop", "child": child}]})


def test_model_organizes_a_room_after_feedback():
    tree, server = organized("I think", branch("unicorn_1"), branch("fridge_1"), branch("breakfast_table_1"))
    assert branch_to("plate_1", tree) in (
        Branch("breakfast_table_1", ON, "plate_1"),
        Branch("kitchen_0", ON, "plate_1"),
    )
    messages = [request["messages"][-1]["content"] for request in server.requests]
    assert "no complete JSON value" in messages[1]
    assert "is not connected to the root" in messages[2]


def test_rules_replace_a_model_with_unusable_answers():
    tree, server = organized("no", "no", "no")
    assert branch_to("plate_1", tree) == Branch("breakfast_table_1", ON, "plate_1")
    assert len(server.requests) == 3


def test_dead_endpoint_raises_or_falls_back_to_rules_within_the_failure_limit():
    broken = (500, {}, "broken", 0.0)
    with pytest.raises(EndpointError, match=r"room-organizer: the endpoint .* answered 500"):
        organized(broken)
    tree, server = organized(broken, failure_limit=FailureLimit(most=2))
    assert branch_to("plate_1", tree) == Branch("breakfast_table_1", ON, "plate_1")
    assert len(server.requests) == 2


def test_valid_tree_of_a_model_is_accepted():
    tree, server = organized(branch("kitchen_0"))
    assert branch_to("plate_1", tree) == Branch("kitchen_0", ON, "plate_1")
    assert "<brief>" in server.requests[0]["messages"][1]["content"]

"""Placed objects are reachable, judged by the standing poses of the runtime."""

from dataclasses import replace

import pytest

from embomatrix.factory.layout.generator import lay
from embomatrix.factory.layout.pending import MAX_MOVES, PendingObjects, Support
from embomatrix.factory.layout.request import RequestedObject
from embomatrix.factory.layout.values import LayoutFailure, LayoutRelation
from embomatrix.factory.scenes.editor import LayoutReason, SceneEditor
from embomatrix.factory.scenes.feasibility import SimulatedRobot
from embomatrix.factory.task_import.sources import SourceText
from embomatrix.factory.task_import.task import MAX_REDRAWN, ImportedTask, ImportOptions, import_problem
from embomatrix.world.catalog import Catalog
from embomatrix.world.geometry import Pose
from embomatrix.world.scene import Scene
from embomatrix.world.state import Relation

ON, IN, UNDER = LayoutRelation.ONTOP, LayoutRelation.INSIDE, LayoutRelation.UNDER
FLOOR = Support(None, "living_room_0")
BASKET = (("wicker_basket", "jqfftz"),)


def models(category: str) -> tuple[tuple[str, str], ...]:
    return tuple((category, model.model_id) for model in Catalog.load().models_of(category))


def named(scene: Scene, category: str) -> str:
    return next(item.name for item in scene.objects if item.name.startswith(category))


@pytest.fixture
def pending(flat: Scene) -> PendingObjects:
    bowls = sorted(models("bowl"), key=lambda each: -Catalog.load().model(*each).size_m[0])
    items = [
        RequestedObject("backpack", models("backpack")[:1]),
        RequestedObject("book", models("hardback")[:1], IN, "backpack"),
        RequestedObject("wide", (bowls[0], bowls[-1]), IN, "cabinet_1"),
        RequestedObject("other", bowls[:1], IN, "cabinet_1"),
    ]
    return PendingObjects(SceneEditor(flat), "living_room_0", items)


def test_shoes_under_a_bed_and_food_in_a_box_with_a_lid_are_reachable(flat: Scene) -> None:
    editor = SceneEditor(flat)
    layout = lay(
        editor,
        [
            RequestedObject("shoe", models("sandal"), UNDER, named(flat, "bed")),
            RequestedObject("box", (("carton", "cdmmwy"),), ON, "living_room_0"),
            RequestedObject("apple", models("apple")[:3], IN, "box"),
        ],
        0,
    )
    assert (layout.failures, layout.unreachable) == ((), ())
    with SimulatedRobot(editor.freeze("laid")) as robot:
        assert robot.can_pick_up(layout.names["shoe"])
        assert robot.can_pick_up(layout.names["apple"])


def test_host_of_an_unreachable_object_is_moved_a_limited_number_of_times(pending: PendingObjects) -> None:
    for _ in range(MAX_MOVES):
        pending.place("backpack", Pose((0.0, 0.0, 1.0)), (None, ""), FLOOR)
        pending.record_failure("book", IN, "backpack_1", LayoutReason.INACCESSIBLE, "too deep")
        assert pending.replace_host(pending.waiting["book"])
        failure = pending.failures[-1]
        assert (failure.object_name, failure.host, failure.reason) == (
            "backpack",
            "living_room_0",
            LayoutReason.INACCESSIBLE,
        )
        assert "backpack" in pending.waiting
        assert "backpack" not in pending.names
    pending.place("backpack", Pose((0.0, 0.0, 1.0)), (None, ""), FLOOR)
    pending.record_failure("book", IN, "backpack_3", LayoutReason.INACCESSIBLE, "too deep")
    assert not pending.replace_host(pending.waiting["book"])


def test_wide_object_is_replaced_to_fit_another_at_a_shared_host(pending: PendingObjects) -> None:
    pending.place("wide", Pose((0.0, 0.0, 1.0)), (None, ""), Support(Relation.INSIDE, "cabinet_1"))
    before = pending.placed["wide"].asset.size_m[0]
    pending.record_failure("other", IN, "cabinet_1", LayoutReason.NO_FREE_SPOT, "full")
    pending.next_model("other")
    assert pending.waiting["wide"].asset.size_m[0] < before
    assert not pending.abandoned
    assert not pending.failures
    pending.place("wide", Pose((0.0, 0.0, 1.0)), (None, ""), Support(Relation.INSIDE, "cabinet_1"))
    pending.record_failure("other", IN, "cabinet_1", LayoutReason.NO_FREE_SPOT, "full")
    pending.next_model("other")
    assert [failure.object_name for failure in pending.abandoned] == ["other"]


def test_object_in_a_full_room_replaces_spare_furniture(flat: Scene) -> None:
    editor = SceneEditor(flat)
    pending = PendingObjects(
        editor, "living_room_0", [RequestedObject("bed", models("bed")[:1], rooms=("living_room_0",))]
    )
    before = [item for item in flat.objects if item.room == "living_room_0" and item.fixed]
    pending.record_failure("bed", ON, "living_room_0", LayoutReason.NO_FREE_SPOT, "full")
    pending.next_model("bed")
    gone = [item for item in before if item.name not in editor.objects]
    assert len([item for item in gone if not item.host]) == 1
    assert pending.waiting["bed"].last_failure is not None
    assert not pending.failures


def test_spare_furniture_is_removed_for_unreachable_floor_objects_only(
    flat: Scene,
) -> None:
    editor = SceneEditor(flat)
    table = next(name for name, item in editor.objects.items() if item.room == "living_room_0" and item.fixed)
    items = [
        RequestedObject("bag", models("backpack")[:1], ON, "living_room_0"),
        RequestedObject("cup", models("mug")[:1], ON, table),
    ]
    pending = PendingObjects(editor, "living_room_0", items)
    before = len(editor.objects)
    pending.record_failure("cup", ON, table, LayoutReason.INACCESSIBLE, "too far")
    assert not pending.clear_floor(pending.waiting["cup"])
    assert len(editor.objects) == before
    pending.record_failure("bag", ON, "living_room_0", LayoutReason.INACCESSIBLE, "behind a sofa")
    assert pending.clear_floor(pending.waiting["bag"])
    assert len(editor.objects) < before
    assert [failure.object_name for failure in pending.failures] == ["cup"]


def test_named_furniture_stays_reachable_when_paths_to_other_furniture_may_be_blocked(flat: Scene) -> None:
    editor = SceneEditor(flat)
    editor.keep([named(flat, "fridge")])
    kitchen = editor.objects[named(flat, "fridge")].room
    pending = PendingObjects(editor, kitchen, [RequestedObject("booth", models("booth"), ON, kitchen)])
    stove = next(
        name for name, item in editor.objects.items() if item.room == kitchen and editor.is_spare(name)
    )
    pending.record_failure("booth", ON, kitchen, LayoutReason.BLOCKS_PATH, "narrow")
    pending.next_model("booth")
    assert "booth" in pending.waiting
    assert stove in editor.given_up
    assert named(flat, "fridge") not in editor.given_up


def test_many_objects_for_one_basket_are_packed(flat: Scene) -> None:
    """Four oranges of 8.5 cm only fit side by side in a basket with a floor 20 cm wide."""
    oranges = [
        RequestedObject(f"orange_{number}", (("orange", "ucstpm"),), IN, "basket") for number in range(4)
    ]
    basket = RequestedObject("basket", BASKET, ON, "living_room_0")
    layout = lay(SceneEditor(flat), [basket, *oranges], 0)
    assert layout.failures == ()


SHOE = """(define (problem shoes-0) (:domain omnigibson)
  (:objects sandal.n.01_1 - sandal.n.01 chair.n.01_1 - chair.n.01 floor.n.01_1 - floor.n.01 agent.n.01_1 - agent.n.01)
  (:init (ontop sandal.n.01_1 chair.n.01_1) (inroom chair.n.01_1 living_room_0)
         (inroom floor.n.01_1 living_room_0) (ontop agent.n.01_1 floor.n.01_1))
  (:goal (and (ontop sandal.n.01_1 floor.n.01_1))))"""
ONTO = "(ontop sandal.n.01_1 {})"
SHOE_ON_FLOOR = (
    SHOE.replace(ONTO.format("chair.n.01_1"), "START")
    .replace(ONTO.format("floor.n.01_1"), ONTO.format("chair.n.01_1"))
    .replace("START", ONTO.format("floor.n.01_1"))
)


def test_furniture_with_unreachable_contents_is_excluded_and_kept_as_fallback(
    flat: Scene,
) -> None:
    asked: list[str] = []

    def unreachable_at(bad: int):
        def method(editor, items, seed):
            asked.append(next((item.host for item in items if item.name.startswith("sandal")), ""))
            layout = lay(editor, items, seed)
            wrong = LayoutFailure("sandal.n.01_1", ON, asked[-1], LayoutReason.INACCESSIBLE, "too far")
            return replace(layout, unreachable=(wrong,)) if len(asked) <= bad else layout

        return method

    text = SourceText("shoes", SHOE, "embomatrix")
    second = import_problem(text, flat, options=ImportOptions(lay=unreachable_at(1), reachable=False))
    assert isinstance(second, ImportedTask)
    assert len(asked) == 2
    assert asked[0] != asked[1]
    asked.clear()
    assert isinstance(
        import_problem(text, flat, options=ImportOptions(lay=unreachable_at(99), reachable=False)),
        ImportedTask,
    )
    assert len(asked) > 1


def test_layout_with_unreachable_objects_is_redrawn_and_the_best_is_used(
    flat: Scene,
) -> None:
    drawn: list[Pose] = []

    def worst_at_first(editor, items, seed):
        layout = lay(editor, items, seed)
        drawn.append(editor.objects[layout.names["sandal.n.01_1"]].pose_world_asset)
        wrong = LayoutFailure(
            "sandal.n.01_1", ON, "living_room_0", LayoutReason.INACCESSIBLE, "behind a sofa"
        )
        return replace(layout, unreachable=(wrong,) * (2 if len(drawn) == 1 else 1))

    imported = import_problem(
        SourceText("shoes", SHOE_ON_FLOOR, "embomatrix"), flat, options=ImportOptions(lay=worst_at_first)
    )
    assert isinstance(imported, ImportedTask)
    assert len(drawn) == len(set(drawn)) == 1 + MAX_REDRAWN
    sandal = dict(zip(imported.instances, imported.about, strict=True))["sandal.n.01_1"]
    assert imported.scene.by_name[sandal].pose_world_asset == drawn[1]

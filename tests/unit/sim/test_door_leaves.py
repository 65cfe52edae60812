"""Open doors of pictures lie in rooms, beside their doorways and clear of furniture."""

import pytest

from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.sim.geometry.door_leaves import door_leaves
from embomatrix.world.geometry import IDENTITY


@pytest.fixture(scope="module", params=["Rs_int", "school_gym"])
def scene(request):
    return build_base_scene(request.param, seed=0)


def test_most_doors_between_rooms_have_a_leaf_of_their_width(scene):
    doorways = [each for each in scene.doorways if each.rooms[1] and each.width_m <= 1.2]
    leaves = door_leaves(scene)
    assert 0.6 * len(doorways) <= len(leaves) <= len(doorways)
    widths = {round(each.width_m, 6) for each in doorways}
    assert {round(max(leaf.size_m[:2]), 6) for leaf in leaves} <= widths


def test_leaves_are_clear_of_furniture_and_of_the_openings(scene):
    fixed = [scene.box_of(item.name) for item in scene.objects if item.fixed and not item.absent]
    for leaf in door_leaves(scene):
        box = leaf.aabb(IDENTITY)
        assert not any(box.overlaps(other) for other in fixed)
        assert scene.room_at(box.center_m)
        for doorway in scene.doorways:
            x, y = doorway.center_m
            assert not box.contains((x, y, 1.0), 0.2)

"""Furnished rooms have no visible absurdities."""

import pytest

from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.scenes.floor import box_of


@pytest.fixture(scope="module")
def scenes(flat):
    small = ("Benevolence_1_int", "Benevolence_2_int")
    return [flat, *(build_base_scene(name, seed=0) for name in small)]


def called(scene, *words):
    return [item for item in scene.objects if any(word in item.name for word in words)]


def over(one, other):
    """Return the horizontal overlap of two boxes in m²."""
    sides = [
        min(one.high_m[axis], other.high_m[axis]) - max(one.low_m[axis], other.low_m[axis]) for axis in (0, 1)
    ]
    return max(0.0, sides[0]) * max(0.0, sides[1])


def test_narrow_kitchen_keeps_its_sink(flat):
    assert any("sink" in item.name and item.room.startswith("kitchen") for item in flat.objects)


def test_nothing_but_chairs_stands_under_a_worktop_on_brackets(scenes):
    looked_at = 0
    for scene in scenes:
        for worktop in called(scene, "countertop"):
            box = box_of(scene, worktop)
            on_brackets = not any(
                over(box_of(scene, item), box) > 0.05 and "cabinet" in item.name for item in scene.objects
            )
            looked_at += on_brackets
            under = [
                item.name
                for item in scene.objects
                if on_brackets
                and item is not worktop
                and box_of(scene, item).high_m[2] <= box.low_m[2] + 0.01
                and over(box_of(scene, item), box) > 0.05
                and item not in called(scene, "chair", "stool", "carpet")
            ]
            assert not under, (scene.scene_id, worktop.name, under)
    assert looked_at

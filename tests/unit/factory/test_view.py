"""Scene view for task writers."""

from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.scenes.view import SceneView
from embomatrix.world.scene import Scene


def test_unsupported_object_is_on_floor_wall_or_ceiling() -> None:
    view = SceneView(build_base_scene("restaurant_diner"))
    places = {view.category(name): view.whereabouts(name) for name in view.scene.by_name}
    assert places["fridge"] == places["booth"] == "on the floor"
    assert places["mirror"] == "on the wall"
    assert places["room_light"] == "under the ceiling"


def test_supported_object_is_described_with_its_support(home: Scene) -> None:
    view = SceneView(home)
    borne = next(item for item in home.objects if item.host)
    assert view.whereabouts(borne.name) == f"{borne.relation} {borne.host}"

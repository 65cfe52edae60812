"""Scenes as plain JSON values, and back. Decoding trusts nothing.

The engine that is built from a scene takes what it is given: it drops the seventeenth part of a link in silence and dies of
a NaN. So every rule that it needs is checked here, and a SceneInvalidError names the field that breaks one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from embomatrix.world.codec_asset import (
    MAX_LINKS,
    asset_from_field,
    asset_to_json,
    check_unique,
    part_from_field,
    part_to_json,
    pose_from_field,
    pose_to_json,
)
from embomatrix.world.codec_plain import OBJECT_KEYS, plain_assets, plain_objects
from embomatrix.world.field import Field, SceneInvalidError
from embomatrix.world.scene import Doorway, RobotStart, Room, Scene, SceneObject, Window
from embomatrix.world.state import Relation, State, SubstanceFact, SubstanceRelation

if TYPE_CHECKING:
    from collections.abc import Mapping

    from embomatrix.world.asset import Asset
    from embomatrix.world.tables import Tables, TableWriter

    Json = dict[str, Any]

MAX_OBJECTS: Final = 5_000
MAX_WALLS: Final = 10_000
MAX_FLOOR_M2: Final = 40_000.0
"""Area of the rectangle around all rooms: the floor is covered with cells of 5 cm."""
RESERVED_NAMES: Final = frozenset(("wall", "floor"))
"""What the engine calls bodies that are no objects."""


def scene_to_json(scene: Scene, tables: TableWriter | None = None) -> Json:
    """The scene with the assets that its objects use, as JSON values in a fixed order.

    Poses and parts are rows of ``tables`` where they are given.
    """
    value: Json = {
        "scene_id": scene.scene_id,
        "base": scene.base,
        "seed": scene.seed,
        "rooms": [
            {"name": room.name, "type": room.type, "low_m": [*room.low_m], "high_m": [*room.high_m]}
            for room in scene.rooms
        ],
        "walls": [part_to_json(part, tables) for part in scene.walls],
        "doorways": [_doorway_to_json(doorway) for doorway in scene.doorways],
        "objects": [_object_to_json(item, tables) for item in scene.objects],
        "assets": {key: asset_to_json(asset, tables) for key, asset in sorted(scene.assets.items())},
        "robot": {
            "x_m": scene.robot.x_m,
            "y_m": scene.robot.y_m,
            "yaw": scene.robot.yaw,
            "room": scene.robot.room,
        },
        "left_out": [*scene.left_out],
    }
    if scene.windows:
        value["windows"] = [_window_to_json(window) for window in scene.windows]
    return value


def scene_from_json(value: object, tables: Tables | None = None) -> Scene:
    """A valid scene; ``tables`` hold the rows that it was written with. Raises SceneInvalidError naming the wrong field."""
    fields = Field(value, "scene", tables=tables).record(
        "scene_id",
        "base",
        "seed",
        "rooms",
        "walls",
        "doorways",
        "objects",
        "assets",
        "robot",
        "left_out",
        optional=("windows",),
    )
    assets = _assets(fields["assets"])
    rooms = tuple(_room(item) for item in fields["rooms"].items(at_most=1_000))
    scene = Scene(
        scene_id=fields["scene_id"].name(),
        base=fields["base"].text(),
        seed=fields["seed"].integer(),
        rooms=rooms,
        walls=tuple(part_from_field(item) for item in fields["walls"].items(at_most=MAX_WALLS)),
        doorways=tuple(_doorway(item) for item in fields["doorways"].items()),
        objects=_objects(fields["objects"], assets),
        assets=assets,
        robot=_robot(fields["robot"]),
        left_out=fields["left_out"].texts(),
        windows=tuple(_window(item) for item in fields["windows"].items()) if "windows" in fields else (),
    )
    _check_references(scene)
    return scene


def check_scene(scene: Scene) -> None:
    """Raise SceneInvalidError where a scene breaks a rule that decoding would refuse."""
    scene_from_json(scene_to_json(scene))


def _room(field: Field) -> Room:
    fields = field.record("name", "type", "low_m", "high_m")
    low, high = fields["low_m"].vec2(), fields["high_m"].vec2()
    if not (low[0] < high[0] and low[1] < high[1]):
        field.fail(f"low_m {low} must lie below high_m {high} on both axes")
    return Room(fields["name"].name(), fields["type"].name(), low, high)


def _doorway_to_json(doorway: Doorway) -> Json:
    return {
        "rooms": [*doorway.rooms],
        "center_m": [*doorway.center_m],
        "width_m": doorway.width_m,
        "height_m": doorway.height_m,
        "along": doorway.along,
        "model": doorway.model,
    }


def _doorway(field: Field) -> Doorway:
    fields = field.record("rooms", "center_m", "width_m", "height_m", "along", "model")
    rooms, along = _wall_between(field, fields)
    return Doorway(
        rooms=rooms,
        center_m=fields["center_m"].vec2(),
        width_m=fields["width_m"].number(),
        height_m=fields["height_m"].number(),
        along=along,
        model=fields["model"].text(),
    )


def _window_to_json(window: Window) -> Json:
    return {
        "rooms": [*window.rooms],
        "center_m": [*window.center_m],
        "width_m": window.width_m,
        "sill_m": window.sill_m,
        "head_m": window.head_m,
        "along": window.along,
        "model": window.model,
    }


def _window(field: Field) -> Window:
    fields = field.record("rooms", "center_m", "width_m", "sill_m", "head_m", "along", "model")
    rooms, along = _wall_between(field, fields)
    sill, head = fields["sill_m"].number(), fields["head_m"].number()
    if not 0.0 <= sill < head:
        field.fail(f"found a sill at {sill} m and a head at {head} m: expected 0 <= sill < head")
    return Window(
        rooms=rooms,
        center_m=fields["center_m"].vec2(),
        width_m=fields["width_m"].number(),
        sill_m=sill,
        head_m=head,
        along=along,
        model=fields["model"].text(),
    )


def _wall_between(field: Field, fields: Mapping[str, Field]) -> tuple[tuple[str, str], str]:
    """The rooms on either side of an opening and the axis that its wall runs along."""
    rooms = fields["rooms"].texts()
    along = fields["along"].text()
    if len(rooms) != 2 or along not in {"x", "y"}:
        field.fail(f"expected two rooms and a wall along x or y, found {list(rooms)} and {along[:20]!r}")
    return (rooms[0], rooms[1]), along


def _object_to_json(item: SceneObject, tables: TableWriter | None) -> Json:
    value: Json = {
        "name": item.name,
        "asset_id": item.asset_id,
        "room": item.room,
        "pose": pose_to_json(item.pose_world_asset, tables),
        "fixed": item.fixed,
        "joints": [*item.joints],
        "host": item.host,
        "relation": item.relation.value if item.relation is not None else "",
        "states": sorted(state.value for state in item.states),
    }
    if item.substances:
        value["substances"] = [[fact.relation.value, fact.substance] for fact in sorted(item.substances)]
    if item.absent:
        value["absent"] = True
    if item.pieces:
        value["pieces"] = [*item.pieces]
    return value


def _assets(field: Field) -> dict[str, Asset]:
    plain = plain_assets(field.value, field.tables) if field.tables is not None else None
    if plain is not None:
        return plain
    assets = {key: asset_from_field(item) for key, item in field.entries()}
    for key, asset in assets.items():
        if key != asset.asset_id:
            field.fail(f"asset {asset.asset_id!r} stands under the key {key!r}")
    return assets


def _objects(field: Field, assets: Mapping[str, Asset]) -> tuple[SceneObject, ...]:
    items = field.items(at_most=MAX_OBJECTS)
    plain = None
    if field.tables is not None:
        plain = plain_objects(
            field.value, assets, field.tables, lambda index: object_from_field(items[index], assets)
        )
    return plain if plain is not None else tuple(object_from_field(item, assets) for item in items)


def object_from_field(field: Field, assets: Mapping[str, Asset]) -> SceneObject:
    """An object of one of the assets, with a joint position for each of its joints."""
    fields = field.record(*OBJECT_KEYS, optional=("substances", "absent", "pieces"))
    asset_id = fields["asset_id"].text()
    if asset_id not in assets:
        fields["asset_id"].fail(f"unknown asset {asset_id[:80]!r}: the scene carries {len(assets)} others")
    joints = tuple(item.number() for item in fields["joints"].items(at_most=MAX_LINKS))
    count = len(assets[asset_id].joints)
    if len(joints) != count or not all(0.0 <= share <= 1.0 for share in joints):
        fields["joints"].fail(f"found {list(joints)}: expected {count} shares of travel between 0 and 1")
    return SceneObject(
        name=fields["name"].name(),
        asset_id=asset_id,
        room=fields["room"].text(),
        pose_world_asset=pose_from_field(fields["pose"]),
        fixed=fields["fixed"].flag(),
        joints=joints,
        host=fields["host"].text(),
        relation=fields["relation"].member(Relation) if fields["relation"].text() else None,
        states=frozenset(item.member(State) for item in fields["states"].items()),
        substances=frozenset(_substance(item) for item in fields["substances"].items())
        if "substances" in fields
        else frozenset(),
        absent=fields["absent"].flag() if "absent" in fields else False,
        pieces=fields["pieces"].texts() if "pieces" in fields else (),
    )


def _substance(field: Field) -> SubstanceFact:
    items = field.items(at_most=2)
    if len(items) != 2:
        field.fail(f"has {len(items)} items: expected a relation and a substance")
    return SubstanceFact(items[0].member(SubstanceRelation), items[1].name())


def _robot(field: Field) -> RobotStart:
    fields = field.record("x_m", "y_m", "yaw", "room")
    return RobotStart(
        fields["x_m"].number(), fields["y_m"].number(), fields["yaw"].number(), fields["room"].text()
    )


def _check_references(scene: Scene) -> None:
    rooms = [room.name for room in scene.rooms]
    names = [item.name for item in scene.objects]
    check_unique(Field(None, "scene.rooms"), rooms, "room")
    check_unique(Field(None, "scene.objects"), names, "object")
    # To a tenth of a millimetre: things that lie in one another make physics slow without end.
    present = [item.pose_world_asset.position_m for item in scene.objects if not item.absent]
    places = [f"({x:.4f}, {y:.4f}, {z:.4f})" for x, y, z in present]
    check_unique(Field(None, "scene.objects"), places, "position")
    _check_floor(scene)
    absent = {item.name for item in scene.objects if item.absent}
    known_rooms, known_names = {"", *rooms}, {"", *names}
    for index, item in enumerate(scene.objects):
        if item.name in RESERVED_NAMES:
            where = f"scene.objects[{index}].name"
            raise SceneInvalidError(
                where, f"found {item.name!r}: the engine calls something else so; rename it"
            )
        if item.room not in known_rooms:
            raise SceneInvalidError(f"scene.objects[{index}].room", f"unknown room {item.room!r}")
        if item.host not in known_names or item.host == item.name:
            raise SceneInvalidError(f"scene.objects[{index}].host", f"unknown host {item.host!r}")
        unknown = set(item.pieces) - absent
        if unknown:
            where = f"scene.objects[{index}].pieces"
            raise SceneInvalidError(where, f"found {min(unknown)!r}: expected an absent object of the scene")
    sides = {
        **{f"scene.doorways[{index}].rooms": item.rooms for index, item in enumerate(scene.doorways)},
        **{f"scene.windows[{index}].rooms": item.rooms for index, item in enumerate(scene.windows)},
    }
    for path, beside in sides.items():
        if not set(beside) <= known_rooms:
            raise SceneInvalidError(path, f"unknown room in {beside}")
    if scene.robot.room not in known_rooms:
        raise SceneInvalidError("scene.robot.room", f"unknown room {scene.robot.room!r}")
    _check_hosts(scene)


def _check_floor(scene: Scene) -> None:
    """Raise SceneInvalidError unless there is a floor, and one that a machine can hold in memory."""
    if not scene.rooms:
        raise SceneInvalidError("scene.rooms", "is empty: expected at least one room")
    width, depth = (
        max(room.high_m[axis] for room in scene.rooms) - min(room.low_m[axis] for room in scene.rooms)
        for axis in (0, 1)
    )
    if not width * depth <= MAX_FLOOR_M2:
        raise SceneInvalidError(
            "scene.rooms", f"lie within {width:g} x {depth:g} m: expected at most {MAX_FLOOR_M2:,.0f} m2"
        )


def _check_hosts(scene: Scene) -> None:
    """Raise SceneInvalidError where things rest on one another in a circle."""
    sound = {""}
    for index, item in enumerate(scene.objects):
        chain: list[str] = []
        name = item.name
        while name not in sound:
            if name in chain:
                where = f"scene.objects[{index}].host"
                raise SceneInvalidError(where, f"rests on itself: {' on '.join([*chain[:8], name])}")
            chain.append(name)
            name = scene.by_name[name].host
        sound.update(chain)

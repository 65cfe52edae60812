"""Scenes and assets as plain JSON values, and back. Decoding trusts nothing.

The engine that is built from a scene takes what it is given: it drops the seventeenth part of a link in silence and dies of
a NaN. So every rule that it needs is checked here, and a SceneInvalidError names the field that breaks one.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

from embomatrix.world.asset import Asset, Interior, Joint, JointKind, Link, SupportSurface
from embomatrix.world.field import Field, SceneInvalidError
from embomatrix.world.geometry import Part, Pose, Shape
from embomatrix.world.scene import Doorway, RobotStart, Room, Scene, SceneObject
from embomatrix.world.state import Relation, State

if TYPE_CHECKING:
    from collections.abc import Mapping

    from embomatrix.world.geometry import Vec3

    Json = dict[str, Any]

MAX_PARTS: Final = 16
"""Parts of a link: Bullet drops the rest of a compound in silence."""
MAX_LINKS: Final = 100
MAX_OBJECTS: Final = 5_000
MAX_VERTICES: Final = 512
MIN_EXTENT_M: Final = 1e-3
MAX_COORDINATE_M: Final = 1e4
QUAT_TOLERANCE: Final = 1e-4


def scene_to_json(scene: Scene) -> Json:
    """The scene with the assets that its objects use, as JSON values in a fixed order."""
    return {
        "scene_id": scene.scene_id,
        "base": scene.base,
        "seed": scene.seed,
        "rooms": [
            {"name": room.name, "type": room.type, "low_m": [*room.low_m], "high_m": [*room.high_m]}
            for room in scene.rooms
        ],
        "walls": [_part_to_json(part) for part in scene.walls],
        "doorways": [_doorway_to_json(doorway) for doorway in scene.doorways],
        "objects": [_object_to_json(item) for item in scene.objects],
        "assets": {key: asset_to_json(asset) for key, asset in sorted(scene.assets.items())},
        "robot": {
            "x_m": scene.robot.x_m,
            "y_m": scene.robot.y_m,
            "yaw": scene.robot.yaw,
            "room": scene.robot.room,
        },
        "left_out": [*scene.left_out],
    }


def scene_from_json(value: object) -> Scene:
    """A valid scene. Raises SceneInvalidError naming the field that is wrong."""
    fields = Field(value, "scene").record(
        "scene_id", "base", "seed", "rooms", "walls", "doorways", "objects", "assets", "robot", "left_out"
    )
    assets = {key: _asset(item) for key, item in fields["assets"].entries()}
    for key, asset in assets.items():
        if key != asset.asset_id:
            fields["assets"].fail(f"asset {asset.asset_id!r} stands under the key {key!r}")
    rooms = tuple(_room(item) for item in fields["rooms"].items(at_most=1_000))
    scene = Scene(
        scene_id=fields["scene_id"].name(),
        base=fields["base"].text(),
        seed=fields["seed"].integer(),
        rooms=rooms,
        walls=tuple(_part(item) for item in fields["walls"].items()),
        doorways=tuple(_doorway(item) for item in fields["doorways"].items()),
        objects=tuple(_object(item, assets) for item in fields["objects"].items(at_most=MAX_OBJECTS)),
        assets=assets,
        robot=_robot(fields["robot"]),
        left_out=fields["left_out"].texts(),
    )
    _check_references(scene)
    return scene


def check_scene(scene: Scene) -> None:
    """Raise SceneInvalidError where a scene breaks a rule that decoding would refuse."""
    scene_from_json(scene_to_json(scene))


def asset_to_json(asset: Asset) -> Json:
    return {
        "asset_id": asset.asset_id,
        "category": asset.category,
        "synset": asset.synset,
        "size_m": [*asset.size_m],
        "mass_kg": asset.mass_kg,
        "links": [_link_to_json(link) for link in asset.links],
        "supports": [
            {
                "name": surface.name,
                "center_m": [*surface.center_m],
                "size_m": [*surface.size_m],
                "clearance_m": surface.clearance_m,
                "interior": surface.interior,
            }
            for surface in asset.supports
        ],
        "interiors": [
            {
                "name": interior.name,
                "center_m": [*interior.center_m],
                "size_m": [*interior.size_m],
                "closed_by": [*interior.closed_by],
            }
            for interior in asset.interiors
        ],
        "abilities": {key: dict(sorted(params.items())) for key, params in sorted(asset.abilities.items())},
    }


def asset_from_json(value: object) -> Asset:
    """A valid asset. Raises SceneInvalidError naming the field that is wrong."""
    return _asset(Field(value, "asset"))


def pose_to_json(pose: Pose) -> list[float]:
    """x, y, z in metres and the quaternion x, y, z, w."""
    return [*map(float, pose.position_m), *map(float, pose.quat_xyzw)]


def pose_from_field(field: Field) -> Pose:
    """A pose with a unit quaternion and a position within reason."""
    x, y, z, qx, qy, qz, qw = field.numbers(7)
    norm = math.sqrt(qx * qx + qy * qy + qz * qz + qw * qw)
    if abs(norm - 1.0) > QUAT_TOLERANCE:
        field.fail(f"the quaternion has length {norm:.6g}: expected 1")
    if max(abs(x), abs(y), abs(z)) > MAX_COORDINATE_M:
        field.fail(
            f"the position ({x:g}, {y:g}, {z:g}) is further than {MAX_COORDINATE_M:g} m from the origin"
        )
    return Pose((x, y, z), (qx, qy, qz, qw))


def _part_to_json(part: Part) -> Json:
    value: Json = {"shape": part.shape.value, "pose": pose_to_json(part.pose), "size_m": [*part.size_m]}
    if part.vertices_m:
        value["vertices_m"] = [[*vertex] for vertex in part.vertices_m]
    return value


def _part(field: Field) -> Part:
    fields = field.record("shape", "pose", "size_m", optional=("vertices_m",))
    shape = fields["shape"].member(Shape)
    vertices: tuple[Vec3, ...] = ()
    if "vertices_m" in fields:
        vertices = tuple(item.vec3() for item in fields["vertices_m"].items(at_most=MAX_VERTICES))
    if (shape is Shape.HULL) != (len(vertices) >= 4):
        field.fail(
            f"a {shape.value} has {len(vertices)} vertices: expected {'4 or more' if shape is Shape.HULL else 0}"
        )
    return Part(shape, pose_from_field(fields["pose"]), _extent(fields["size_m"]), vertices)


def _extent(field: Field) -> Vec3:
    size = field.vec3()
    if min(size) <= MIN_EXTENT_M or max(size) > MAX_COORDINATE_M:
        field.fail(f"found {size}: expected every extent above {MIN_EXTENT_M} m")
    return size


def _link_to_json(link: Link) -> Json:
    value: Json = {"name": link.name, "parts": [_part_to_json(part) for part in link.parts]}
    if link.joint is not None:
        value["joint"] = {
            "kind": link.joint.kind.value,
            "origin_m": [*link.joint.origin_m],
            "axis": [*link.joint.axis],
            "upper": link.joint.upper,
        }
    return value


def _link(field: Field) -> Link:
    fields = field.record("name", "parts", optional=("joint",))
    parts = tuple(_part(item) for item in fields["parts"].items(at_most=MAX_PARTS))
    if not parts:
        fields["parts"].fail("is empty: expected at least one part")
    return Link(fields["name"].name(), parts, _joint(fields["joint"]) if "joint" in fields else None)


def _joint(field: Field) -> Joint:
    fields = field.record("kind", "origin_m", "axis", "upper")
    axis = fields["axis"].vec3()
    if math.hypot(*axis) < 1e-6:
        fields["axis"].fail("the axis is zero: expected a direction")
    upper = fields["upper"].number()
    if upper == 0:
        fields["upper"].fail("the joint has no travel: expected a number other than 0")
    return Joint(fields["kind"].member(JointKind), fields["origin_m"].vec3(), axis, upper)


def _asset(field: Field) -> Asset:
    fields = field.record(
        "asset_id", "category", "synset", "size_m", "mass_kg", "links", "supports", "interiors", "abilities"
    )
    links = tuple(_link(item) for item in fields["links"].items(at_most=MAX_LINKS))
    if not links or links[0].joint is not None or any(link.joint is None for link in links[1:]):
        fields["links"].fail("expected a base without a joint first, and a joint for every other link")
    _unique(fields["links"], [link.name for link in links], "link")
    mass = fields["mass_kg"].number()
    if mass <= 0:
        fields["mass_kg"].fail(f"found {mass}: expected more than 0 kg")
    interiors = tuple(_interior(item, links) for item in fields["interiors"].items())
    return Asset(
        asset_id=fields["asset_id"].name(),
        category=fields["category"].name(),
        synset=fields["synset"].text(),
        size_m=_extent(fields["size_m"]),
        mass_kg=mass,
        links=links,
        supports=tuple(_support(item, interiors) for item in fields["supports"].items()),
        interiors=interiors,
        abilities={
            ability: {key: number.number() for key, number in params.entries()}
            for ability, params in fields["abilities"].entries()
        },
    )


def _support(field: Field, interiors: tuple[Interior, ...]) -> SupportSurface:
    fields = field.record("name", "center_m", "size_m", "clearance_m", "interior")
    interior = fields["interior"].text()
    if interior and interior not in {item.name for item in interiors}:
        fields["interior"].fail(f"unknown interior {interior!r}")
    size = fields["size_m"].vec2()
    if min(size) <= MIN_EXTENT_M:
        fields["size_m"].fail(f"found {size}: expected every extent above {MIN_EXTENT_M} m")
    return SupportSurface(
        fields["name"].name(), fields["center_m"].vec3(), size, fields["clearance_m"].number(), interior
    )


def _interior(field: Field, links: tuple[Link, ...]) -> Interior:
    fields = field.record("name", "center_m", "size_m", "closed_by")
    closed_by = fields["closed_by"].texts()
    unknown = set(closed_by) - {link.name for link in links if link.joint is not None}
    if unknown:
        fields["closed_by"].fail(f"unknown moving link {min(unknown)!r}")
    return Interior(fields["name"].name(), fields["center_m"].vec3(), _extent(fields["size_m"]), closed_by)


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
    rooms = fields["rooms"].texts()
    along = fields["along"].text()
    if len(rooms) != 2 or along not in {"x", "y"}:
        field.fail(f"expected two rooms and a wall along x or y, found {list(rooms)} and {along[:20]!r}")
    return Doorway(
        rooms=(rooms[0], rooms[1]),
        center_m=fields["center_m"].vec2(),
        width_m=fields["width_m"].number(),
        height_m=fields["height_m"].number(),
        along=along,
        model=fields["model"].text(),
    )


def _object_to_json(item: SceneObject) -> Json:
    return {
        "name": item.name,
        "asset_id": item.asset_id,
        "room": item.room,
        "pose": pose_to_json(item.pose_world_asset),
        "fixed": item.fixed,
        "joints": [*item.joints],
        "host": item.host,
        "relation": item.relation.value if item.relation is not None else "",
        "states": sorted(state.value for state in item.states),
    }


def _object(field: Field, assets: Mapping[str, Asset]) -> SceneObject:
    fields = field.record("name", "asset_id", "room", "pose", "fixed", "joints", "host", "relation", "states")
    asset_id = fields["asset_id"].text()
    if asset_id not in assets:
        fields["asset_id"].fail(f"unknown asset {asset_id[:80]!r}: the scene carries {len(assets)} others")
    joints = tuple(item.number() for item in fields["joints"].items(at_most=MAX_LINKS))
    count = len(assets[asset_id].joints)
    if len(joints) not in {0, count} or not all(0.0 <= share <= 1.0 for share in joints):
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
    )


def _robot(field: Field) -> RobotStart:
    fields = field.record("x_m", "y_m", "yaw", "room")
    return RobotStart(
        fields["x_m"].number(), fields["y_m"].number(), fields["yaw"].number(), fields["room"].text()
    )


def _check_references(scene: Scene) -> None:
    rooms = [room.name for room in scene.rooms]
    names = [item.name for item in scene.objects]
    _unique(Field(None, "scene.rooms"), rooms, "room")
    _unique(Field(None, "scene.objects"), names, "object")
    _unique(
        Field(None, "scene.objects"),
        [str(item.pose_world_asset.position_m) for item in scene.objects],
        "position",
    )
    known_rooms, known_names = {"", *rooms}, {"", *names}
    for index, item in enumerate(scene.objects):
        if item.room not in known_rooms:
            raise SceneInvalidError(f"scene.objects[{index}].room", f"unknown room {item.room!r}")
        if item.host not in known_names or item.host == item.name:
            raise SceneInvalidError(f"scene.objects[{index}].host", f"unknown host {item.host!r}")
    for index, doorway in enumerate(scene.doorways):
        if not set(doorway.rooms) <= known_rooms:
            raise SceneInvalidError(f"scene.doorways[{index}].rooms", f"unknown room in {doorway.rooms}")
    if scene.robot.room not in known_rooms:
        raise SceneInvalidError("scene.robot.room", f"unknown room {scene.robot.room!r}")


def _unique(field: Field, names: list[str], kind: str) -> None:
    seen: set[str] = set()
    for name in names:
        if name in seen:
            field.fail(f"two of them have the {kind} {name!r}: expected each once")
        seen.add(name)

"""Scenes and assets encoded as JSON values and decoded again; ``records`` defines the JSON, ``tables`` the rows of bundles."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final, TypeVar

import msgspec
import numpy as np
from msgspec import UNSET

from embomatrix.world.asset import Asset, Credit, Interior, Joint, Link, SupportSurface
from embomatrix.world.geometry import ConvexPart, Pose, Shape
from embomatrix.world.records import (
    MAX_LINKS,
    AssetJson,
    BackgroundJson,
    LinkJson,
    ObjectJson,
    PartJson,
    PoseNumbers,
    SceneInvalidError,
    SceneJson,
    convert,
)
from embomatrix.world.scene import (
    ROOM_HEIGHT_M,
    BackgroundObject,
    Doorway,
    RobotStart,
    Room,
    Scene,
    SceneObject,
    Window,
)
from embomatrix.world.state import Relation, SubstanceFact
from embomatrix.world.tables import FLAT_HULL, Tables, TableWriter, check_unit, has_volume

Json = dict[str, Any]

T = TypeVar("T")
R = TypeVar("R")

MAX_FLOOR_M2: Final = 40_000.0
"""Area of the rectangle around all rooms: the navigation grid covers it with cells of 5 cm."""
RESERVED_NAMES: Final = frozenset(("wall", "floor", "background"))
"""Names of the engine for bodies that are not objects."""
_RELATIONS: Final = {"": None, **{relation.value: relation for relation in Relation}}


def scene_to_json(scene: Scene, tables: TableWriter | None = None) -> Json:
    """Encode a scene with its assets in a fixed order; with ``tables``, poses and parts become rows."""
    value: Json = {
        "scene_id": scene.scene_id,
        "base": scene.base,
        "seed": scene.seed,
        "rooms": [_room_to_json(room) for room in scene.rooms],
        "walls": [_part_to_json(part, tables) for part in scene.walls],
        "doorways": _builtins(scene.doorways),
        "objects": [_object_to_json(item, tables) for item in scene.objects],
        "assets": {key: asset_to_json(asset, tables) for key, asset in sorted(scene.assets.items())},
        "robot": _builtins(scene.robot),
        "left_out": [*scene.left_out],
    }
    if scene.windows:
        value["windows"] = _builtins(scene.windows)
    if scene.background:
        value["background"] = [_background_to_json(item, tables) for item in scene.background]
    return value


def _room_to_json(room: Room) -> Json:
    value: Json = _builtins(room)
    if room.height_m == ROOM_HEIGHT_M:
        del value["height_m"]
    return value


def asset_to_json(asset: Asset, tables: TableWriter | None = None) -> Json:
    """Encode an asset; with ``tables``, parts become rows."""
    value: Json = {
        "asset_id": asset.asset_id,
        "category": asset.category,
        "synset": asset.synset,
        "size_m": [*asset.size_m],
        "mass_kg": asset.mass_kg,
        "links": [
            {"name": link.name, "parts": [_part_to_json(part, tables) for part in link.parts]}
            | ({"joint": _builtins(link.joint)} if link.joint is not None else {})
            for link in asset.links
        ],
        "supports": [_surface_to_json(surface) for surface in asset.supports],
        "interiors": [_without_empty_link(interior) for interior in asset.interiors],
        "abilities": {key: dict(sorted(params.items())) for key, params in sorted(asset.abilities.items())},
    }
    if asset.credit is not None:
        value["credit"] = _builtins(asset.credit)
    return value


def scene_from_json(value: object) -> Scene:
    """Decode a scene. Raises SceneInvalidError with the path of the wrong value."""
    return scene_of(convert(value, SceneJson, "scene"))


def asset_from_json(value: object) -> Asset:
    """Decode an asset. Raises SceneInvalidError with the path of the wrong value."""
    return _each("asset", [convert(value, AssetJson, "asset")], lambda record: _asset(record, None))[0]


def scene_of(record: SceneJson, tables: Tables | None = None) -> Scene:
    """Scene of a record; ``tables`` hold the rows that it refers to. Raises SceneInvalidError."""
    assets: dict[str, Asset] = {}
    for key, asset in record.assets.items():
        try:
            assets[key] = _asset(asset, tables)
        except SceneInvalidError as error:
            raise error.below(f"scene.assets[{key!r}]") from error
        if key != asset.asset_id:
            raise SceneInvalidError(
                "scene.assets", f"asset {asset.asset_id!r} has the key {key!r}: expected its id"
            )
    texts: dict[str, str] = {}
    scene = Scene(
        scene_id=record.scene_id,
        base=record.base,
        seed=record.seed,
        rooms=_same(Room, record.rooms),
        walls=_each("scene.walls", record.walls, lambda part: _part(part, tables)),
        doorways=_same(Doorway, record.doorways),
        objects=_each("scene.objects", record.objects, lambda item: _object(item, assets, tables, texts)),
        assets=assets,
        robot=RobotStart(*msgspec.structs.astuple(record.robot)),
        left_out=record.left_out,
        windows=_same(Window, record.windows),
        background=_each(
            "scene.background", record.background, lambda item: _background(item, assets, tables, texts)
        ),
    )
    _check_references(scene)
    return scene


def _builtins(value: object) -> Any:
    return msgspec.to_builtins(value, enc_hook=float)  # numpy's scalars


def _surface_to_json(surface: SupportSurface) -> Json:
    found = _without_empty_link(surface)
    if not surface.framed:
        del found["framed"]
    return found


def _without_empty_link(value: SupportSurface | Interior) -> Json:
    found: Json = _builtins(value)
    if not value.link:
        del found["link"]
    return found


def pose_to_json(pose: Pose, tables: TableWriter | None = None) -> list[float] | int:
    """Numbers x, y, z in metres and the quaternion x, y, z, w; or the row of ``tables`` that holds them."""
    if tables is not None:
        return tables.pose(pose)
    return [*map(float, pose.position_m), *map(float, pose.quat_xyzw)]


def _part_to_json(part: ConvexPart, tables: TableWriter | None) -> Json | int:
    if tables is not None:
        return tables.part(part)
    value: Json = {"shape": part.shape.value, "pose": pose_to_json(part.pose), "size_m": [*part.size_m]}
    if part.vertices_m:
        value["vertices_m"] = [[*vertex] for vertex in part.vertices_m]
    return value


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


def _background_to_json(item: BackgroundObject, tables: TableWriter | None) -> Json:
    value: Json = {
        "asset_id": item.asset_id,
        "room": item.room,
        "pose": pose_to_json(item.pose_world_asset, tables),
    }
    return value | {"host": item.host} if item.host else value


def _same(kind: Callable[..., T], records: Iterable[msgspec.Struct]) -> tuple[T, ...]:
    """Values of a class with the same fields as the records, in the same order."""
    return tuple([kind(*msgspec.structs.astuple(record)) for record in records])


def _each(path: str, records: Sequence[R], build: Callable[[R], T]) -> tuple[T, ...]:
    """Values built of records; an error gets the path of the record."""
    made: list[T] = []
    for record in records:
        try:
            made.append(build(record))
        except SceneInvalidError as error:
            raise error.below(f"{path}[{len(made)}]") from error
    return tuple(made)


def _pose(value: PoseNumbers | int, tables: Tables | None) -> Pose:
    if tables is not None:
        return tables.pose(value)
    if isinstance(value, int):
        raise SceneInvalidError("pose", f"found row {value}: expected 7 numbers; only bundles have rows")
    check_unit("pose", value[3:])
    return Pose(value[:3], value[3:])


def _part(value: PartJson | int, tables: Tables | None) -> ConvexPart:
    if tables is not None:
        return tables.part(value)
    if isinstance(value, int):
        raise SceneInvalidError("", f"found row {value}: expected an object; only bundles have rows")
    if value.shape is Shape.HULL and not has_volume(np.asarray(value.vertices_m)):
        raise SceneInvalidError("vertices_m", FLAT_HULL)
    return ConvexPart(value.shape, _pose(value.pose, None), value.size_m, value.vertices_m)


def _asset(record: AssetJson, tables: Tables | None) -> Asset:
    links = _each("links", record.links, lambda link: _link(link, tables))
    if not links or links[0].joint is not None or any(link.joint is None for link in links[1:]):
        raise SceneInvalidError(
            "links", "expected a base without a joint first, and a joint for every other link"
        )
    _check_unique("links", [link.name for link in links], "link")
    # Bullet makes a body of each hull.
    bodies = len(links) + sum(part.shape is Shape.HULL for link in links for part in link.parts)
    if bodies > MAX_LINKS:
        raise SceneInvalidError(
            "links", f"make {bodies} bodies: expected at most {MAX_LINKS}; use fewer hulls or links"
        )
    interiors = _same(Interior, record.interiors)
    supports = _same(SupportSurface, record.supports)
    cavities = {"", *(interior.name for interior in interiors)}
    moving = {link.name for link in links[1:]}
    for index, interior in enumerate(interiors):
        _check_known(f"interiors[{index}].closed_by", interior.closed_by, moving, "moving link")
        _check_known(f"interiors[{index}].link", (interior.link,), moving | {""}, "moving link")
    for index, surface in enumerate(supports):
        _check_known(f"supports[{index}].interior", (surface.interior,), cavities, "interior")
        _check_known(f"supports[{index}].link", (surface.link,), moving | {""}, "moving link")
    credit = record.credit
    return Asset(
        asset_id=record.asset_id,
        category=record.category,
        synset=record.synset,
        size_m=record.size_m,
        mass_kg=record.mass_kg,
        links=links,
        supports=supports,
        interiors=interiors,
        abilities=record.abilities,
        credit=None if credit is UNSET else Credit(*msgspec.structs.astuple(credit)),
    )


def _link(record: LinkJson, tables: Tables | None) -> Link:
    parts = tuple([_part(part, tables) for part in record.parts])
    joint = record.joint
    return Link(record.name, parts, None if joint is UNSET else Joint(*msgspec.structs.astuple(joint)))


def _object(
    record: ObjectJson, assets: Mapping[str, Asset], tables: Tables | None, texts: dict[str, str]
) -> SceneObject:
    """Object of one of the assets. ``texts`` keeps one copy of equal texts: a fork then copies fewer pages of memory."""
    asset = _known_asset(record.asset_id, assets)
    if len(record.joints) != len(asset.joints):
        raise SceneInvalidError(
            "joints",
            f"found {list(record.joints)}: expected {len(asset.joints)} shares of travel between 0 and 1",
        )
    if record.relation not in _RELATIONS:
        raise SceneInvalidError(
            "relation", f"found {record.relation[:60]!r}: expected one of {', '.join(Relation)}, or nothing"
        )
    return SceneObject(
        record.name,
        asset.asset_id,
        texts.setdefault(record.room, record.room),
        _pose(record.pose, tables),
        record.fixed,
        record.joints,
        texts.setdefault(record.host, record.host),
        _RELATIONS[record.relation],
        frozenset(record.states),
        frozenset([SubstanceFact(*fact) for fact in record.substances]),
        record.absent,
        record.pieces,
    )


def _background(
    record: BackgroundJson, assets: Mapping[str, Asset], tables: Tables | None, texts: dict[str, str]
) -> BackgroundObject:
    """Background object of one of the assets; ``texts`` as in ``_object``."""
    return BackgroundObject(
        _known_asset(record.asset_id, assets).asset_id,
        texts.setdefault(record.room, record.room),
        _pose(record.pose, tables),
        texts.setdefault(record.host, record.host),
    )


def _known_asset(asset_id: str, assets: Mapping[str, Asset]) -> Asset:
    asset = assets.get(asset_id)
    if asset is None:
        raise SceneInvalidError(
            "asset_id", f"found {asset_id[:80]!r}: expected one of the scene's {len(assets)} assets"
        )
    return asset


def _check_known(path: str, names: Iterable[str], known: set[str], kind: str) -> None:
    for name in names:
        if name not in known:
            raise SceneInvalidError(
                path, f"found the unknown {kind} {name[:80]!r}: expected one that the scene defines"
            )


def _check_unique(path: str, names: Sequence[str], kind: str) -> None:
    if len(set(names)) < len(names):
        twice = next(name for index, name in enumerate(names) if name in names[:index])
        raise SceneInvalidError(path, f"two of them have the {kind} {twice!r}: expected each once")


def _check_references(scene: Scene) -> None:
    rooms = [room.name for room in scene.rooms]
    names = [item.name for item in scene.objects]
    _check_unique("scene.rooms", rooms, "room")
    _check_unique("scene.objects", names, "object")
    # Physics takes very long over objects at one point; positions are compared to 0.1 mm.
    present = [item.pose_world_asset.position_m for item in scene.objects if not item.absent]
    _check_unique("scene.objects", [f"({x:.4f}, {y:.4f}, {z:.4f})" for x, y, z in present], "position")
    _check_floor(scene)
    absent = {item.name for item in scene.objects if item.absent}
    known_rooms, known_names = {"", *rooms}, {"", *names}
    for index, item in enumerate(scene.objects):
        path = f"scene.objects[{index}]"
        if item.name in RESERVED_NAMES:
            raise SceneInvalidError(
                f"{path}.name", f"found {item.name!r}: the engine reserves this name; rename it"
            )
        if item.host == item.name:
            raise SceneInvalidError(
                f"{path}.host", f"found {item.host!r}: expected the name of another object in the scene"
            )
        _check_known(f"{path}.room", (item.room,), known_rooms, "room")
        _check_known(f"{path}.host", (item.host,), known_names, "host")
        if item.pieces:
            _check_known(f"{path}.pieces", item.pieces, absent, "absent object")
    for index, thing in enumerate(scene.background):
        _check_known(f"scene.background[{index}].room", (thing.room,), known_rooms, "room")
        _check_known(f"scene.background[{index}].host", (thing.host,), known_names, "host")
    for index, doorway in enumerate(scene.doorways):
        _check_known(f"scene.doorways[{index}].rooms", doorway.rooms, known_rooms, "room")
    for index, window in enumerate(scene.windows):
        _check_known(f"scene.windows[{index}].rooms", window.rooms, known_rooms, "room")
    _check_known("scene.robot.room", (scene.robot.room,), known_rooms, "room")
    _check_hosts(scene)


def _check_floor(scene: Scene) -> None:
    """Raise SceneInvalidError unless the navigation grid of the floor exists and fits in memory."""
    if not scene.rooms:
        raise SceneInvalidError("scene.rooms", "found no room: expected at least one")
    width, depth = (
        max(room.high_m[axis] for room in scene.rooms) - min(room.low_m[axis] for room in scene.rooms)
        for axis in (0, 1)
    )
    if not width * depth <= MAX_FLOOR_M2:
        raise SceneInvalidError(
            "scene.rooms", f"lie within {width:g} x {depth:g} m: expected at most {MAX_FLOOR_M2:,.0f} m2"
        )


def _check_hosts(scene: Scene) -> None:
    """Raise SceneInvalidError for objects that rest on one another in a circle."""
    sound = {""}
    for index, item in enumerate(scene.objects):
        chain: list[str] = []
        name = item.name
        while name not in sound:
            if name in chain:
                path = f"scene.objects[{index}].host"
                raise SceneInvalidError(path, f"rests on itself: {' on '.join([*chain[:8], name])}")
            chain.append(name)
            name = scene.by_name[name].host
        sound.update(chain)

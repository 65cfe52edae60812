"""Base scenes: rooms, walls, doorways and furniture made from an inventory or a house file."""

import logging
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Final

import numpy as np

from embomatrix.factory.assets.library import build_asset
from embomatrix.factory.clutter.background import with_background
from embomatrix.factory.floorplan.ceilings import ceiling_height_m
from embomatrix.factory.floorplan.house_file import House, HouseRoom
from embomatrix.factory.floorplan.houses import plan_house
from embomatrix.factory.floorplan.layout import FloorPlan, plan_floor
from embomatrix.factory.floorplan.spec import OpeningSpec, RoomSpec
from embomatrix.factory.furnish.pieces import FurniturePiece, Placed
from embomatrix.factory.furnish.roles import FurnitureRole, is_portable, role_of
from embomatrix.factory.furnish.rooms import Furnishing, furnish
from embomatrix.factory.furnish.space import RoomSpace
from embomatrix.factory.scenes.access import with_all_served
from embomatrix.factory.scenes.wishes import inventory_of
from embomatrix.world.asset import Asset
from embomatrix.world.catalog import Catalog, RoomInventory
from embomatrix.world.scene import RobotStart, Scene, SceneObject

logger = logging.getLogger(__name__)

PLANS: Final = 4
SMALL_HOUSE: Final = 250
PLANS_FOR_ESSENTIALS: Final = 12
LOSS_TAKEN: Final = 4.0
"""Loss of importance up to which a plan is accepted: a trash can may be left out, a cabinet or a bed may not."""
ESSENTIAL: Final = 15.0
"""Loss of importance up to which a plan is accepted after PLANS attempts: essential pieces get more attempts."""
USUAL_WINDOW: Final = OpeningSpec("", 1.2, 1.2)
"""Window of a house file's room."""
_FLAT_NAMES: Final = (
    "picture painting portrait information_bulletin periodic_table map projection_screen hanging_banners hanging "
    "architectural_plan"
)
_FLAT_ON_WALL: Final = frozenset(_FLAT_NAMES.split())


def build_base_scene(
    scene_id: str,
    *,
    seed: int = 0,
    imported: Mapping[str, Asset] = MappingProxyType({}),
    background: bool = True,
) -> Scene:
    """Lay out and furnish one of the catalog's inventories. Equal arguments give equal scenes.

    ``imported`` assets replace generated ones with the same id. Without ``background``, a home holds only the objects that
    its inventory lists. Raises CatalogError for an unknown scene, FloorPlanError if
    its rooms can't be joined.
    """
    catalog = Catalog.load()
    inventory = catalog.inventory(scene_id)
    rng = np.random.default_rng(np.random.SeedSequence((seed, zlib.crc32(scene_id.encode()))))
    pieces, notes = _pieces(catalog, inventory.rooms, imported)
    specs = [room_spec(catalog, room) for room in inventory.rooms]
    plan, result = _best_plan(lambda: plan_floor(specs, rng), pieces, rng)
    return _scene(scene_id, seed, plan, result, notes, background=background)


def build_house(
    house: House,
    *,
    seed: int = 0,
    imported: Mapping[str, Asset] = MappingProxyType({}),
    background: bool = True,
) -> Scene:
    """Lay out and furnish the floor plan of a house file. Equal arguments give equal scenes.

    ``imported`` and ``background`` are those of `build_base_scene`. Raises FloorPlanError if the doors leave no arrangement
    of the rooms.
    """
    catalog = Catalog.load()
    rng = np.random.default_rng(np.random.SeedSequence((seed, zlib.crc32(house.scene.encode()))))
    rooms = [inventory_of(catalog, room, rng) for room in house.rooms]
    specs = [
        _house_spec(catalog, room, inventory) for room, inventory in zip(house.rooms, rooms, strict=True)
    ]
    pieces, notes = _pieces(catalog, rooms, imported)
    plan, result = _best_plan(lambda: plan_house(house, specs, rng), pieces, rng)
    return _scene(house.scene, seed, plan, result, notes, background=background)


def _house_spec(catalog: Catalog, room: HouseRoom, inventory: RoomInventory) -> RoomSpec:
    """Return the spec of a house's room, with windows of the usual size and without doors."""
    height_m = room.height_m or ceiling_height_m(room.type, room.floor_m, _hanging(catalog, inventory))
    return RoomSpec(
        room.name, room.type, room.floor_m, windows=(USUAL_WINDOW,) * room.windows, height_m=height_m
    )


def _scene(
    scene_id: str,
    seed: int,
    plan: FloorPlan,
    result: Furnishing,
    notes: Sequence[str],
    *,
    background: bool,
) -> Scene:
    """Return the scene of a furnished floor plan. ``notes`` are sentences on what was left out before."""
    objects, assets = _objects(result.placed)
    scene = Scene(
        scene_id=scene_id,
        base=scene_id,
        seed=seed,
        rooms=plan.rooms,
        walls=(*plan.walls, *result.panels),
        doorways=plan.doorways,
        objects=objects,
        assets=assets,
        robot=_robot_start(plan, result.placed),
        left_out=(*notes, *plan.left_out, *result.left_out),
        windows=plan.windows,
    )
    scene = with_all_served(scene)
    scene = with_background(scene) if background else scene
    logger.info(
        "scene built id=%s seed=%d objects=%d background=%d left_out=%d",
        scene_id,
        seed,
        len(scene.objects),
        len(scene.background),
        len(scene.left_out),
    )
    return scene


def base_scene_of(scene_id: str) -> str:
    """Return the base scene of a variant or of a task's scene: ``Rs_int`` for ``Rs_int-train-003``."""
    return scene_id.split("-")[0]


def _best_plan(
    make_plan: Callable[[], FloorPlan], pieces: dict[str, list[FurniturePiece]], rng: np.random.Generator
) -> tuple[FloorPlan, Furnishing]:
    """Make and furnish plans until one loses nothing important; houses with many pieces get a single plan."""
    tried: list[tuple[FloorPlan, Furnishing]] = []
    small_house = sum(len(mine) for mine in pieces.values()) < SMALL_HOUSE
    for attempt in range(PLANS_FOR_ESSENTIALS if small_house else 1):
        plan = make_plan()
        tried.append((plan, furnish(plan, pieces, rng)))
        least_loss = min(result.loss for _, result in tried)
        if least_loss < (LOSS_TAKEN if attempt < PLANS - 1 else ESSENTIAL):
            break
    return min(tried, key=lambda pair: pair[1].loss)


def room_spec(catalog: Catalog, room: RoomInventory) -> RoomSpec:
    """Return floor, height, doors and windows of an inventory's room; openings are repeated as often as they are listed."""
    doors = []
    for category, model, count in room.doors:
        _, width, height = catalog.model(category, model).size_m
        doors += [OpeningSpec(model, width, height)] * count
    windows = []
    for category, model, count in room.windows:
        depth, width, height = catalog.model(category, model).size_m
        # The catalog lists flat models lying on their back: the face is at the top.
        face = (depth, width) if height < 0.1 else (max(depth, width), height)
        windows += [OpeningSpec(model, *face)] * count
    height_m = ceiling_height_m(room.type, room.floor_m, _hanging(catalog, room))
    return RoomSpec(room.name, room.type, room.floor_m, tuple(doors), tuple(windows), height_m)


def _hanging(catalog: Catalog, room: RoomInventory) -> Iterator[float]:
    """Yield the heights of the room's objects that hang from the ceiling."""
    for category, model, _ in room.items:
        size_m = catalog.model(category, model).size_m
        if role_of(category, size_m, catalog.category(category).mass_kg) is FurnitureRole.CEILING:
            yield size_m[2]


def _pieces(
    catalog: Catalog, rooms: Sequence[RoomInventory], imported: Mapping[str, Asset]
) -> tuple[dict[str, list[FurniturePiece]], list[str]]:
    """Return the items of every room as pieces, and sentences on items listed twice and on floors not modelled."""
    notes = [note for room in rooms for note in _floor_notes(room)]
    pieces: dict[str, list[FurniturePiece]] = {}
    seen: set[str] = set()
    number = 0
    # Large rooms first: a piece that spans two rooms, like a bar, is listed in both and stands in the larger one.
    for room in sorted(rooms, key=lambda r: -r.floor_m[0] * r.floor_m[1]):
        mine = pieces.setdefault(room.name, [])
        for category, model, count in room.items:
            asset = imported.get(f"{category}-{model}") or build_asset(catalog, category, model)
            if asset.asset_id in seen and max(asset.size_m[:2]) > max(room.floor_m) - 0.02:
                notes.append(
                    f"{count} {asset.asset_id} in {room.name}: listed in two rooms, it stands in the larger one"
                )
                continue
            seen.add(asset.asset_id)
            role = role_of(category, asset.size_m, asset.mass_kg)
            flat = category in _FLAT_ON_WALL and asset.size_m[2] < min(asset.size_m[:2])
            for _ in range(count):
                mine.append(
                    FurniturePiece(number, category, asset, role, upended=flat and role is FurnitureRole.WALL)
                )
                number += 1
    return pieces, notes


def _floor_notes(room: RoomInventory) -> list[str]:
    """Return sentences on floors that are estimated or only partly used."""
    notes = []
    if room.floor_estimated:
        notes.append(f"floor of {room.name}: none is listed; the median of its room type stands for it")
    if room.more_floors_m:
        more = ", ".join(f"{x:.1f} x {y:.1f} m" for x, y in room.more_floors_m)
        notes.append(
            f"{len(room.more_floors_m)} more floors of {room.name} ({more}): its largest one is the room"
        )
    return notes


def _objects(placed: Sequence[Placed]) -> tuple[tuple[SceneObject, ...], dict[str, Asset]]:
    counts: Counter[str] = Counter()
    names = []
    for item in placed:
        counts[item.piece.category] += 1
        names.append(f"{item.piece.category}_{counts[item.piece.category]}")
    objects = tuple(
        SceneObject(
            name=name,
            asset_id=item.piece.asset.asset_id,
            room=item.room,
            pose_world_asset=item.pose,
            fixed=item.piece.role is not FurnitureRole.SURFACE or not is_portable(item.piece.asset),
            joints=(0.0,) * len(item.piece.asset.joints),
            host=names[item.host] if item.host >= 0 else "",
            relation=item.relation,
        )
        for name, item in zip(names, placed, strict=True)
    )
    return objects, {item.piece.asset.asset_id: item.piece.asset for item in placed}


def _robot_start(plan: FloorPlan, placed: Sequence[Placed]) -> RobotStart:
    """Return the free place nearest to the centre of the largest public room, facing +x."""
    public = ("living_room", "corridor", "lobby", "entryway", "dining_room", "kitchen")
    rooms = sorted(plan.rooms, key=lambda r: (r.type not in public, -r.size_m[0] * r.size_m[1]))
    for room in rooms:
        space = RoomSpace(room, plan.doorways)
        space.occupy([box for p in placed if p.room == room.name for box in p.boxes])
        cells = space.free_cells()
        if len(cells):
            x, y = cells[np.argmin(np.hypot(*(cells - np.asarray(room.center_m)).T))]
            return RobotStart(float(x), float(y), 0.0, room.name)
    raise ValueError(f"no room of {[r.name for r in plan.rooms]} has a free spot for the robot: expected one")

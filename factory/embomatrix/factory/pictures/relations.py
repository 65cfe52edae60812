"""Pictures of every relation: small rendered scenes, each with the simulator's verdict."""

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from embomatrix.factory.assets.library import build_asset
from embomatrix.factory.pictures.sheet import in_rows
from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.bullet.photograph import Photographer
from embomatrix.sim.bullet.visual_scene import VisualScene
from embomatrix.sim.geometry.bounds import AssetBounds
from embomatrix.sim.looks.view import View
from embomatrix.sim.state.relations import Relations
from embomatrix.world.asset import Asset
from embomatrix.world.catalog import Catalog
from embomatrix.world.geometry import IDENTITY, Aabb, Pose, Vec3
from embomatrix.world.scene import RobotStart, Room, Scene, SceneObject
from embomatrix.world.state import Relation, State

MODELS: Final = {
    "table": ("breakfast_table", "pdpkuw"),
    "fridge": ("fridge", "juwaoh"),
    "bookcase": ("bookcase", "opryhp"),
    "cabinet": ("bottom_cabinet_no_top", "pluwfl"),
    "microwave": ("microwave", "ihxrvr"),
    "apple": ("apple", "omzprq"),
    "bowl": ("bowl", "kasebx"),
    "mug": ("mug", "ntgftr"),
    "carton": ("carton", "libote"),
}
ROOMS: Final = (
    Room("kitchen_0", "kitchen", (-2.0, -2.0), (2.0, -0.06)),
    Room("bathroom_0", "bathroom", (-2.0, 0.06), (2.0, 2.0)),
)
COLUMNS: Final = 4
PANEL_PX: Final = (300, 240)
LABEL_PX: Final = 40
LEAST_SPAN_M: Final = 0.3
"""Least object size that the camera's distance is computed for."""


@dataclass(frozen=True, slots=True)
class RelationPicture:
    """Case of a relation between object ``a`` and object ``b``, which stands upright with its front at +x.

    ``at_m`` is the centre of the underside of ``a``, relative to the centre of ``b`` and the surface ``on`` of ``b``. "top" is
    the top of ``b``, "" the floor. If ``b`` is one of `ROOMS`, ``at_m`` is in the world frame. ``open`` is the joints' share
    of travel. A relation of one object has no ``a``.
    """

    predicate: str
    a: str
    b: str
    at_m: Vec3
    note: str
    on: str = ""
    open: float = 0.0
    side: float = -1.3
    """Sideways offset of the camera in spans; positive looks past an open door."""
    above: float = 1.1
    """Height of the camera above its target in spans; small values show the gap between an object and a surface."""


PANELS: Final = (
    RelationPicture("ontop", "apple", "table", (0.1, 0.2, 0.0), "rests on its top", "top", above=0.06),
    RelationPicture(
        "ontop", "bowl", "bookcase", (0.05, 0.0, 0.0), "an open board is a surface", "shelf2_floor"
    ),
    RelationPicture(
        "ontop",
        "apple",
        "fridge",
        (0.1, 0.0, 0.0),
        "behind a door: inside, not ontop",
        "shelf2_floor",
        1.0,
        0.9,
    ),
    RelationPicture("ontop", "apple", "table", (0.1, 0.2, 0.05), "5 cm above its top", "top", above=0.06),
    RelationPicture(
        "inside", "apple", "fridge", (0.1, 0.0, 0.0), "its box is in a cavity", "shelf2_floor", 1.0, 0.9
    ),
    RelationPicture(
        "inside", "apple", "bowl", (0.0, 0.0, 0.0), "it may stick out of an open cavity", "inside_floor"
    ),
    RelationPicture(
        "inside", "apple", "microwave", (0.0, 0.0, 0.0), "a closed microwave has an inside", "inside_floor"
    ),
    RelationPicture("inside", "apple", "fridge", (0.0, 0.0, 0.0), "on top of it", "top"),
    RelationPicture("under", "carton", "table", (0.1, 0.2, 0.0), "the table is over its middle"),
    RelationPicture("under", "carton", "table", (0.0, 1.0, 0.0), "beside it"),
    RelationPicture("nextto", "apple", "mug", (0.0, 0.15, 0.0), "5 cm apart or less"),
    RelationPicture("nextto", "apple", "mug", (0.0, 0.35, 0.0), "too far for their sizes"),
    RelationPicture("touching", "apple", "carton", (0.0, -0.147, 0.0), "5 mm apart or less", side=0.0),
    RelationPicture("touching", "apple", "carton", (0.0, -0.19, 0.0), "nextto, and not touching", side=0.0),
    RelationPicture("inroom", "carton", "kitchen_0", (0.0, -0.11, 0.0), "its middle is over the floor"),
    RelationPicture("inroom", "carton", "kitchen_0", (0.0, 0.11, 0.0), "its middle is over the next room's"),
    RelationPicture("open", "", "cabinet", (0.0, 0.0, 0.0), "a joint past 5 % of its travel", open=0.5),
    RelationPicture("open", "", "cabinet", (0.0, 0.0, 0.0), "ajar by 4 %", open=0.04),
)


def draw_relations() -> Image.Image:
    """Return all panels in rows of four. Raises EngineError if pybullet is missing."""
    return in_rows([(_drawn(panel), "") for panel in PANELS], COLUMNS)


def verdict(panel: RelationPicture) -> bool:
    """Return the simulator's verdict on a panel's relation."""
    scene = panel_scene(panel)
    with contextlib.closing(BulletEngine(scene)) as engine:
        relations = Relations(engine)
        if panel.predicate == State.OPEN:
            return relations.open(panel.b)
        return relations.holds(Relation(panel.predicate), panel.a, panel.b)


def panel_scene(panel: RelationPicture) -> Scene:
    """Return a scene with the panel's objects on an empty floor."""
    catalog = Catalog.load()
    assets = {name: build_asset(catalog, *MODELS[name]) for name in (panel.b, panel.a) if name in MODELS}
    stands = {panel.b: (0.0, 0.0, 0.0), **({panel.a: _at(panel, assets)} if panel.a else {})}
    objects = tuple(
        SceneObject(
            name,
            asset.asset_id,
            ROOMS[0].name,
            _standing(asset, stands[name]),
            fixed=name == panel.b,
            joints=(panel.open if name == panel.b else 0.0,) * len(asset.joints),
        )
        for name, asset in assets.items()
    )
    start = RobotStart(-1.5, -1.5, 0.0, ROOMS[0].name)
    by_id = {asset.asset_id: asset for asset in assets.values()}
    return Scene("relations", "relations", 0, ROOMS, (), (), objects, by_id, start)


def _at(panel: RelationPicture, assets: Mapping[str, Asset]) -> Vec3:
    """Return the centre of the underside of ``a`` in the world; ``b`` stands on the floor."""
    x, y, z = panel.at_m
    if not panel.on:
        return panel.at_m
    support = assets[panel.b]
    surface = {item.name: item for item in support.supports}.get(panel.on)
    cx, cy, cz = surface.center_m if surface else (0.0, 0.0, support.size_m[2] / 2)
    return (cx + x, cy + y, cz + z + support.size_m[2] / 2)


def _standing(asset: Asset, at_m: Vec3) -> Pose:
    x, y, z = at_m
    return Pose((x, y, z - AssetBounds(asset).box(IDENTITY).low_m[2]))


def _drawn(panel: RelationPicture) -> Image.Image:
    scene = panel_scene(panel)
    with VisualScene(scene) as stage:
        if panel.predicate == Relation.INROOM:
            stage.add_floors()
        stage.add_objects()
        picture = Image.fromarray(np.asarray(_photographed(stage, _framed(scene, panel), panel)))
    whole = Image.new("RGB", (PANEL_PX[0], PANEL_PX[1] + LABEL_PX), "white")
    whole.paste(picture, (0, 0))
    holds = verdict(panel)
    pen = ImageDraw.Draw(whole)
    words = f"{panel.predicate}({', '.join(filter(None, (panel.a, panel.b)))})"
    color = "#1a7f37" if holds else "#b42318"
    pen.text(
        (8, PANEL_PX[1]), f"{words}: {'yes' if holds else 'no'}", fill=color, font=ImageFont.load_default(15)
    )
    pen.text((8, PANEL_PX[1] + 19), panel.note, fill="#666666", font=ImageFont.load_default(13))
    return whole


def _framed(scene: Scene, panel: RelationPicture) -> Aabb:
    """Return the box that the camera looks at: both objects, all of ``b`` if it hides ``a`` or is alone, else ``a``."""
    boxes = {
        item.name: AssetBounds(scene.asset_of(item.name)).box(item.pose_world_asset) for item in scene.objects
    }
    match panel.predicate:
        case "nextto" | "touching":
            return Aabb.around(boxes.values())
        case "under" | "open":
            return boxes[panel.b]
        case "inside" if not panel.open and scene.asset_of(panel.b).can("openable"):
            return boxes[panel.b]
        case _:
            return boxes[panel.a]


def _photographed(
    stage: VisualScene, box: Aabb, panel: RelationPicture
) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    span = max(LEAST_SPAN_M, *box.size_m)
    x, y, z = box.center_m
    eye = (x + 2.6 * span, y + panel.side * span, z + panel.above * span)
    view = View.toward(eye, (x, y, z), 32.0, PANEL_PX[0] / PANEL_PX[1], 0.05, 50.0)
    lit = Aabb((x - span, y - span, z - span), (x + span, y + span, z + span))
    return Photographer(stage).shoot(view, lit, *PANEL_PX).pixels

"""Import of model files: turned, scaled to the catalog's size, cut into convex parts, with the catalog's mass.

An imported model replaces one model of the catalog. It has that model's id, size, mass and abilities, so any scene that
lists the catalog's model can be built with it.
"""

import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from scipy.spatial import ConvexHull, QhullError
from trimesh.util import append_faces

from embomatrix.factory.assets.body import OPEN_ABOVE_M, Body
from embomatrix.factory.assets.shapes import box, hull, mesh_of, rounded
from embomatrix.factory.importers.cavities import cavities, solid_cells, top_surface
from embomatrix.factory.importers.convex import MAX_HULLS, MAX_VERTICES, Decomposer, merged
from embomatrix.factory.importers.hinges import linked
from embomatrix.factory.importers.meshes import GROUPED, read_groups
from embomatrix.factory.importers.model import AxisConvention, Mesh, ModelFileError, RawModel
from embomatrix.factory.importers.urdf import read_urdf
from embomatrix.world.asset import Asset, Credit, Joint, JointKind, Link
from embomatrix.world.catalog import Catalog, Model
from embomatrix.world.codec import asset_from_json, asset_to_json
from embomatrix.world.geometry import IDENTITY, Aabb, ConvexPart, FloatArray, Shape, Vec3

THIN_M: Final = 0.002
"""Least thickness of a part, in metres: the engine can't handle flat sheets."""
BOX_SHARE: Final = 0.97
"""A hull that fills this share of its bounding box is replaced by the box, which the engine tests fastest."""
CLOSING_SHARE: Final = 0.25
"""A link that covers this share of a cavity's opening closes it."""
TURN: Final = {
    # Rows: the asset's x, y, z axes in the file's frame, with its front at +z, its width along x and its height along y.
    AxisConvention.Y_UP: np.array(((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))),
    AxisConvention.Z_UP: np.eye(3),
}


@dataclass(frozen=True, slots=True)
class ImportedAsset:
    """Imported asset. ``stretch`` is the ratio of its largest to its smallest scale; 1 keeps the proportions.

    ``lacks`` has a sentence for each ability of the category that the model lacks.
    """

    asset: Asset
    stretch: float
    lacks: tuple[str, ...]


def read_model(path: Path, frame: AxisConvention | None = None) -> RawModel:
    """Read an OBJ, STL, GLB or URDF file. ``frame`` overrides the axis convention of the file's type.

    Raises ModelFileError for another type of file, and for one that is damaged or too large.
    """
    suffix = path.suffix.lower()
    if suffix == ".urdf":
        model = read_urdf(path)
    elif suffix in GROUPED:
        model = linked(
            read_groups(path), frame or (AxisConvention.Z_UP if suffix == ".stl" else AxisConvention.Y_UP)
        )
    else:
        kinds = ", ".join(sorted((*GROUPED, ".urdf")))
        raise ModelFileError(f"{path} ends in {suffix!r}: expected one of {kinds}")
    return RawModel(model.links, frame or model.frame)


def import_model(
    catalog: Catalog, raw: RawModel, category: str, model_id: str, credit: Credit, decompose: Decomposer
) -> ImportedAsset:
    """Make an asset that replaces a model of the catalog; without ``model_id``, the model with the most similar proportions.

    Raises CatalogError for an unknown category or model, ModelFileError if no asset can be made of the file.
    """
    turn = TURN[raw.frame]
    clouds = [mesh.vertices @ turn.T for link in raw.links for mesh in link.meshes]
    low = np.min([cloud.min(axis=0) for cloud in clouds], axis=0)
    high = np.max([cloud.max(axis=0) for cloud in clouds], axis=0)
    if (high - low).min() <= 0:
        raise ModelFileError(f"the model is {tuple(high - low)} large: expected a solid, not a sheet")
    entry = catalog.model(category, model_id) if model_id else _likest(catalog, category, high - low)
    scale = np.asarray(entry.size_m) / (high - low)
    transform = _Transform(turn, (low + high) / 2, scale)
    links = tuple(_link(number, raw, transform, decompose) for number in range(len(raw.links)))
    links = _exactly(links, entry)
    body = _places(links, entry.size_m)
    kind = catalog.category(category)
    asset = Asset(
        asset_id=entry.asset_id,
        category=category,
        synset=kind.synset,
        size_m=entry.size_m,
        mass_kg=kind.mass_kg,
        links=links,
        supports=tuple(body.supports),
        interiors=tuple(body.interiors),
        abilities=_abilities(kind.abilities, moves=len(links) > 1),
        credit=credit,
    )
    sound = asset_from_json(asset_to_json(asset))
    return ImportedAsset(sound, float(scale.max() / scale.min()), tuple(_lacks(sound, kind.abilities)))


def _lacks(asset: Asset, wanted: Mapping[str, Mapping[str, float]]) -> Iterator[str]:
    if "openable" in wanted and not asset.joints:
        yield f"the category {asset.category} is openable: this model has no group that moves"
    if not {"openable", "fillable"}.isdisjoint(wanted) and not asset.interiors:
        yield f"the category {asset.category} has an inside: this model has no cavity that is large enough"


def _abilities(known: Mapping[str, Mapping[str, float]], *, moves: bool) -> Mapping[str, Mapping[str, float]]:
    """Return the category's abilities; openable only if the model has a joint."""
    others = {name: values for name, values in known.items() if name != "openable"}
    return {"openable": known.get("openable", {}), **others} if moves else others


def _likest(catalog: Catalog, category: str, extents: FloatArray) -> Model:
    """Return the category's model with the most similar proportions."""

    def unlike(model: Model) -> float:
        ratios = np.log(np.asarray(model.size_m) / extents)
        return float(np.ptp(ratios))

    return min(catalog.models_of(category), key=unlike)


@dataclass(frozen=True, slots=True)
class _Transform:
    """Transform from the file's frame to the asset's: rotation, translation, scale along each axis."""

    turn: FloatArray
    middle: FloatArray
    scale: FloatArray

    def points(self, points: FloatArray) -> FloatArray:
        return np.asarray((points @ self.turn.T - self.middle) * self.scale)

    def joint(self, raw: RawModel, number: int) -> Joint | None:
        motion = raw.links[number].motion
        if motion is None:
            return None
        (origin,) = self.points(np.array([motion.origin]))
        axis = self.turn @ np.asarray(motion.axis)
        upper = motion.upper
        if motion.kind is JointKind.PRISMATIC:
            along = axis * self.scale
            upper *= float(np.linalg.norm(along) / np.linalg.norm(axis))
            axis = along
        return Joint(motion.kind, rounded(*origin), rounded(*(axis / np.linalg.norm(axis))), round(upper, 6))


def _link(number: int, raw: RawModel, transform: _Transform, decompose: Decomposer) -> Link:
    link = raw.links[number]
    pieces = [mesh.vertices for mesh in link.meshes if mesh.convex]
    meshes = [mesh for mesh in link.meshes if not mesh.convex]
    if meshes:
        # Joined meshes share the hulls that a link may have.
        vertices, faces = append_faces([mesh.vertices for mesh in meshes], [mesh.faces for mesh in meshes])
        joined = Mesh(np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64))
        pieces += decompose(joined, max(1, MAX_HULLS - len(pieces)))
    parts = tuple(convex_part(transform.points(piece)) for piece in merged(pieces, MAX_HULLS))
    name = "base" if number == 0 else link.name
    return Link(name, parts, transform.joint(raw, number))


def convex_part(points: FloatArray) -> ConvexPart:
    """Return the convex hull of points: a box if it nearly is one, else a hull with at most 64 corners."""
    low, high = points.min(axis=0), points.max(axis=0)
    thin = np.maximum(0.0, THIN_M - (high - low)) / 2
    if thin.any():
        return box(low - thin, high + thin)
    try:
        shape = ConvexHull(points)
    except QhullError:  # flat or a line, but not along an axis
        return box(low, high)
    if shape.volume >= BOX_SHARE * float(np.prod(high - low)):
        return box(low, high)
    return hull(_extremes(points[shape.vertices]))


def _extremes(corners: FloatArray) -> FloatArray:
    """Return at most 64 corners of a hull: the extreme ones along evenly spread directions."""
    if len(corners) <= MAX_VERTICES:
        return corners
    far = corners[np.unique((corners @ _directions().T).argmax(axis=0))]
    return np.asarray(far[ConvexHull(far).vertices])


@functools.cache
def _directions() -> FloatArray:
    """Return directions over the sphere (Fibonacci spiral), the six axes first, shape (64, 3)."""
    axes = np.vstack((np.eye(3), -np.eye(3)))
    k = np.arange(MAX_VERTICES - len(axes)) + 0.5
    z = 1 - 2 * k / len(k)
    turn = math.pi * (1 + math.sqrt(5)) * k
    flat = np.sqrt(1 - z * z)
    return np.vstack((axes, np.column_stack((flat * np.cos(turn), flat * np.sin(turn), z))))


def _exactly(links: Sequence[Link], entry: Model) -> tuple[Link, ...]:
    """Scale the links to the catalog's box exactly: cutting and thickening change it a little."""
    boxes = [part.aabb(IDENTITY) for link in links for part in link.parts]
    whole = Aabb.around(boxes)
    scale = np.asarray(entry.size_m) / np.asarray(whole.size_m)
    middle = np.asarray(whole.center_m)

    def drawn(part: ConvexPart) -> ConvexPart:
        points = (_points(part) - middle) * scale
        return hull(points) if part.shape is Shape.HULL else box(points.min(axis=0), points.max(axis=0))

    return tuple(Link(link.name, tuple(drawn(part) for part in link.parts), link.joint) for link in links)


def _points(part: ConvexPart) -> FloatArray:
    """Return the corners of a hull, or two opposite corners of an upright box."""
    if part.vertices_m:
        return part.pose.apply_all(np.asarray(part.vertices_m))
    half = np.asarray(part.size_m) / 2
    return np.asarray(np.asarray(part.pose.position_m) + np.array([-half, half]))


def _places(links: Sequence[Link], size_m: Vec3) -> Body:
    """Find the places for objects: the largest open surface of the base, and its cavities."""
    solid = solid_cells([_planes(part) for part in links[0].parts], size_m)
    body = Body()
    surface = top_surface(solid, size_m)
    found = cavities(solid, size_m)
    for number, space in enumerate(found, start=1):
        doors = tuple(link.name for link in links[1:] if _closes(link, space.box))
        name = f"shelf{number}" if len(found) > 1 else "inside"
        body.add_interior(name, space.box, doors, 0.0 if doors or space.roofed else OPEN_ABOVE_M)
    if surface is not None and all(surface.low_m[2] > space.box.center_m[2] for space in found):
        body.add_support("top", surface.low_m[:2], surface.high_m[:2], surface.high_m[2])
    return body


def _closes(link: Link, inside: Aabb) -> bool:
    """True if a moving link covers at least CLOSING_SHARE of the front or the top of a cavity."""
    box = Aabb.around(part.aabb(IDENTITY) for part in link.parts)
    shared = [
        max(0.0, min(b, d) - max(a, c))
        for a, b, c, d in zip(box.low_m, box.high_m, inside.low_m, inside.high_m, strict=True)
    ]
    width, depth, height = inside.size_m[1], inside.size_m[0], inside.size_m[2]
    front, top = shared[1] * shared[2] / (width * height), shared[0] * shared[1] / (depth * width)
    return (front if box.center_m[0] > inside.center_m[0] else 0.0) >= CLOSING_SHARE or (
        top if box.center_m[2] > inside.high_m[2] else 0.0
    ) >= CLOSING_SHARE


def _planes(part: ConvexPart) -> tuple[FloatArray, FloatArray]:
    """Return the half spaces of a part: normals (n, 3) and offsets (n,)."""
    mesh = mesh_of(part)
    return mesh.face_normals, np.einsum("ij,ij->i", mesh.face_normals, mesh.triangles[:, 0])

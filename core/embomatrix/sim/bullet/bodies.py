"""Bodies of assets in one Bullet client: shapes made once per asset, bodies in batches.

A body's frame is its asset's frame: inertial frames lie at the asset's origin, a link's at its joint. Bullet loses hulls in
compounds from memory, so hulls beside other parts get their own links with a fixed joint.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from embomatrix.sim.bullet.client import BulletClient
from embomatrix.sim.geometry.bounds import joint_motion
from embomatrix.world.asset import Asset, Joint, JointKind
from embomatrix.world.geometry import IDENTITY, ConvexPart, Pose, Shape, Vec3

HULL_MARGIN_M = 0.001
"""Bullet rounds hulls outwards by this much; their vertices are drawn in to compensate."""
PART_LIMIT = 16
"""Parts of a compound: Bullet silently drops the rest."""
ROLLING_FRICTION: Final = 2e-3
"""Slight rolling resistance, with which round food comes to rest."""
NO_SHAPE = -1
LEAST_PANEL_KG = 0.2
"""Least mass of a door panel: the solver needs masses of one order of magnitude."""


@dataclass(frozen=True, slots=True)
class CollisionPiece:
    """Collision shape of an asset in the frame of its link. ``parent`` is a piece's index; -1 marks the base."""

    shape: int
    origin_m: Vec3
    parent: int
    joint: Joint | None


_ROWS: Final[list[list[float]]] = []
"""Reused vertex lists: pybullet never frees a list that it was given."""


def _rows(vertices: Sequence[Sequence[float]]) -> list[list[float]]:
    """Copy the vertices into lists that are valid until the next call."""
    _ROWS.extend([] for _ in range(len(vertices) - len(_ROWS)))
    for row, vertex in zip(_ROWS, vertices, strict=False):
        row[:] = vertex
    return _ROWS[: len(vertices)]


class BodyFactory:
    """Makes bodies in one client. An asset's bodies share shapes, which live until the client is reset."""

    def __init__(self, client: BulletClient, flags: int = 0, *, plain: bool = False) -> None:
        """``flags`` are Bullet's, for every body.

        With ``plain``, single-piece bodies are rigid bodies instead of multi-bodies: they step three times as fast, but Bullet
        does not restore their saved states exactly.
        """
        self._bullet = client
        self._flags = flags
        self._plain = plain
        self._pieces: dict[int, tuple[Asset, tuple[CollisionPiece, ...]]] = {}

    def forget_shapes(self) -> None:
        """Drop the shapes' ids after a reset of the client, which frees the shapes."""
        self._pieces.clear()

    def jointed(self, asset: Asset, poses: Sequence[Pose]) -> tuple[int, ...]:
        """Immovable bodies of one asset, with its joints; their ids in the order of the poses."""
        pieces = self._pieces_of(asset)
        if len(pieces) > 1:
            return tuple(self._create([0.0] * len(pieces), pieces, pose) for pose in poses)
        ids = self._bullet.createMultiBody(
            0.0, pieces[0].shape, NO_SHAPE, batchPositions=[pose.position_m for pose in poses]
        )
        return (ids,) if isinstance(ids, int) else tuple(ids)

    def rigid(self, asset: Asset, pose: Pose, fractions: Sequence[float], mass_kg: float) -> int:
        """Body without joints, whose links are fixed at ``fractions``. A mass of 0 makes it immovable."""
        pieces = self._pieces_of(asset)
        motions = [
            joint_motion(joint, fraction)
            for (_, joint), fraction in zip(asset.joints, fractions, strict=True)
        ]
        return self._create([mass_kg / len(pieces)] * len(pieces), pieces, pose, motions)

    def brake(self, body: int) -> None:
        """Give a body slight resistance to rolling and spinning."""
        self._bullet.changeDynamics(
            body, -1, rollingFriction=ROLLING_FRICTION, spinningFriction=ROLLING_FRICTION
        )

    def hinged(self, asset: Asset, pose: Pose) -> int:
        """Body with an immovable base whose panels have mass and free joints.

        A panel's share of the asset's mass is proportional to the volume of its parts.
        """
        pieces = self._pieces_of(asset)
        volumes = [sum(math.prod(part.size_m) for part in link.parts) for link in asset.links]
        panels_kg = [max(LEAST_PANEL_KG, asset.mass_kg * volume / sum(volumes)) for volume in volumes]
        owners = [sum(other.joint is not None for other in pieces[: i + 1]) for i in range(len(pieces))]
        masses = [panels_kg[owner] / owners.count(owner) if owner else 0.0 for owner in owners]
        return self._create(masses, pieces, pose)

    def statics(self, parts: Sequence[ConvexPart]) -> tuple[int, ...]:
        """Immovable bodies that hold 16 parts each; part ``i`` is in body ``i // 16``."""
        chunks = [parts[i : i + PART_LIMIT] for i in range(0, len(parts), PART_LIMIT)]
        made = [self._link_pieces(chunk, (0.0, 0.0, 0.0), None, 0) for chunk in chunks]
        return tuple(self._create([0.0] * len(pieces), pieces, IDENTITY) for pieces in made)

    def floor(self, x_m: float, y_m: float, half_m: float) -> int:
        """Immovable square slab with its top at height 0, centred at a point."""
        slab = self._bullet.createCollisionShape(self._bullet.GEOM_BOX, halfExtents=(half_m, half_m, 0.25))
        return self._create(
            [0.0], (CollisionPiece(slab, (0.0, 0.0, 0.0), -1, None),), Pose((x_m, y_m, -0.25))
        )

    def joint_indices(self, asset: Asset) -> tuple[int, ...]:
        """Bullet's index of each joint of the asset, in the asset's order."""
        pieces = self._pieces_of(asset)
        return tuple(i - 1 for i, piece in enumerate(pieces) if piece.joint is not None)

    def _pieces_of(self, asset: Asset) -> tuple[CollisionPiece, ...]:
        """Shapes of an asset. Holding the asset keeps its id from being reused."""
        if id(asset) not in self._pieces:
            pieces: list[CollisionPiece] = []
            for link in asset.links:
                origin = link.joint.origin_m if link.joint is not None else (0.0, 0.0, 0.0)
                pieces += self._link_pieces(link.parts, origin, link.joint, len(pieces))
            self._pieces[id(asset)] = (asset, tuple(pieces))
        return self._pieces[id(asset)][1]

    def _link_pieces(
        self, parts: Sequence[ConvexPart], origin: Vec3, joint: Joint | None, first: int
    ) -> tuple[CollisionPiece, ...]:
        """Pieces of one link; the first takes index ``first`` and bears the joint."""
        ox, oy, oz = origin
        frame = Pose((-ox, -oy, -oz))
        plain = [part for part in parts if part.shape is not Shape.HULL]
        shapes = [self._compound(plain, frame)] if plain else []
        shapes += [self._hull(part, frame) for part in parts if part.shape is Shape.HULL]
        head = CollisionPiece(shapes[0] if shapes else NO_SHAPE, origin, 0 if first else -1, joint)
        return (head, *(CollisionPiece(shape, (0.0, 0.0, 0.0), first, None) for shape in shapes[1:]))

    def _compound(self, parts: Sequence[ConvexPart], frame: Pose) -> int:
        kinds = {
            Shape.BOX: self._bullet.GEOM_BOX,
            Shape.CYLINDER: self._bullet.GEOM_CYLINDER,
            Shape.SPHERE: self._bullet.GEOM_SPHERE,
        }
        poses = [frame @ part.pose for part in parts]
        return int(
            self._bullet.createCollisionShapeArray(
                shapeTypes=[kinds[part.shape] for part in parts],
                halfExtents=[tuple(extent / 2 for extent in part.size_m) for part in parts],
                radii=[part.size_m[0] / 2 for part in parts],
                lengths=[part.size_m[2] for part in parts],
                collisionFramePositions=[pose.position_m for pose in poses],
                collisionFrameOrientations=[pose.quat_xyzw for pose in poses],
            )
        )

    def _hull(self, part: ConvexPart, frame: Pose) -> int:
        scale = [max(0.1, 1 - 2 * HULL_MARGIN_M / extent) for extent in part.size_m]
        pose = frame @ part.pose
        return int(
            self._bullet.createCollisionShape(
                self._bullet.GEOM_MESH,
                vertices=_rows(
                    [[v * s for v, s in zip(vertex, scale, strict=True)] for vertex in part.vertices_m]
                ),
                collisionFramePosition=pose.position_m,
                collisionFrameOrientation=pose.quat_xyzw,
            )
        )

    def _create(
        self,
        masses_kg: Sequence[float],
        pieces: Sequence[CollisionPiece],
        pose: Pose,
        motions: Sequence[Pose] | None = None,
    ) -> int:
        """Body of these pieces with their masses. With ``motions``, one per joint, the joints are fixed there."""
        return int(
            self._bullet.createMultiBody(
                masses_kg[0],
                pieces[0].shape,
                NO_SHAPE,
                basePosition=pose.position_m,
                baseOrientation=pose.quat_xyzw,
                flags=self._flags,
                useMaximalCoordinates=self._plain and len(pieces) == 1,
                **self._links(masses_kg[1:], pieces[1:], motions),
            )
        )

    def _links(
        self, masses_kg: Sequence[float], pieces: Sequence[CollisionPiece], motions: Sequence[Pose] | None
    ) -> dict[str, Any]:
        if not pieces:
            return {}
        bullet, still = self._bullet, (0.0, 0.0, 0.0)
        kinds = {JointKind.REVOLUTE: bullet.JOINT_REVOLUTE, JointKind.PRISMATIC: bullet.JOINT_PRISMATIC}
        moving = iter(motions or ())
        poses = [
            next(moving) @ Pose(piece.origin_m)
            if motions is not None and piece.joint is not None
            else Pose(piece.origin_m)
            for piece in pieces
        ]
        free = motions is None
        return {
            "linkMasses": list(masses_kg),
            "linkCollisionShapeIndices": [piece.shape for piece in pieces],
            "linkVisualShapeIndices": [NO_SHAPE] * len(pieces),
            "linkPositions": [pose.position_m for pose in poses],
            "linkOrientations": [pose.quat_xyzw for pose in poses],
            "linkInertialFramePositions": [still] * len(pieces),
            "linkInertialFrameOrientations": [IDENTITY.quat_xyzw] * len(pieces),
            "linkParentIndices": [piece.parent for piece in pieces],
            "linkJointTypes": [
                kinds[piece.joint.kind] if free and piece.joint is not None else bullet.JOINT_FIXED
                for piece in pieces
            ],
            "linkJointAxis": [piece.joint.axis if piece.joint is not None else (0, 0, 1) for piece in pieces],
        }

"""Bodies of a scene's objects, walls and background in one client, each made on demand.

Making a body costs fifteen times as much as a distance query, and a rollout queries a tenth of its scene. Results do not
depend on which bodies exist: they are never stepped, only compared in pairs.
"""

from collections.abc import Iterator, Sequence
from typing import Final

from embomatrix.sim.bullet.bodies import PART_LIMIT, BodyFactory
from embomatrix.sim.bullet.client import BulletClient
from embomatrix.world.asset import Asset
from embomatrix.world.geometry import IDENTITY, Pose
from embomatrix.world.scene import Scene

_AWAY_M: Final = (0.0, 0.0, -1_000.0)


class SceneBodies:
    """Immovable bodies by the numbers of a scene's objects and static parts. The client must be empty.

    Static parts are the walls, then the background objects. Sixteen neighbours share a body.
    """

    def __init__(self, client: BulletClient, scene: Scene) -> None:
        self._bullet = client
        self._scene = scene
        self._factory = BodyFactory(client)
        self._objects: dict[int, int] = {}
        self._behind: set[int] = set()
        self.statics = (*scene.walls, *scene.background_parts)
        self._shared: dict[int, int] = {}
        """Bodies of static parts by the number of their first part."""

    def object(self, number: int, pose: Pose, fractions: Sequence[float]) -> int:
        """Body of an object at the pose, with its joints at these shares of their travel."""
        body = self._objects.get(number)
        if body is not None and number not in self._behind:
            return body
        asset = self._scene.assets[self._scene.objects[number].asset_id]
        if body is None:
            [body] = self._factory.jointed(asset, [pose])
            self._objects[number] = body
        self._put(body, pose)
        self._turn(body, asset, fractions)
        self._behind.discard(number)
        return body

    def leave_behind(self, number: int) -> None:
        """Mark an object as moved; its body follows on demand. Most moves are undone before a query."""
        self._behind.add(number)

    def put_away(self, number: int) -> None:
        """Move an object's body out of the scene until it is asked for again."""
        body = self._objects.get(number)
        if body is not None:
            self._bullet.resetBasePositionAndOrientation(body, _AWAY_M, IDENTITY.quat_xyzw)
            self._behind.add(number)

    @property
    def behind(self) -> tuple[int, ...]:
        """Objects that have moved since their bodies followed."""
        return tuple(self._behind)

    def owners(self) -> tuple[dict[int, int], dict[int, int]]:
        """Map bodies to the numbers of their objects, and bodies of static parts to the number of their first part."""
        return (
            {body: number for number, body in self._objects.items()},
            {body: first for first, body in self._shared.items()},
        )

    def missing(self) -> Iterator[int]:
        """Numbers of the objects without a body."""
        return (number for number in range(len(self._scene.objects)) if number not in self._objects)

    def first_of(self, static: int) -> int:
        """Number of the first part in the body of a static part. Walls and background share no body."""
        walls = len(self._scene.walls)
        return static - (static if static < walls else static - walls) % PART_LIMIT

    def static(self, first: int) -> int:
        """Body of static parts, given by the number of its first part."""
        if first not in self._shared:
            walls = len(self._scene.walls)
            end = first + PART_LIMIT
            parts = self.statics[first : min(end, walls) if first < walls else end]
            [self._shared[first]] = self._factory.statics(parts)
        return self._shared[first]

    def _put(self, body: int, pose: Pose) -> None:
        self._bullet.resetBasePositionAndOrientation(body, pose.position_m, pose.quat_xyzw)

    def _turn(self, body: int, asset: Asset, fractions: Sequence[float]) -> None:
        if not fractions:
            return
        links = self._factory.joint_indices(asset)
        for link, (_, joint), fraction in zip(links, asset.joints, fractions, strict=True):
            self._bullet.resetJointState(body, link, fraction * joint.upper)

"""Motion of doors, drawers and lids with the objects that they carry, up to the first obstacle."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

from embomatrix.sim.engine import FLOOR, WALL, PhysicsEngine
from embomatrix.sim.geometry.bounds import bounds_of
from embomatrix.sim.geometry.surfaces import link_frame
from embomatrix.sim.state.relations import Relations
from embomatrix.world.geometry import Aabb, Pose

PANEL_SLACK_M: Final = 0.02
"""Range around the panels' boxes in which obstacles are considered."""

HALVINGS: Final = 7
"""Bisection steps after a stop: the panel of a half-metre door ends within 2 mm of the obstacle."""


@dataclass(frozen=True, slots=True)
class CarriedObject:
    """Object that moves with a link: its pose before, and in the frame of the link."""

    name: str
    link: str
    before: Pose
    pose_link_object: Pose


def swing_panels(engine: PhysicsEngine, relations: Relations, name: str, shares: Sequence[float]) -> None:
    """Move all panels of an object through shares of their travel, with the objects they carry, up to the first obstacle."""
    DoorPanels(engine, relations, name).swing([(share,) * len(engine.joints(name)) for share in shares])


class DoorPanels:
    """Moving links of one object, with the objects that rest on or lie in them."""

    def __init__(self, engine: PhysicsEngine, relations: Relations, name: str) -> None:
        self._engine = engine
        self._name = name
        self._asset = engine.scene.asset_of(name)
        self._base = engine.pose(name)
        self._before = engine.joints(name)
        self._carried_objects = tuple(self._find_carried(relations))
        self._contacts: dict[str, frozenset[str]] = {}
        self._around: frozenset[str] = frozenset()

    @property
    def carried(self) -> tuple[str, ...]:
        """Names of the carried objects."""
        return tuple(item.name for item in self._carried_objects)

    def carried_poses(self, fractions: Sequence[float]) -> tuple[tuple[str, Pose], ...]:
        """Poses of the carried objects with the panels at these shares of their travel."""
        return tuple((item.name, self._carried_pose(item, fractions)) for item in self._carried_objects)

    def swing(self, course: Iterable[Sequence[float]]) -> tuple[int, str]:
        """Move through joint positions until something is in the way.

        Returns the number of positions reached, and the obstacle before the next: the name of a body, or of the carried object
        that hit something; "" at the end of the course. The panels stay at the last position reached.
        """
        stops = [self._before, *map(tuple, course)]
        self._around = self._neighbours(stops)
        reached, last = 0, self._before
        for fractions in stops[1:]:
            near = self._near_panels(fractions)
            if near or self._carried_objects:
                self._put(fractions)
                other = self._stopped_by(near)
                if other:
                    self._put(last)
                    return reached, other
            reached, last = reached + 1, fractions
        self._put(last)
        return reached, ""

    def advance(self, free: Sequence[float], blocked: Sequence[float]) -> None:
        """Bisect after a swing: move from reached joint positions as far as possible towards unreached ones."""
        low, high = 0.0, 1.0
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            fractions = [one + middle * (other - one) for one, other in zip(free, blocked, strict=True)]
            near = self._near_panels(fractions)
            self._put(fractions)
            low, high = (low, middle) if self._stopped_by(near) else (middle, high)
        self._put([one + low * (other - one) for one, other in zip(free, blocked, strict=True)])

    def restore(self) -> None:
        """Undo the swing exactly, to the bit."""
        self._put(self._before)
        for item in self._carried_objects:
            self._engine.set_pose(item.name, item.before)

    def _put(self, fractions: Sequence[float]) -> None:
        self._engine.set_joints(self._name, fractions)
        for name, pose in self.carried_poses(fractions):
            self._engine.set_pose(name, pose)

    def _carried_pose(self, item: CarriedObject, fractions: Sequence[float]) -> Pose:
        return link_frame(self._asset, self._base, fractions, item.link) @ item.pose_link_object

    def _stopped_by(self, near: frozenset[str]) -> str:
        """Body that the panels or their carried objects penetrate now; "" for none."""
        carried = frozenset(self.carried)
        # Most objects in and on the furniture are far from the moving panels.
        hit = self._hits(self._name, carried | (self._around - near))
        if hit:
            return hit
        # For a carried object the furniture itself counts: an object that sticks out of a drawer keeps it from closing.
        return next((name for name in self.carried if self._hits(name, carried - {name})), "")

    def _hits(self, name: str, ignore: frozenset[str]) -> str:
        """Body that the object penetrates and did not before; "" for none."""
        if not self._engine.penetrates(name, ignore=ignore):
            return ""
        return self._engine.penetrates(name, ignore=ignore | self._contacts_of(name))

    def _neighbours(self, stops: Sequence[Sequence[float]]) -> frozenset[str]:
        """Objects near the furniture during the swing."""
        bounds = bounds_of(self._asset)
        swept = Aabb.around(bounds.box(self._base, fractions) for fractions in stops)
        return frozenset(self._engine.near(swept.grown(PANEL_SLACK_M), frozenset((self._name,))))

    def _near_panels(self, fractions: Sequence[float]) -> frozenset[str]:
        """Objects, walls with background objects, and floor near any panel at these joint positions."""
        engine, near = self._engine, set[str]()
        for panel in bounds_of(self._asset).panel_boxes(self._base, fractions):
            box = panel.grown(PANEL_SLACK_M)
            near.update(engine.near(box))
            if panel.low_m[2] < 0.0:
                near.add(FLOOR)
            if engine.is_at_static(box):
                near.add(WALL)
        return frozenset(near - {self._name})

    def _contacts_of(self, name: str) -> frozenset[str]:
        """Bodies that the object penetrated before anything moved: built-in neighbours that block no door."""
        if name not in self._contacts:
            now = self._engine.joints(self._name)
            self.restore()
            found: set[str] = set()
            while other := self._engine.penetrates(name, ignore=frozenset(found)):
                found.add(other)
            self._contacts[name] = frozenset(found)
            self._put(now)
        return self._contacts[name]

    def _find_carried(self, relations: Relations) -> Iterable[CarriedObject]:
        """Objects that rest on or lie in a moving link, and the objects on or in those."""
        links = {surface.name: surface.link for surface in self._asset.supports if surface.link}
        links |= {interior.name: interior.link for interior in self._asset.interiors if interior.link}
        if not links:
            return
        seen = {self._name}
        waiting = [(other, "") for other in relations.resting_on(self._name)]
        while waiting:
            other, link = waiting.pop(0)
            host = relations.host_of(other)
            if not link and host is not None:
                link = links.get(host.spot, "")
            if not link or other in seen or self._engine.scene.by_name[other].fixed:
                continue
            seen.add(other)
            frame = link_frame(self._asset, self._base, self._before, link)
            pose = self._engine.pose(other)
            yield CarriedObject(other, link, pose, frame.inverse() @ pose)
            waiting += [(item, link) for item in relations.resting_on(other)]

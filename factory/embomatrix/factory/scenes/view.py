"""Index of a scene for task writing: affordances and places of its objects."""

from collections.abc import Mapping
from functools import cached_property
from typing import Final

from embomatrix.factory.assets.solids import Solids
from embomatrix.factory.furnish.roles import FurnitureRole, role_of
from embomatrix.factory.furnish.small_objects import NEVER_SWITCHED
from embomatrix.factory.scenes.joints import bumped_into
from embomatrix.sim.joints.swings import SWING
from embomatrix.skills.appliances import cold_source, cooks, freezes, heat_source, heats
from embomatrix.skills.limits import ROBOT
from embomatrix.world.asset import FLOOR_CATEGORY, Asset
from embomatrix.world.scene import Scene, SceneObject
from embomatrix.world.state import OPEN_FRACTION, Relation, State


class CapableRobot:
    """Feasibility of single actions from the start of a scene. Every action is possible; subclasses check it.

    Names are those of scene objects.
    """

    def can_pick_up(self, object_name: str) -> bool:
        """True if the robot can pick the object up."""
        return True

    def can_place(self, object_name: str, relation: Relation, host: str) -> bool:
        """True if the robot can place the object on or in the host."""
        return True

    def can_swing(self, name: str, *, shut: bool) -> bool:
        """True if the robot can open, or close, all doors and drawers of the object."""
        return True

    def can_switch(self, name: str, *, on: bool) -> bool:
        """True if the robot can switch the object on, or off."""
        return True

    def can_treat(self, object_name: str, source: str, state: State) -> bool:
        """True if the object can become hot, cooked or frozen at the source and is not so yet."""
        return True


MIN_SURFACE_M: Final = 0.18
"""Minimum extents of a surface for placement requests."""
MIN_CAVITY_M: Final = 0.12
LOW_SURFACE_M: Final = 0.15
HIGH_SURFACE_M: Final = 1.5
"""Heights above the floor between which tasks request placements."""
HUNG_M: Final = 0.05
"""Objects without support whose lower end is above this height hang."""


class SceneView:
    """Scene indexed for task writing, by the names of scene objects."""

    def __init__(self, scene: Scene, robot: CapableRobot | None = None) -> None:
        self.scene = scene
        self.robot = robot or CapableRobot()
        """Feasibility checks of the robot. By default everything is feasible."""
        self._opens: dict[str, bool] = {}

    @cached_property
    def in_room(self) -> Mapping[str, tuple[str, ...]]:
        """Object names by room, in scene order."""
        rooms: dict[str, list[str]] = {room.name: [] for room in self.scene.rooms}
        for item in self.scene.objects:
            rooms.setdefault(item.room, []).append(item.name)
        return {room: tuple(names) for room, names in rooms.items()}

    @cached_property
    def _of_kind(self) -> Mapping[tuple[str, str], tuple[str, ...]]:
        """Object names by category and room, in scene order."""
        kinds: dict[tuple[str, str], list[str]] = {}
        for item in self.scene.objects:
            kinds.setdefault((self.category(item.name), item.room), []).append(item.name)
        return {kind: tuple(names) for kind, names in kinds.items()}

    def item(self, name: str) -> SceneObject:
        return self.scene.by_name[name]

    def asset(self, name: str) -> Asset:
        return self.scene.asset_of(name)

    def category(self, name: str) -> str:
        return self.asset(name).category

    def room(self, name: str) -> str:
        return self.item(name).room

    def alike(self, name: str) -> tuple[str, ...]:
        """Return the objects of the same category in the same room, including this one."""
        return self._of_kind[self.category(name), self.room(name)]

    def floor_of(self, room: str) -> str:
        """Return the floor object of a room, or "" if it has none."""
        return next(
            (name for name in self.in_room.get(room, ()) if self.category(name) == FLOOR_CATEGORY), ""
        )

    def rooms_with(self, category: str) -> tuple[str, ...]:
        return tuple(room.name for room in self.scene.rooms if (category, room.name) in self._of_kind)

    def whereabouts(self, name: str) -> str:
        """Return the place of an object: ``ontop stove_1``, ``on the floor``, ``on the wall`` or ``under the ceiling``."""
        item = self.item(name)
        if item.host and item.relation is not None:
            return f"{item.relation.value} {item.host}"
        asset = self.asset(name)
        if role_of(asset.category, asset.size_m, asset.mass_kg) is FurnitureRole.CEILING:
            return "under the ceiling"
        return "on the wall" if self.scene.box_of(name).low_m[2] > HUNG_M else "on the floor"

    def is_portable(self, name: str) -> bool:
        """True if the robot can carry the object."""
        asset = self.asset(name)
        return not self.item(name).fixed and is_liftable(asset.size_m, asset.mass_kg)

    def is_surface(self, name: str) -> bool:
        """True for furniture with an open surface at working height."""
        item, asset = self.item(name), self.asset(name)
        base = item.pose_world_asset.position_m[2]
        return item.fixed and any(
            min(surface.size_m) >= MIN_SURFACE_M
            and LOW_SURFACE_M <= base + surface.center_m[2] <= HIGH_SURFACE_M
            for surface in asset.open_supports
        )

    def is_container(self, name: str) -> bool:
        """True for furniture or an appliance with a cavity."""
        item, asset = self.item(name), self.asset(name)
        base = item.pose_world_asset.position_m[2]
        return item.fixed and any(
            min(interior.size_m) >= MIN_CAVITY_M
            and base + interior.center_m[2] - interior.size_m[2] / 2 <= HIGH_SURFACE_M
            for interior in asset.interiors
        )

    def is_basket(self, name: str) -> bool:
        """True for a portable object with a cavity that is always open."""
        asset = self.asset(name)
        return not self.item(name).fixed and any(
            not interior.closed_by and min(interior.size_m[:2]) >= MIN_CAVITY_M
            for interior in asset.interiors
        )

    def takes(self, host: str, object_name: str, *, inside: bool) -> bool:
        """True if a cavity or an open surface of the host is larger than the object."""
        size, asset = sorted(self.asset(object_name).size_m), self.asset(host)
        if inside:
            return any(
                all(a < b for a, b in zip(size, sorted(interior.size_m), strict=True))
                for interior in asset.interiors
            )
        return any(
            min(surface.size_m) > size[0] and max(surface.size_m) > size[1] for surface in asset.open_supports
        )

    def is_openable(self, name: str) -> bool:
        return bool(self.asset(name).joints) and self.asset(name).can("openable")

    def is_switchable(self, name: str) -> bool:
        """True if a task may ask to open or switch the object: it is in reach and its name is unambiguous."""
        low = self.item(name).pose_world_asset.position_m[2] - self.asset(name).size_m[2] / 2
        return (
            self.category(name) not in NEVER_SWITCHED
            and low <= HIGH_SURFACE_M
            and (self.is_openable(name) or self.is_toggleable(name))
        )

    def is_open(self, name: str) -> bool:
        return any(share > OPEN_FRACTION for share in self.item(name).joints)

    def opens(self, name: str) -> bool:
        """True if the object's doors and drawers, if any, open without a collision."""
        if name not in self._opens:
            joints = len(self.asset(name).joints)
            self._opens[name] = not joints or not any(
                bumped_into(self.scene, self._solids, name, (share,) * joints) for share in SWING
            )
        return self._opens[name]

    @cached_property
    def _solids(self) -> Solids:
        return Solids.of_scene(self.scene)

    def is_toggleable(self, name: str) -> bool:
        return self.asset(name).can("toggleable")

    def is_on(self, name: str) -> bool:
        return State.TOGGLED_ON in self.item(name).states

    def thermal_effects(self, food: str, source: str) -> tuple[State, ...]:
        """Return the states that the source can give the food."""
        asset, place = self.asset(food), self.asset(source)
        heat, cold = heat_source(place), cold_source(place)
        effects: list[State] = []
        if cold is not None and freezes(cold) and asset.can("freezable"):
            effects.append(State.FROZEN)
        if heat is not None and heats(heat) and asset.can("heatable"):
            effects.append(State.HOT)
        if heat is not None and cooks(heat, asset):
            effects.append(State.COOKED)
        return tuple(effects)

    def is_source(self, name: str) -> bool:
        """True if food can be heated or frozen in or on the object."""
        heat, cold = heat_source(self.asset(name)), cold_source(self.asset(name))
        inside = any(source.requires_inside for source in (heat, cold) if source is not None)
        works = (heat is not None and heats(heat)) or (cold is not None and freezes(cold))
        return works and (self.is_container(name) if inside else self.is_surface(name))

    def hosts(self, name: str) -> tuple[str, ...]:
        """Return the supports of an object, from the nearest to the furniture on the floor."""
        chain: list[str] = []
        host = self.item(name).host
        while host and host not in chain:
            chain.append(host)
            host = self.item(host).host
        return tuple(chain)

    def rests(self, name: str, relation: Relation, host: str) -> bool:
        item = self.item(name)
        return item.host == host and item.relation is relation


def is_liftable(size_m: tuple[float, float, float], mass_kg: float) -> bool:
    """True if the arm can lift the object and the gripper can grasp it."""
    return mass_kg <= ROBOT.mass_kg and min(size_m) <= ROBOT.grip_m and max(size_m) <= ROBOT.extent_m

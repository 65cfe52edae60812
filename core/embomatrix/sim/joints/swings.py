"""Opening of doors, drawers and lids, with predictions for the scene as loaded."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from embomatrix.sim.engine import PhysicsEngine
from embomatrix.sim.geometry.bounds import bounds_of
from embomatrix.sim.geometry.surfaces import links_with_surfaces
from embomatrix.sim.joints.panels import PANEL_SLACK_M, DoorPanels
from embomatrix.sim.state.relations import Relations
from embomatrix.world.geometry import Aabb, Pose

SWING: Final = (0.25, 0.5, 0.75, 1.0)
"""Shares of its travel at which a door is checked for obstacles."""
LEAST_OPEN: Final = 0.5
"""A door that an obstacle stops before this share of its travel does not open."""
ZONE_SLACK_M: Final = PANEL_SLACK_M + 0.04
"""Range around the panels' paths and the objects there in which a change affects the swing."""


@dataclass(frozen=True, slots=True)
class PredictedSwing:
    """Result of opening an object, valid while nothing has changed in the zone around it."""

    fractions: tuple[float, ...]
    carried: tuple[tuple[str, Pose], ...]
    zone: Aabb


class Swings:
    """Opens the panels of an engine's objects.

    Swings in unchanged surroundings are predicted ahead; only moved objects need a look.
    """

    def __init__(self, engine: PhysicsEngine, relations: Relations) -> None:
        self._engine = engine
        self._relations = relations
        self._predicted: dict[str, PredictedSwing] = {}

    def open(self, name: str) -> str:
        """Open every panel of the object as far as possible. Return the obstacle that stops them too early; "" for none.

        Stopped panels return to their start.
        """
        predicted = self._predicted.get(name)
        if predicted is not None and not self._has_changed(name, predicted.zone):
            self._engine.set_joints(name, predicted.fractions)
            for item, pose in predicted.carried:
                self._engine.set_pose(item, pose)
            return ""
        return _opened(DoorPanels(self._engine, self._relations, name), _course(self._engine.joints(name)))

    def warm_up(self) -> Iterator[None]:
        """Predict the opening of each object in the scene as loaded, one object per step. Changes no answer.

        Predictions are made only in the unchanged scene.
        """
        for item in self._engine.scene.objects:
            if item.joints and not item.absent and not self._engine.state_bytes():
                self._predict(item.name)
                yield

    def is_predicted(self, name: str) -> bool:
        """Return True if the opening of the object is predicted for unchanged surroundings."""
        return name in self._predicted

    def obstacle(self, name: str, goal: float) -> str:
        """Body that stops the panels on their way to a share of their travel, 0 or 1; "" for none. Changes nothing."""
        before = self._engine.joints(name)
        panels = DoorPanels(self._engine, self._relations, name)
        shut = [[min(share, fraction) for fraction in before] for share in (*reversed(SWING), 0.0)]
        _, other = panels.swing(_course(before) if goal else shut)
        panels.restore()
        return other

    def _predict(self, name: str) -> None:
        panels = DoorPanels(self._engine, self._relations, name)
        before = self._engine.joints(name)
        if not _opened(panels, _course(before)):
            fractions = self._engine.joints(name)
            panels.restore()
            zone = self._zone(name, panels, [before, *_course(before)])
            self._predicted[name] = PredictedSwing(fractions, panels.carried_poses(fractions), zone)

    def _zone(self, name: str, panels: DoorPanels, stops: Sequence[Sequence[float]]) -> Aabb:
        """Region of the panels' paths, the carried objects and everything around: its contents decide what is carried."""
        engine, scene = self._engine, self._engine.scene
        asset, pose = scene.asset_of(name), engine.pose(name)
        boxes: list[Aabb] = []
        for fractions in stops:
            boxes.append(bounds_of(asset).box(pose, fractions))
            boxes += bounds_of(asset).panel_boxes(pose, fractions)
            for item, carried in panels.carried_poses(fractions):
                boxes.append(bounds_of(scene.asset_of(item)).box(carried, engine.joints(item)))
        if links_with_surfaces(asset) - {""}:
            around = engine.near(engine.aabb(name).grown(ZONE_SLACK_M))
            boxes += [engine.aabb(other) for other in around if not scene.by_name[other].fixed]
        return Aabb.around(boxes).grown(ZONE_SLACK_M)

    def _has_changed(self, name: str, zone: Aabb) -> bool:
        """Return True if the object itself changed since loading, or anything that was or is in the zone."""
        engine, seen = self._engine, set[str]()
        for other, box in engine.journal.entries:
            if other in seen:
                continue
            seen.add(other)
            if other == name or (box is not None and zone.overlaps(box)):
                return True
        return any(not engine.is_parked(other) and zone.overlaps(engine.aabb(other)) for other in seen)


def _course(before: Sequence[float]) -> list[tuple[float, ...]]:
    """Joint positions on the way from the current ones to fully open."""
    return [tuple(max(share, fraction) for fraction in before) for share in SWING]


def _opened(panels: DoorPanels, course: Sequence[Sequence[float]]) -> str:
    """Swing panels open. Return the obstacle that stops them too early; "" for none."""
    reached, other = panels.swing(course)
    if not reached or SWING[reached - 1] < LEAST_OPEN:
        panels.restore()
        return other
    if other:
        panels.advance(course[reached - 1], course[reached])
    return ""

"""Baselines of the paper's comparison: random sampling without a tree, and written poses without a solver.

Both ignore robot positions and earlier failures. They use the same objects and models as ``generator.lay``.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from embomatrix.factory.layout.organization import named_first
from embomatrix.factory.layout.request import Layout, LayoutRecord, RequestedObject
from embomatrix.factory.layout.sampling import LIFT_M, ObjectSampler
from embomatrix.factory.layout.values import LayoutFailure
from embomatrix.factory.scenes.editor import LayoutReason, PlacementError, SceneEditor
from embomatrix.world.asset import Asset
from embomatrix.world.geometry import Pose
from embomatrix.world.state import Relation

TRIES: Final = 10
"""Samples per object, as for OmniGibson's sampler in the paper's code."""
GRID_M: Final = 0.05
"""Grid of written poses."""
SPREAD: Final = 0.3
"""Maximum distance of a written pose from the host's centre, as a share of each side."""


def lay_at_random(editor: SceneEditor, items: Sequence[RequestedObject], seed: int) -> Layout:
    """Place each object at the first collision-free random pose, in the demanded relation or on a floor."""
    rng = np.random.default_rng((seed, 17))
    sampler = ObjectSampler(editor, rng)

    def first_free(asset: Asset, relation: Relation | None, host: str) -> Pose:
        for pose in itertools.islice(sampler.poses(asset, relation, host), TRIES):
            if editor.is_free(asset, pose):
                return pose
        raise PlacementError(LayoutReason.NO_FREE_SPOT, f"none of {TRIES} random poses at {host} is free")

    return _lay_each(editor, items, sampler, rng, first_free)


def lay_by_poses(editor: SceneEditor, items: Sequence[RequestedObject], seed: int) -> Layout:
    """Place each object at an unchecked pose rounded to a grid, as a language model writes them in LayoutGPT."""
    rng = np.random.default_rng((seed, 19))

    def written(asset: Asset, relation: Relation | None, host: str) -> Pose:
        if host not in editor.rooms and host not in editor.objects:
            detail = f"its host {host!r} has no place itself"
            raise PlacementError(LayoutReason.UNKNOWN_HOST, detail)
        return _rounded_pose(editor, asset, relation, host, rng)

    return _lay_each(editor, items, ObjectSampler(editor, rng), rng, written)


def _lay_each(
    editor: SceneEditor,
    items: Sequence[RequestedObject],
    sampler: ObjectSampler,
    rng: np.random.Generator,
    pose_for: Callable[[Asset, Relation | None, str], Pose],
) -> Layout:
    """Place each object at the pose found for it, or leave it out with the reason."""
    names: dict[str, str] = {}
    failures: list[LayoutFailure] = []
    for item in named_first(items, lambda item: (item.host, *item.beside)):
        asset = item.asset(0)
        relation, host = _requested_place(editor, item, names, rng)
        try:
            pose = pose_for(asset, relation, host)
        except PlacementError as error:
            failures.append(item.failure(host, error.reason, str(error)))
        else:
            names[item.name] = editor.insert(asset, pose, *sampler.rests(relation, host))
    return Layout(names, {}, tuple(failures), LayoutRecord())


def _rounded_pose(
    editor: SceneEditor, asset: Asset, relation: Relation | None, host: str, rng: np.random.Generator
) -> Pose:
    """Return a pose near the host's centre, at the height of its box for the relation."""
    if host in editor.rooms:
        (x, y), (width, depth) = editor.rooms[host].center_m, editor.rooms[host].size_m
        bottom = 0.0
    else:
        box = editor.box_of(host)
        (x, y, middle), (width, depth, _) = box.center_m, box.size_m
        heights = {Relation.ONTOP: box.high_m[2], Relation.INSIDE: middle - asset.size_m[2] / 2}
        bottom = heights.get(relation, box.low_m[2]) if relation else box.high_m[2]
        if relation is Relation.NEXTTO:
            x += width / 2 + asset.size_m[0] / 2
    dx, dy = rng.uniform(-SPREAD, SPREAD, 2)
    yaw = float(rng.integers(4)) * math.pi / 2
    return Pose.from_xyz_yaw(
        _rounded(x + width * dx), _rounded(y + depth * dy), bottom + asset.size_m[2] / 2 + LIFT_M, yaw
    )


def _rounded(value: float) -> float:
    return round(value / GRID_M) * GRID_M


def _requested_place(
    editor: SceneEditor, item: RequestedObject, names: dict[str, str], rng: np.random.Generator
) -> tuple[Relation | None, str]:
    """Return the relation and host that the task demands, in scene names; otherwise the floor of a permitted room."""
    if item.relation is not None:
        host = names.get(item.host, item.host)
        floor = host in editor.rooms
        return (None, host) if floor else (Relation(item.relation.value), host)
    if item.beside:
        return Relation.NEXTTO, names.get(item.beside[0], item.beside[0])
    rooms = item.rooms or tuple(editor.rooms)
    return None, rooms[int(rng.integers(len(rooms)))]

"""Baselines of the paper's comparison: random sampling without a tree, and a language model's poses without a solver.

Both ignore robot positions and earlier failures. They use the same objects and models as ``generator.lay``.
"""

import itertools
import math
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractAsyncContextManager
from typing import Annotated, Final

import numpy as np
from pydantic import Field, RootModel

from embomatrix.factory.layout.organization import named_first
from embomatrix.factory.layout.request import Layout, LayoutRecord, RequestedObject
from embomatrix.factory.layout.sampling import LIFT_M, ObjectSampler
from embomatrix.factory.layout.values import LayoutFailure
from embomatrix.factory.scenes.editor import LayoutReason, PlacementError, SceneEditor
from embomatrix.llm.batch import OnOneLoop
from embomatrix.llm.structured import ask
from embomatrix.llm.values import ChatModel, ChatRequest, Message, Speaker, UnusableReplyError
from embomatrix.world.asset import Asset
from embomatrix.world.geometry import Pose
from embomatrix.world.state import Relation

Place = tuple[Relation | None, str]
"""Relation to a host; None for the floor of a room."""

TRIES: Final = 10
"""Samples per object, as for OmniGibson's sampler in the paper's code."""


def lay_at_random(editor: SceneEditor, items: Sequence[RequestedObject], seed: int) -> Layout:
    """Place each object at the first collision-free random pose, in the demanded relation or on a floor."""
    rng = np.random.default_rng((seed, 17))
    sampler = ObjectSampler(editor, rng)

    def first_free(_: RequestedObject, asset: Asset, relation: Relation | None, host: str) -> Pose:
        for pose in itertools.islice(sampler.poses(asset, relation, host), TRIES):
            if editor.is_free(asset, pose):
                return pose
        raise PlacementError(LayoutReason.NO_FREE_SPOT, f"none of {TRIES} random poses at {host} is free")

    def place(item: RequestedObject, names: dict[str, str]) -> Place:
        rooms = item.rooms or tuple(editor.rooms)
        return _demanded_place(editor, item, names) or (None, rooms[int(rng.integers(len(rooms)))])

    return _lay_each(editor, items, sampler, place, first_free)


POSE_WRITER: Final = "pose writer"
MAX_TOKENS: Final = 24
FARTHEST: Final = 1000.0
"""Greatest coordinate in percent: an answer beyond it is unusable."""
Percent = Annotated[float, Field(ge=-FARTHEST, le=FARTHEST, allow_inf_nan=False)]
Degrees = Annotated[float, Field(ge=-3600.0, le=3600.0, allow_inf_nan=False)]

SYSTEM: Final = """\
You are an interior designer. Place one object after the other so that each looks natural where it is and overlaps none. \
Write [x, y, turn] for each object: its centre from left to right and from front to back, in percent of what it is on, and \
its turn in degrees. Answer with JSON only."""
EXAMPLES: Final = (
    ("lamp on nightstand", "[50, 70, 0]"),
    ("book on desk", "[20, 40, 0]"),
    ("book on desk", "[80, 60, 90]"),
    ("chair on floor of bedroom", "[65, 30, 180]"),
    ("mug in cabinet", "[35, 50, 0]"),
)


_ENDING: Final = re.compile(r"(\.[a-z]\.\d+)?_\d+$")
"""Sense and number at the end of an object's name: ``hand_dryer.n.01_1`` is called ``hand_dryer``."""


class WrittenPose(RootModel[tuple[Percent, Percent, Degrees]]):
    """Answer of a pose writer: position on the host in percent of its sides, and yaw in degrees."""


class PoseWriter(OnOneLoop):
    """Layout method without a solver: a language model writes one pose after the other, as in LayoutGPT.

    It sees the poses that it wrote before. Nothing checks them (Feng et al. 2023): objects may overlap or block the way.
    """

    def __init__(self, model: ChatModel, endpoint: AbstractAsyncContextManager[object] | None = None) -> None:
        super().__init__(endpoint)
        self._model = model

    def lay(self, editor: SceneEditor, items: Sequence[RequestedObject], seed: int) -> Layout:
        """Place each object at its written pose; leave it out if that is unusable. Raise EndpointError or CassetteError.

        The model is asked at temperature 0, so the seed has no effect.
        """
        called = {item.name: _ENDING.sub("", item.name) for item in items}
        written: list[tuple[str, str]] = []

        def pose_for(item: RequestedObject, asset: Asset, relation: Relation | None, host: str) -> Pose:
            _, demanded = _place_of(editor, item, {})
            line = _line(editor, called, item, relation, demanded)
            try:
                pose = self._runner.run(ask(self._model, question(written, line), WrittenPose, attempts=1))
            except UnusableReplyError as error:
                raise PlacementError(LayoutReason.NO_POSE, str(error)) from error
            x, y, turn_deg = pose.root
            written.append((line, f"[{x:g}, {y:g}, {turn_deg:g}]"))
            return _pose_on(editor, asset, relation, host, x, y, turn_deg)

        def place(item: RequestedObject, names: dict[str, str]) -> Place:
            return _place_of(editor, item, names)

        return _lay_each(editor, items, ObjectSampler(editor, np.random.default_rng(seed)), place, pose_for)


def question(written: Sequence[tuple[str, str]], line: str) -> ChatRequest:
    """Return the question for one object's pose, after those written before."""
    turns = [
        message
        for asked, answer in (*EXAMPLES, *written)
        for message in (Message(Speaker.USER, asked), Message(Speaker.ASSISTANT, answer))
    ]
    messages = (Message(Speaker.SYSTEM, SYSTEM), *turns, Message(Speaker.USER, line))
    return ChatRequest(POSE_WRITER, messages, max_tokens=MAX_TOKENS, temperature=0.0, seed=0)


def _line(
    editor: SceneEditor,
    called: Mapping[str, str],
    item: RequestedObject,
    relation: Relation | None,
    host: str,
) -> str:
    """Return the line that asks for an object's pose: ``book on desk``.

    It has names and categories, but no coordinates, so that a recorded answer outlives changes of the base scenes.
    """
    prepositions = {None: "on", Relation.ONTOP: "on", Relation.INSIDE: "in", Relation.NEXTTO: "beside"}
    return f"{called[item.name]} {prepositions.get(relation, relation)} {called.get(host) or _called(editor, host)}"


def _place_of(editor: SceneEditor, item: RequestedObject, names: Mapping[str, str]) -> Place:
    """Return the place that the task demands, otherwise the floor of the first permitted room."""
    return _demanded_place(editor, item, names) or (None, (*item.rooms, *editor.rooms)[0])


def _called(editor: SceneEditor, host: str) -> str:
    """Return the type of a room, or the category of an object in the scene; other names as they are."""
    if host in editor.rooms:
        return f"floor of {editor.rooms[host].type}"
    return editor.asset_of(host).category if host in editor.objects else host


def _pose_on(
    editor: SceneEditor,
    asset: Asset,
    relation: Relation | None,
    host: str,
    x: float,
    y: float,
    turn_deg: float,
) -> Pose:
    """Return the pose at a position on a host in percent of its box, at the height that the relation implies."""
    if host in editor.rooms:
        (left, front), (width, depth), bottom = editor.rooms[host].low_m, editor.rooms[host].size_m, 0.0
    elif host in editor.objects:
        box = editor.box_of(host)
        (left, front, low), (width, depth, height) = box.low_m, box.size_m
        heights = {Relation.ONTOP: box.high_m[2], Relation.INSIDE: low + (height - asset.size_m[2]) / 2}
        bottom = heights.get(relation, low) if relation else box.high_m[2]
        if relation is Relation.NEXTTO:
            left += (width + asset.size_m[0]) / 2
    else:
        raise PlacementError(LayoutReason.UNKNOWN_HOST, f"its host {host!r} has no place itself")
    return Pose.from_xyz_yaw(
        left + width * x / 100,
        front + depth * y / 100,
        bottom + asset.size_m[2] / 2 + LIFT_M,
        math.radians(turn_deg),
    )


def _lay_each(
    editor: SceneEditor,
    items: Sequence[RequestedObject],
    sampler: ObjectSampler,
    place_of: Callable[[RequestedObject, dict[str, str]], Place],
    pose_for: Callable[[RequestedObject, Asset, Relation | None, str], Pose],
) -> Layout:
    """Place each object at the pose found for it, or leave it out with the reason."""
    names: dict[str, str] = {}
    failures: list[LayoutFailure] = []
    for item in named_first(items, lambda item: (item.host, *item.beside)):
        asset = item.asset(0)
        relation, host = place_of(item, names)
        try:
            pose = pose_for(item, asset, relation, host)
        except PlacementError as error:
            failures.append(item.failure(host, error.reason, str(error)))
        else:
            names[item.name] = editor.insert(asset, pose, *sampler.rests(relation, host))
    return Layout(names, {}, tuple(failures), LayoutRecord())


def _demanded_place(editor: SceneEditor, item: RequestedObject, names: Mapping[str, str]) -> Place | None:
    """Return the relation and host that the task demands, in scene names; None if it demands none."""
    if item.relation is not None:
        host = names.get(item.host, item.host)
        return (None, host) if host in editor.rooms else (Relation(item.relation.value), host)
    if item.beside:
        return Relation.NEXTTO, names.get(item.beside[0], item.beside[0])
    return None

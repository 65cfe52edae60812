"""JSON records of scenes, assets, tasks and pose caches: the shape of each value and its rules.

Decoding trusts nothing, since physics silently drops the 17th part of a link and crashes on NaN. msgspec checks types and
bounds while it parses. ``SceneInvalidError`` names the path of the value that breaks a rule. Every number has bounds and is
therefore finite: NaN fails any bound.
"""

from __future__ import annotations

import math
import re
import reprlib
import sys
from typing import Annotated, Any, Final, TypeVar

import msgspec
from msgspec import UNSET, Meta, Struct, UnsetType

from embomatrix.world.asset import JointKind
from embomatrix.world.geometry import Shape
from embomatrix.world.poses import Handling
from embomatrix.world.scene import ROOM_HEIGHT_M
from embomatrix.world.state import Relation, State, SubstanceRelation
from embomatrix.world.task import MAX_NAME, MAX_TABLE, Profile, TaskCategory

MIN_EXTENT_M: Final = 1e-3
MAX_COORDINATE_M: Final = 1e4
UNIT_TOLERANCE: Final = 1e-4
"""Largest deviation of a quaternion's or an axis's length from 1."""
MAX_VERTICES: Final = 512
MAX_PARTS: Final = 16
"""Parts of a link. Bullet silently drops the rest of a compound shape."""
MAX_LINKS: Final = 100
MAX_MASS_KG: Final = 1e6
MAX_ROOMS: Final = 1_000
MAX_CEILING_M: Final = 100.0
MAX_WALLS: Final = 10_000
MAX_OBJECTS: Final = 5_000
MAX_TEXT: Final = 10_000
"""Characters of an instruction or a goal. The longest goal of BEHAVIOR-1K has 1,800."""

_SPACES: Final = r"\x00-\x1f\x7f-\xa0\xad\u1680\u2000-\u200f\u2028-\u202f\u205f-\u206f\u3000"
_UNPRINTABLE: Final = rf"{_SPACES}\ud800-\uf8ff\ufeff\ufff0-\ufffb"
Number = Annotated[float, Meta(ge=-sys.float_info.max, le=sys.float_info.max)]
Coordinate = Annotated[float, Meta(ge=-MAX_COORDINATE_M, le=MAX_COORDINATE_M)]
Extent = Annotated[float, Meta(gt=MIN_EXTENT_M, le=MAX_COORDINATE_M)]
Share = Annotated[float, Meta(ge=0.0, le=1.0)]
Row = Annotated[int, Meta(ge=0)]
Name = Annotated[str, Meta(min_length=1, max_length=MAX_NAME, pattern=rf"^[^/\\{_UNPRINTABLE}]*\Z")]
"""Printable text without a slash, safe as a part of a file name."""
Text = Annotated[str, Meta(max_length=MAX_TEXT)]
Point = tuple[Number, Number, Number]
Extents = tuple[Extent, Extent, Extent]
# A row has no bound here: msgspec 0.22 crashes on the union of a fixed tuple and an int with bounds. ``tables`` checks it.
PoseNumbers = tuple[Coordinate, Coordinate, Coordinate, Number, Number, Number, Number]
"""Position in metres, then the quaternion x, y, z, w."""

T = TypeVar("T")


class SceneInvalidError(ValueError):
    """Data of a scene, an asset, a task or a pose cache breaks a rule. ``field`` is the path of the value."""

    def __init__(self, field: str, message: str) -> None:
        super().__init__(f"{field}: {message}")
        self.field = field
        self.message = message

    def below(self, path: str) -> SceneInvalidError:
        """Prefix the error's path with ``path``."""
        return SceneInvalidError(f"{path}.{self.field}" if self.field else path, self.message)


class Record(Struct, forbid_unknown_fields=True):
    """JSON object with exactly these keys. Only keys with a default may be missing."""


class RoomJson(Record):
    name: Name
    type: Name
    low_m: tuple[Number, Number]
    high_m: tuple[Number, Number]
    height_m: Annotated[float, Meta(gt=0.0, le=MAX_CEILING_M)] = ROOM_HEIGHT_M

    def __post_init__(self) -> None:
        if not (self.low_m[0] < self.high_m[0] and self.low_m[1] < self.high_m[1]):
            raise SceneInvalidError(
                "", f"low_m {self.low_m} must lie below high_m {self.high_m} on both axes"
            )


class DoorwayJson(Record):
    rooms: tuple[str, str]
    center_m: tuple[Number, Number]
    width_m: Number
    height_m: Number
    along: str
    model: str

    def __post_init__(self) -> None:
        _check_axis(self.along)


class WindowJson(Record):
    rooms: tuple[str, str]
    center_m: tuple[Number, Number]
    width_m: Number
    sill_m: Number
    head_m: Number
    along: str
    model: str

    def __post_init__(self) -> None:
        _check_axis(self.along)
        if not 0.0 <= self.sill_m < self.head_m:
            found = f"found a sill at {self.sill_m} m and a head at {self.head_m} m"
            raise SceneInvalidError("", f"{found}: expected 0 <= sill < head")


def _check_axis(along: str) -> None:
    if along not in {"x", "y"}:
        raise SceneInvalidError("along", f"found {along[:20]!r}: expected a wall along x or y")


class RobotJson(Record):
    x_m: Number
    y_m: Number
    yaw: Number
    room: str


class PartJson(Record):
    shape: Shape
    pose: PoseNumbers
    size_m: Extents
    vertices_m: Annotated[tuple[Point, ...], Meta(max_length=MAX_VERTICES)] = ()

    def __post_init__(self) -> None:
        hull, count = self.shape is Shape.HULL, len(self.vertices_m)
        if hull != (count >= 4):
            expected = "4 or more" if hull else "0"
            raise SceneInvalidError("", f"a {self.shape.value} has {count} vertices: expected {expected}")


class JointJson(Record):
    kind: JointKind
    origin_m: tuple[Coordinate, Coordinate, Coordinate]
    axis: Point
    upper: Coordinate

    def __post_init__(self) -> None:
        length = math.hypot(*self.axis)
        if not abs(length - 1.0) <= UNIT_TOLERANCE:
            raise SceneInvalidError("axis", f"the axis has length {length:.6g}: expected 1")
        if self.upper == 0:
            raise SceneInvalidError("upper", "the joint has no travel: expected a number other than 0")


class LinkJson(Record):
    name: Name
    parts: Annotated[tuple[PartJson | int, ...], Meta(min_length=1, max_length=MAX_PARTS)]
    joint: JointJson | UnsetType = UNSET


class SurfaceJson(Record):
    name: Name
    center_m: Point
    size_m: tuple[Extent, Extent]
    clearance_m: Number
    interior: str
    link: str = ""
    framed: bool = False


class InteriorJson(Record):
    name: Name
    center_m: Point
    size_m: Extents
    closed_by: tuple[str, ...]
    link: str = ""


class CreditJson(Record):
    creator: str
    licence: str
    source: str


class AssetJson(Record):
    asset_id: Name
    category: Name
    synset: str
    size_m: Extents
    mass_kg: Annotated[float, Meta(gt=0.0, le=MAX_MASS_KG)]
    links: Annotated[tuple[LinkJson, ...], Meta(max_length=MAX_LINKS)]
    supports: tuple[SurfaceJson, ...]
    interiors: tuple[InteriorJson, ...]
    abilities: dict[str, dict[str, Number]]
    credit: CreditJson | UnsetType = UNSET


class ObjectJson(Record):
    name: Name
    asset_id: str
    room: str
    pose: PoseNumbers | int
    fixed: bool
    joints: Annotated[tuple[Share, ...], Meta(max_length=MAX_LINKS)]
    host: str
    relation: str
    states: tuple[State, ...]
    substances: tuple[tuple[SubstanceRelation, Name], ...] = ()
    absent: bool = False
    pieces: tuple[str, ...] = ()


class BackgroundJson(Record):
    asset_id: str
    room: str
    pose: PoseNumbers | int
    host: str = ""


class SceneJson(Record):
    scene_id: Name
    base: str
    seed: int
    rooms: Annotated[list[RoomJson], Meta(max_length=MAX_ROOMS)]
    walls: Annotated[list[PartJson | int], Meta(max_length=MAX_WALLS)]
    doorways: list[DoorwayJson]
    objects: Annotated[list[ObjectJson], Meta(max_length=MAX_OBJECTS)]
    assets: dict[str, AssetJson]
    robot: RobotJson
    left_out: tuple[str, ...]
    windows: list[WindowJson] = []
    background: Annotated[list[BackgroundJson], Meta(max_length=MAX_OBJECTS)] = []


class TaskJson(Record):
    task_id: Name
    scene_id: Name
    instruction: Text
    category: TaskCategory
    goal: Text
    table: Annotated[tuple[Name, ...], Meta(max_length=MAX_TABLE)]
    types: dict[str, tuple[str, ...]]
    source: str
    profile: Profile = Profile.PAPER


class PosesJson(Record):
    """Pose cache: ``placements`` names the assets of the sets in the tables; ``stands`` holds first rows and counts."""

    placements: list[Name]
    stands: dict[str, tuple[Row, Row]]
    barred: dict[Handling, dict[str, Name]] = {}
    barred_places: dict[Relation, dict[str, dict[str, Name]]] = {}
    reached: dict[Relation, dict[str, dict[str, Row]]] = {}


def convert(value: object, kind: type[T], root: str) -> T:
    """Record of parsed JSON; ``root`` names the whole value in errors. Raises SceneInvalidError."""
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        raise _located(error, value, kind, root) from error


def decode(text: bytes, kind: type[T], root: str) -> T:
    """Record of JSON text. Raises SceneInvalidError for a broken rule and ValueError for text that is not JSON."""
    try:
        return msgspec.json.decode(text, type=kind)
    except msgspec.ValidationError as error:
        raise _located(error, msgspec.json.decode(text), kind, root) from error


def _located(error: msgspec.ValidationError, value: Any, kind: type, root: str) -> SceneInvalidError:
    """Error with the full path.

    msgspec writes ``[...]`` for the key of a mapping; a search among its entries finds it.
    """
    whole = str(error)
    # The name of an unknown field may contain the separator, a path never does.
    message, separator, tail = whole.rpartition(" - at `$")
    message, tail = (message, tail) if separator else (whole, "")
    path, found = root, value
    try:
        for key, index in re.findall(r"\.(\w+)|\[(\d+|\.\.\.)\]", tail):
            if key:
                path, found = f"{path}.{key}", found[key]
            elif index != "...":
                path, found = f"{path}[{index}]", found[int(index)]
            else:
                name = _failing_key(found, value, kind, whole)
                if name is None:
                    return SceneInvalidError(f"{path}[...]", message[:MAX_NAME])
                path, found = f"{path}[{name[:MAX_NAME]!r}]", found[name]
    except (LookupError, TypeError, AttributeError):
        # The name of an unknown field at the root imitates the end of msgspec's message.
        return SceneInvalidError(root, whole[:MAX_NAME])
    if isinstance(error.__cause__, SceneInvalidError):
        return error.__cause__.below(path)
    return SceneInvalidError(path, f"found {reprlib.repr(found)}: {message[:1].lower()}{message[1:MAX_NAME]}")


def _failing_key(mapping: dict[str, Any], whole: Any, kind: type, message: str) -> str | None:
    """Key of the first entry of a mapping inside ``whole`` that causes the message. The mapping is left unchanged."""
    entries = list(mapping.items())

    def fails(some: list[tuple[str, Any]]) -> bool:
        mapping.clear()
        mapping.update(some)
        try:
            msgspec.convert(whole, kind)
        except msgspec.ValidationError as error:
            return str(error) == message
        return False

    sound, failing = 0, len(entries)  # numbers of first entries
    try:
        while failing - sound > 1:
            middle = (sound + failing) // 2
            sound, failing = (sound, middle) if fails(entries[:middle]) else (middle, failing)
        # Of two values of one key, the text's first one counts for msgspec, and the mapping holds the last.
        return entries[sound][0] if fails(entries[sound:failing]) else None
    finally:
        mapping.clear()
        mapping.update(entries)

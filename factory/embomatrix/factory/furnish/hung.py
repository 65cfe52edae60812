"""Groups off the floor: cabinets and hoods over the counters, objects on walls, lights under the ceiling; and rugs."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Final

from embomatrix.factory.furnish.kitchen import COOKERS, SINKS, UNDER_COUNTER
from embomatrix.factory.furnish.pieces import REST_GAP_M, FurnitureGroup, FurniturePiece, Member, Rows, Style
from embomatrix.factory.furnish.roles import HUNG_BOTTOM_M, FurnitureRole, wall_height_m

_NEAR_ON_WALL: Final[Mapping[str, tuple[str, ...]]] = {
    "mirror": SINKS,
    "makeup_mirror": SINKS,
    "wall_mounted_soap_dispenser": SINKS,
    "paper_towel_dispenser": SINKS,
    "hand_dryer": SINKS,
    "toilet_paper_dispenser": ("toilet",),
    "toilet_paper_holder": ("toilet",),
    "showerhead": ("shower_stall", "bathtub"),
    "towel_rack": ("shower_stall", "bathtub", *SINKS),
    "electric_switch": ("doorway",),
}
_FACES_ON_WALL: Final[Mapping[str, tuple[str, ...]]] = {
    "blackboard": ("straight_chair", "swivel_chair", "armchair", "taboret"),
    "whiteboard": ("straight_chair", "swivel_chair", "armchair", "taboret"),
    "projection_screen": ("straight_chair", "swivel_chair", "armchair", "eames_chair"),
    "wall_mounted_tv": ("sofa", "bar", "straight_chair", "swivel_chair", "armchair", "bed"),
}
_PENDANTS: Final = frozenset(("chandelier", "paper_lantern", "room_light"))
"""Lights that hang over a table if the room has one."""
_TABLES_UNDER_LIGHTS: Final = (
    "booth",
    "pedestal_table",
    "breakfast_table",
    "commercial_kitchen_table",
    "bar",
    "conference_table",
)
_SMALL_M: Final = 0.3
_HOOD_M: Final = 1.5
_EVENLY: Final = 3
_ANY_PITCH: Final = 100.0
_RUGS_NEAR: Final = (
    "coffee_table",
    "sofa",
    "bed",
    "shower_stall",
    "bathtub",
    "pedestal_sink",
    "furniture_sink",
)


def hung_groups(pieces: Sequence[FurniturePiece], ceiling_m: float) -> list[FurnitureGroup]:
    """Return wall cabinets and hoods over the counters, then objects on walls, large ones first."""
    groups = []
    for piece in pieces:
        if piece.role is FurnitureRole.HUNG_CABINET:
            hood = piece.category == "range_hood"
            near: tuple[str, ...] = COOKERS if hood else ("countertop", *SINKS, *UNDER_COUNTER)
            highest = ceiling_m - piece.size_m[2] - 0.01
            # A hood that is too high for the room reaches into the ceiling, not into the cook's head room.
            bottom = _HOOD_M if hood else max(min(HUNG_BOTTOM_M, highest), 0.9)
            member = Member(piece, bottom=bottom)
            groups.append(FurnitureGroup((member,), Style.RUN, 8.0 if hood else 5.0, near))
        elif piece.role is FurnitureRole.WALL:
            groups.append(on_wall(piece, ceiling_m))
    return sorted(groups, key=lambda g: -g.importance)


def on_wall(piece: FurniturePiece, ceiling_m: float) -> FurnitureGroup:
    """Return an object at its height on a wall; just above the floor if it is higher than the wall."""
    height = piece.size_m[2]
    bottom = max(0.05, min(wall_height_m(piece.category) - height / 2, ceiling_m - height - 0.02))
    near = _NEAR_ON_WALL.get(piece.category, ())
    faces = _FACES_ON_WALL.get(piece.category, ())
    style = Style.ALONG if near or faces or piece.size_m[1] < _SMALL_M else Style.CENTERED
    spread = () if piece.category == "electric_switch" else (piece.category,)
    return FurnitureGroup((Member(piece, bottom=bottom),), style, 1.0 + piece.size_m[1], near, faces, spread)


def ceiling_groups(pieces: Sequence[FurniturePiece], ceiling_m: float) -> list[FurnitureGroup | Rows]:
    """Return lights, fans and racks under the ceiling: equal ones spread evenly, one or two pendants over a table."""
    groups: list[FurnitureGroup | Rows] = []
    kinds: dict[str, list[FurnitureGroup]] = defaultdict(list)
    for piece in pieces:
        if piece.role is FurnitureRole.CEILING:
            member = Member(piece, bottom=ceiling_m - piece.size_m[2])
            tables = _TABLES_UNDER_LIGHTS if piece.category in _PENDANTS else ()
            group = FurnitureGroup(
                (member,), Style.OVERHEAD, 1.0 + piece.size_m[1], tables, spread=(piece.category,)
            )
            kinds[piece.category].append(group)
    for equal in kinds.values():
        if len(equal) >= _EVENLY:
            groups.append(Rows(tuple(equal), equal[0].importance, (0.5, 0.5), stretch=_ANY_PITCH))
        else:
            groups += equal
    return sorted(groups, key=lambda g: -g.importance)


def rug_groups(pieces: Sequence[FurniturePiece]) -> list[FurnitureGroup]:
    """Return rugs on free floor before the sofa, the bed or the sink."""
    return [
        FurnitureGroup((Member(p, bottom=REST_GAP_M),), Style.FREE, 1.0, _RUGS_NEAR, spread=("carpet",))
        for p in pieces
    ]

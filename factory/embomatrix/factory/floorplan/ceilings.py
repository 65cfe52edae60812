"""Ceiling heights: by type of room and by floor area, raised until whatever hangs there clears people's heads."""

import math
from collections.abc import Iterable, Mapping
from typing import Final

from embomatrix.factory.floorplan.spec import OUTDOORS
from embomatrix.world.geometry import Vec2
from embomatrix.world.scene import ROOM_HEIGHT_M

HEAD_ROOM_M: Final = 2.0
"""Free height below lamps, fans and racks."""
HOME_M: Final = 2.5
_BY_TYPE_M: Final[Mapping[str, float]] = {
    "gym": 5.0,
    "grocery_store": 3.6,
    **dict.fromkeys(("classroom", "biology_lab", "chemistry_lab", "computer_lab", "infirmary"), 3.0),
    **dict.fromkeys(("lobby", "conference_hall", "shared_office", "spa", "locker_room"), 3.0),
    **dict.fromkeys(("closet", "storage_room", "staircase", "phone_room"), ROOM_HEIGHT_M),
}
_BY_AREA: Final = ((1000.0, 7.0), (400.0, 4.5), (150.0, 3.6), (60.0, 3.0))
"""Least height in metres of rooms from an area in m² on, the largest first."""
_LARGE_M2: Final = 60.0
_HIGHEST_M: Final = 6.0
_HIGHEST_SMALL_M: Final = 3.3
"""Upper limits to which hanging objects raise the ceiling of large and of small rooms."""
_FIXING_M: Final = 0.02


def ceiling_height_m(room_type: str, floor_m: Vec2, hanging_m: Iterable[float] = ()) -> float:
    """Return the height of a room's walls, in steps of 0.1 m; ``hanging_m`` are the heights of objects under its ceiling.

    A garden has walls of the usual height around it and no ceiling.
    """
    if room_type in OUTDOORS:
        return ROOM_HEIGHT_M
    area = floor_m[0] * floor_m[1]
    by_area = next((height for least, height in _BY_AREA if area >= least), 0.0)
    usual = max(_BY_TYPE_M.get(room_type, HOME_M), by_area)
    highest = max(usual, _HIGHEST_M if area >= _LARGE_M2 else _HIGHEST_SMALL_M)
    needed = [height for each in hanging_m if (height := HEAD_ROOM_M + each + _FIXING_M) <= highest]
    return min(math.ceil(round(10 * max([usual, *needed]), 6)) / 10, highest)

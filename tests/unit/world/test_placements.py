"""Placements in flat arrays restore every pose and refuse invalid indices."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from embomatrix.world.geometry import Pose
from embomatrix.world.placements import Placements, flattened
from embomatrix.world.poses import PlacementKey, StandPose
from embomatrix.world.records import SceneInvalidError
from embomatrix.world.state import Relation
from embomatrix.world.tables import Tables, TableWriter

NAME = st.sampled_from(("apple-aa", "table-bb", "footprint-9x9x12cm", "level-floor"))
KEY = st.builds(PlacementKey, NAME, NAME, st.sampled_from(Relation))
POSE = st.builds(Pose.from_xyz_yaw, *[st.floats(-5, 5)] * 3, st.floats(-3, 3))
SETS = st.dictionaries(KEY, st.lists(POSE, min_size=1, max_size=3).map(tuple), max_size=6)


@given(SETS)
def test_flattened_placements_restore_the_same_mapping(known) -> None:
    placements = Placements(*flattened(known))
    assert dict(placements) == known
    assert placements == known
    assert list(placements) == list(known)


@given(SETS, KEY)
def test_unknown_keys_have_no_poses(known, key) -> None:
    placements = Placements(*flattened(known))
    assert placements.get(key, ()) == known.get(key, ())
    assert (key in placements) == (key in known)


GOOD = [0, 1, 0, 0, 2]


@pytest.mark.parametrize(
    "row",
    [
        [2, 1, 0, 0, 2],
        [0, -1, 0, 0, 2],
        [0, 1, 6, 0, 2],
        [0, 1, 0, 2, 2],
        [0, 1, 0, -1, 2],
        [0, 1, 0, 0, 9999],
    ],
)
def test_set_with_an_index_out_of_range_is_refused(row) -> None:
    spots = np.array([[0, 0, 0, 0, 0, 0, 1.0]] * 3)
    Placements(["a", "b"], np.array([GOOD], dtype=np.int32), spots)
    with pytest.raises(SceneInvalidError, match="sets"):
        Placements(["a", "b"], np.array([row], dtype=np.int32), spots)


def test_duplicate_set_or_asset_is_refused() -> None:
    spots = np.array([[0, 0, 0, 0, 0, 0, 1.0]] * 3)
    with pytest.raises(SceneInvalidError, match="twice"):
        Placements(["a", "b"], np.array([GOOD, GOOD], dtype=np.int32), spots)
    with pytest.raises(SceneInvalidError, match="twice"):
        Placements(["a", "a"], np.array([GOOD], dtype=np.int32), spots)


def test_standing_poses_come_from_the_rows_of_their_name() -> None:
    writer = TableWriter()
    writer.stands([(1.0, 2.0, 0.5), (3.0, 4.0, -0.5), (5.0, 6.0, 0.0)])
    stands = Tables(writer.arrays()).stands({"apple_1": (0, 2), "table_1": (2, 1), "sky_1": (3, 0)})
    assert stands == {
        "apple_1": (StandPose(1.0, 2.0, 0.5), StandPose(3.0, 4.0, -0.5)),
        "table_1": (StandPose(5.0, 6.0, 0.0),),
        "sky_1": (),
    }
    assert stands.get("pear_1") is None

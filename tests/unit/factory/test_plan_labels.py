"""Text on plans: legible names, and numbers with a legend for the others."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import pytest
from PIL import Image

from embomatrix.factory.pictures.labels import Labels, boxes
from embomatrix.factory.pictures.legend import counted, draw_legend
from embomatrix.factory.pictures.scene import draw_plan

if TYPE_CHECKING:
    from embomatrix.world.scene import Scene

NOTHING = boxes(())


def written(image: Image.Image) -> np.ndarray:
    """Return the mask (height, width) of pixels that are no longer grey."""
    return np.asarray(np.any(np.asarray(image) != 128, axis=2))


def grey() -> Image.Image:
    return Image.new("RGB", (200, 120), (128, 128, 128))


@pytest.mark.parametrize(
    "box",
    [(20, 20, 180, 50), (20, 20, 90, 70), (20, 10, 40, 115), (20, 10, 56, 110)],
    ids=["long", "in lines", "upright", "narrow"],
)
def test_name_stays_within_its_box(box: tuple[int, int, int, int]) -> None:
    image = grey()
    assert Labels(image).inside("straight_chair_1", box, "black", NOTHING)
    rows, columns = np.nonzero(written(image))
    assert box[0] <= columns.min()
    assert columns.max() < box[2]
    assert box[1] <= rows.min()
    assert rows.max() < box[3]


def test_size_of_a_room_moves_below_its_name_if_one_line_is_too_long() -> None:
    def one_line_of(words: str) -> np.ndarray:
        image = grey()
        assert Labels(image).inside(words, (5, 5, 195, 115), "black", NOTHING)
        rows, columns = np.nonzero(written(image))
        return np.array([np.ptp(rows), np.ptp(columns)]) + 1

    image = grey()
    assert Labels(image).inside("storage_room_0  1.6 x 1.2 m", (20, 20, 130, 70), "black", NOTHING)
    rows, columns = np.nonzero(written(image))
    name, size = one_line_of("storage_room_0"), one_line_of("1.6 x 1.2 m")
    assert abs(np.ptp(columns) + 1 - max(name[1], size[1])) <= 2, "the whole name has a dedicated line"
    assert np.ptp(rows) + 1 > 1.5 * name[0]


def test_illegible_name_is_not_written() -> None:
    image = grey()
    assert not Labels(image).inside("straight_chair_1", (20, 20, 50, 50), "black", NOTHING)
    assert not written(image).any()


def test_names_in_one_box_do_not_overlap_until_it_is_full() -> None:
    image = grey()
    labels = Labels(image)
    inks = []
    while labels.inside("bed_1", (20, 20, 80, 80), "black", NOTHING):
        inks.append(written(image).sum())
    assert len(inks) >= 3
    assert all(more - less == inks[0] for less, more in pairwise(inks))


@pytest.mark.parametrize(("mark", "must"), [((40, 20, 160, 70), False), ((0, 0, 200, 120), True)])
def test_name_covers_marks_only_if_necessary(mark: tuple[int, int, int, int], must: bool) -> None:
    image = grey()
    assert Labels(image).inside("bed_1", (20, 20, 180, 100), "black", boxes([mark]))
    assert written(image)[mark[1] : mark[3], mark[0] : mark[2]].any() == must


def test_numbers_of_one_point_are_placed_around_it() -> None:
    image = grey()
    labels = Labels(image)
    inks = []
    for _ in range(6):
        labels.beside("7", (100, 60), "black", NOTHING)
        inks.append(int(written(image).sum()))
    assert inks == [inks[0] * count for count in range(1, 7)]


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (["book_1", "book_2", "book_3", "cup_1"], "book_1-3, cup_1"),
        (["book_9", "book_10", "book_2"], "book_2, 9-10"),
        (["floors", "cup_4"], "floors, cup_4"),
    ],
)
def test_names_are_abbreviated(names: list[str], words: str) -> None:
    assert counted(names) == words


def test_legend_grows_by_columns_and_not_in_height() -> None:
    one, two = (draw_legend([("red", "opens")], ["bed_1"] * count, 320) for count in (5, 25))
    assert one.height == two.height == 320
    assert two.width == 2 * one.width
    assert np.asarray(two.crop((one.width, 0, two.width, 320)).convert("L")).min() < 64


def test_large_scenes_get_larger_pictures_within_limits(home: Scene) -> None:
    room = replace(home.rooms[0], name="hall_9", low_m=(0.0, 0.0), high_m=(45.0, 20.0))
    hall = draw_plan(replace(home, rooms=(*home.rooms, room)))
    field = draw_plan(replace(home, rooms=(*home.rooms, replace(room, high_m=(400.0, 20.0)))))
    legend = 2 * 360
    assert draw_plan(home).width < 1500 + legend
    assert 45 * 60 < hall.width < 45 * 62 + legend + 100
    assert field.width < 3100 + legend

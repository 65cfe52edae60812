"""Names of objects in rendered pictures do not overlap and stay in the picture."""

import numpy as np
from PIL import Image

from embomatrix.factory.pictures.tags import LEAST_PIXELS, tagged
from embomatrix.sim.bullet.photograph import SeenObject

GREY = Image.new("RGB", (200, 120), "#808080")


def changed(*seen: SeenObject) -> np.ndarray:
    return (np.asarray(tagged(GREY, seen)) != np.asarray(GREY)).any(axis=2)


def test_large_object_has_its_name_on_it() -> None:
    rows, columns = np.nonzero(changed(SeenObject("sofa_1", 100, 60, 5000)))
    assert abs(rows.mean() - 60) < 4
    assert abs(columns.mean() - 100) < 4


def test_small_object_stays_visible_beside_its_name() -> None:
    marks = changed(SeenObject("apple_1", 100, 60, 80))
    assert marks.any()
    assert marks[58:63, 98:103].sum() <= 5, "only the end of the line"


def test_object_of_a_few_pixels_gets_no_name() -> None:
    assert not changed(SeenObject("apple_1", 100, 60, LEAST_PIXELS - 1)).any()


def test_names_never_overlap_and_never_leave_the_picture() -> None:
    crowd = [SeenObject(f"straight_chair_{number}", 195, 115, 900) for number in range(30)]
    few = changed(*crowd[:1]).sum()
    assert few < changed(*crowd).sum() < 30 * few
    assert changed(*crowd).shape == (120, 200)

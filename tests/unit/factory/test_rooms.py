"""Rooms of base scenes: medians over rooms and the truth of the furnishing, against the goals."""

from embomatrix.factory.evaluate.rooms import GOALS, evaluate_rooms


def test_rooms_of_a_home_reach_the_density_of_real_ones() -> None:
    done: list[int] = []
    evaluation = evaluate_rooms(["Rs_int"], 0, done.append)
    assert done == [1]
    figures = {figure.name: figure for figure in evaluation.figures}
    assert {f"objects_per_{kind}" for kind in GOALS} <= figures.keys()
    living = figures["objects_per_living_room"]
    assert living.goal == 35.0
    assert living.value >= 35.0
    assert figures["objects_per_bedroom"].value >= 30.0
    assert figures["floating_slabs"].value == 0


def test_rooms_of_other_places_do_not_count_as_those_of_homes() -> None:
    evaluation = evaluate_rooms(["office_bike"], 0, lambda done: None)
    assert not [figure.name for figure in evaluation.figures if figure.name.startswith("objects_per_")]

"""Density of homes: medians over rooms, against the goals."""

from embomatrix.factory.evaluate.density import GOALS, density_figures


def test_rooms_of_a_home_reach_the_density_of_real_ones() -> None:
    figures = {figure.name: figure for figure in density_figures(["Rs_int"], seed=0)}
    assert set(figures) == {f"objects_per_{kind}" for kind in GOALS}
    living = figures["objects_per_living_room"]
    assert living.goal == 35.0
    assert living.value >= 35.0
    assert figures["objects_per_bedroom"].value >= 30.0

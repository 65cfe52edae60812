"""Recipes of the corpus: settings of the builds that make its parts, each in scenes of its own.

All parts share one seed, which splits needs, words, jobs, kinds and goal shapes, so what one part holds out the others hold
out too.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

SEED: Final = 0
"""Seed of all parts."""


@dataclass(frozen=True, slots=True)
class Recipe:
    """Settings from which a part was built, as the options of ``embomatrix factory generate``."""

    train: int
    heldout: int
    scenes: tuple[str, ...]


PARTS: Final[Mapping[int, Recipe]] = MappingProxyType(
    {
        # Two of the ten homes are held out.
        1: Recipe(
            480,
            120,
            (
                "Rs_int",
                "Beechwood_0_int",
                "Merom_0_int",
                "Merom_1_int",
                "Pomaria_0_int",
                "Pomaria_1_int",
                "Benevolence_1_int",
                "Ihlen_0_int",
                "Wainscott_0_int",
                "house_single_floor",
                "office_cubicles_left",
                "hotel_suite_small",
                "grocery_store_cafe",
                "restaurant_diner",
            ),
        ),
        # Two gardens of homes that part 1 holds out, a home, a restaurant, an office and a school.
        2: Recipe(
            0,
            80,
            (
                "Beechwood_0_garden",
                "Pomaria_0_garden",
                "Wainscott_1_int",
                "restaurant_hotel",
                "office_bike",
                "school_chemistry",
            ),
        ),
        # All other scenes, homes and other places in each part.
        3: Recipe(
            380,
            0,
            (
                "Beechwood_1_int",
                "Merom_0_garden",
                "gates_bedroom",
                "hall_arch_wood",
                "hotel_gym_spa",
                "house_double_floor_upper",
                "restaurant_asian",
                "school_biology",
            ),
        ),
        4: Recipe(
            380,
            0,
            (
                "Benevolence_0_int",
                "Pomaria_2_int",
                "grocery_store_asian",
                "hall_conference_large",
                "hotel_suite_large",
                "office_cubicles_right",
                "restaurant_brunch",
                "school_computer_lab_and_infirmary",
            ),
        ),
        5: Recipe(
            380,
            0,
            (
                "Benevolence_2_int",
                "Rs_garden",
                "grocery_store_convenience",
                "hall_glass_ceiling",
                "house_double_floor_lower",
                "office_large",
                "restaurant_cafeteria",
                "school_geography",
            ),
        ),
        6: Recipe(
            380,
            0,
            (
                "Ihlen_1_int",
                "Wainscott_0_garden",
                "grocery_store_half_stocked",
                "hall_train_station",
                "office_vendor_machine",
                "restaurant_urban",
                "school_gym",
            ),
        ),
    }
)
"""Recipes of the parts by number: 2,000 training and 200 held-out tasks."""

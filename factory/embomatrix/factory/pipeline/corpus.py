"""The scenes of the corpora: 45 to train in, as many as the paper's, and six that training never sees."""

from __future__ import annotations

from typing import Final

from embomatrix.world.catalog import Catalog

HELDOUT_SCENES: Final = (
    "Ihlen_1_int",
    "Wainscott_1_int",
    "Beechwood_1_int",
    "restaurant_hotel",
    "office_bike",
    "school_chemistry",
)
"""Three homes, a restaurant, an office and a school: of every milieu with enough scenes to spare one."""


def training_scenes() -> tuple[str, ...]:
    """All base scenes but the held-out ones."""
    return tuple(scene for scene in Catalog.load().scene_ids if scene not in HELDOUT_SCENES)

"""Pictures of relations: the simulator's verdicts match human judgement."""

import numpy as np
import pytest

from embomatrix.factory.pictures.relations import COLUMNS, PANELS, draw_relations, verdict

HOLDING = {
    "rests on its top",
    "an open board is a surface",
    "its box is in a cavity",
    "it may stick out of an open cavity",
    "a closed microwave has an inside",
    "the table is over its middle",
    "5 cm apart or less",
    "its middle is over the floor",
    "5 mm apart or less",
    "a joint past 5 % of its travel",
}


@pytest.mark.parametrize("panel", PANELS, ids=lambda panel: f"{panel.predicate}: {panel.note}")
def test_simulator_verdict_of_each_case_is_as_expected(panel) -> None:
    assert verdict(panel) == (panel.note in HOLDING)


def test_every_relation_is_shown_holding_and_not_holding() -> None:
    shown = {(panel.predicate, panel.note in HOLDING) for panel in PANELS}
    assert shown == {
        (name, holds)
        for name in ("ontop", "inside", "under", "nextto", "touching", "inroom", "open")
        for holds in (True, False)
    }


def test_sheet_has_a_picture_in_every_panel() -> None:
    sheet = np.asarray(draw_relations())
    rows = -(-len(PANELS) // COLUMNS)
    panels = (
        sheet.reshape(rows, sheet.shape[0] // rows, COLUMNS, sheet.shape[1] // COLUMNS, 3)
        .swapaxes(1, 2)
        .reshape(rows * COLUMNS, -1, 3)
    )
    assert all(len(np.unique(panel, axis=0)) > 12 for panel in panels[: len(PANELS)])

"""EAI's tasks in the scenes that they were written for, in as many layouts as an import tries there."""

from __future__ import annotations

from embomatrix.factory.task_import.batch import OWN_SCENE_DRAWS, ImportOptions, Verified, imports, verify
from embomatrix.factory.task_import.task import ImportedTask


def in_its_scene(source, base, library):
    """The task as it is laid out, and with its plan, in the first layout that is solved. AssertionError where none is."""
    refusals = []
    for imported in imports(source, [base], seed=0, options=ImportOptions(), draws=OWN_SCENE_DRAWS):
        found = verify(imported, library, None) if isinstance(imported, ImportedTask) else imported
        if isinstance(found, Verified):
            return imported, found
        refusals.append(found.sentence)
    raise AssertionError(f"{source.name} is not solved in {base.base}: {refusals}")

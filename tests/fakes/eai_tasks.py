"""EAI's tasks in their own scenes, in as many layouts as an import tries."""

from __future__ import annotations

from embomatrix.factory.task_import.batch import OWN_SCENE_DRAWS, ImportOptions, Verified, imports, verify
from embomatrix.factory.task_import.task import ImportedTask


def in_its_scene(source, base, library):
    """Return the task with its oracle plan in the first solvable layout. Raises AssertionError if there is none."""
    refusals = []
    for imported in imports(source, [base], seed=0, options=ImportOptions(), draws=OWN_SCENE_DRAWS):
        found = verify(imported, library, None) if isinstance(imported, ImportedTask) else imported
        if isinstance(found, Verified):
            return imported, found
        refusals.append(found.sentence)
    raise AssertionError(f"{source.name} is not solved in {base.base}: {refusals}")

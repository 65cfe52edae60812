"""What kind of task a problem is, and how a person asks for it."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from embomatrix.factory.task_import.reach import REAL
from embomatrix.world.bddl import ROOM_TYPES, is_room_instance
from embomatrix.world.evaluate import atoms_of
from embomatrix.world.state import Relation, State, SubstanceRelation
from embomatrix.world.substances import MEANINGS
from embomatrix.world.task import TaskCategory

if TYPE_CHECKING:
    from embomatrix.factory.scenes.view import SceneView
    from embomatrix.factory.task_import.sources import SourceText
    from embomatrix.world.bddl import BddlProblem
    from embomatrix.world.goal import Formula

KITCHEN: Final = frozenset({State.COOKED, State.FROZEN, State.HOT, State.SLICED, REAL})
SWITCHED: Final = frozenset({State.OPEN, State.TOGGLED_ON})
CLEANED: Final = frozenset((*MEANINGS, *SubstanceRelation))
_ROOM_OR_TEXT: Final = re.compile(
    rf"(?:{'|'.join(sorted(ROOM_TYPES, key=len, reverse=True))})_\d+|.+?(?=(?:{'|'.join(sorted(ROOM_TYPES))})_\d|$)",
    re.IGNORECASE,
)


def instruction_of(source: SourceText, problem: BddlProblem) -> str:
    """What a person asks for. The paper's tasks carry it as the problem's name, with underscores for spaces."""
    words = source.request or problem.name
    words = re.sub(r"-\d+$", "", words)
    words = re.sub(r"\.n\.\d+(_\d+)?", "", words)
    spaced = " ".join(
        word if is_room_instance(word.lower()) else word.replace("_", " ")
        for word in _ROOM_OR_TEXT.findall(words)
    )
    words = re.sub(r"\s+([.,]|$)", r"\1", re.sub(r"\s+", " ", spaced)).strip(" .")
    return f"{words[:1].upper()}{words[1:]}."


def category_of(goal: Formula) -> TaskCategory:
    """Which of the paper's four kinds a goal is."""
    predicates = {atom.predicate for atom in atoms_of(goal)}
    moves = bool(predicates & set(Relation))
    switches = bool(predicates & (SWITCHED | CLEANED))
    if predicates & KITCHEN:
        outside = {Relation.ONTOP, Relation.UNDER, Relation.NEXTTO, State.OPEN} & predicates
        return TaskCategory.COMPOUND if outside else TaskCategory.KITCHEN_OPERATION
    if moves and switches:
        return TaskCategory.COMPOUND
    return TaskCategory.APPLIANCE_USE if switches else TaskCategory.PICK_AND_PLACE


def signature_of(goal: Formula, view: SceneView) -> str:
    """Kind of a goal: its predicates over categories, sorted. Variables stand for their type."""
    signs = []
    for atom in atoms_of(goal):
        args = (view.category(arg) if arg in view.scene.by_name else arg.lstrip("?") for arg in atom.args)
        signs.append(f"{atom.predicate}({','.join(args)})")
    return " ".join(sorted(signs))

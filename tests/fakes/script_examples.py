"""Training tasks for scripts: a small flat, and instructions about it with their demands."""

from dataclasses import replace

from embomatrix.scripts.examples import ScriptExample
from embomatrix.skills.prompt import PromptRow, Situation
from embomatrix.skills.syntax import PlaceRelation, Skill, SkillCall
from embomatrix.world.intent import IntentClause
from embomatrix.world.state import Relation

ROWS = (
    PromptRow(0, "countertop_1", "countertop", "kitchen_0", fixed=True),
    PromptRow(1, "fridge_1", "fridge", "kitchen_0", states=("closed",), fixed=True),
    PromptRow(2, "microwave_1", "microwave", "kitchen_0", states=("closed", "off"), fixed=True),
    PromptRow(3, "apple_1", "apple", "kitchen_0", "countertop_1", Relation.ONTOP),
    PromptRow(4, "bowl_1", "bowl", "kitchen_0", "countertop_1", Relation.ONTOP),
    PromptRow(5, "bowl_2", "bowl", "den_0", "coffee_table_1", Relation.ONTOP),
    PromptRow(6, "pear_1", "pear", "kitchen_0", "fridge_1", Relation.INSIDE),
    PromptRow(7, "coffee_table_1", "coffee_table", "den_0", fixed=True),
    PromptRow(8, "floor_lamp_1", "floor_lamp", "den_0", states=("off",), fixed=True),
    PromptRow(9, "bottom_cabinet_1", "bottom_cabinet", "den_0", states=("open",), fixed=True),
    PromptRow(10, "desk_1", "desk", "den_0", fixed=True),
)
NAMES = [row.name for row in ROWS]
PUT_IN = IntentClause("inside", ("apple_1",), ("fridge_1",))
HEAT = IntentClause("hot", ("apple_1",), ("microwave_1",))
TOLD = (
    ("Please put the apple in the fridge.", (PUT_IN,)),
    (
        "Put the pear in the low cabinet and switch on the floor lamp.",
        (
            IntentClause("inside", ("pear_1",), ("bottom_cabinet_1",)),
            IntentClause("toggled_on", ("floor_lamp_1",)),
        ),
    ),
    (
        "Could you set the pear down on the desk, then close the low cabinet?",
        (
            IntentClause("ontop", ("pear_1",), ("desk_1",)),
            IntentClause("open", ("bottom_cabinet_1",), holds=False),
        ),
    ),
    ("Open the fridge.", (IntentClause("open", ("fridge_1",)),)),
    ("Set the apple down on the coffee table.", (IntentClause("ontop", ("apple_1",), ("coffee_table_1",)),)),
    ("Warm the apple with the microwave.", (HEAT,)),
    (
        "Warm the apple with the microwave, then set it down on the desk.",
        (HEAT, IntentClause("ontop", ("apple_1",), ("desk_1",))),
    ),
    ("Please cook the apple.", (IntentClause("cooked", ("apple_1",)),)),
)
"""Instructions with their demands. The flat's people call the bottom cabinet a low cabinet."""
COOKING = (
    SkillCall(Skill.MOVE, 3),
    SkillCall(Skill.PICK_UP, 3),
    SkillCall(Skill.MOVE, 2),
    SkillCall(Skill.PLACE, 2, relation=PlaceRelation.INSIDE),
)


def situation(instruction, rows=ROWS):
    """Return the prompt's content of the flat with an instruction."""
    return Situation(("kitchen_0", "den_0"), "den_0", rows, instruction, len(rows))


def example(task_id, instruction, intent, oracle=COOKING):
    return ScriptExample(task_id, situation(instruction), tuple(intent), oracle)


def training():
    """Return all instructions as a training split."""
    return [example(f"task-{at}", text, intent) for at, (text, intent) in enumerate(TOLD)]


def in_state(name, *states):
    """Return the flat's rows with other states of one row."""
    return tuple(replace(row, states=states) if row.name == name else row for row in ROWS)


def in_words(plan):
    """Return a plan as text with the names of the objects."""
    return "; ".join(
        " ".join(
            [
                call.skill.value,
                NAMES[call.object_index or 0],
                *([call.relation.value] if call.relation else []),
            ]
        )
        for call in plan
    )

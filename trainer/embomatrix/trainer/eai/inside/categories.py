"""Category of an EAI task in the paper's four categories. They are not published, so a rule over the goal decides.

Only literals of the goal's first ground option that are false at the start count.
"""

import re
from typing import Any, Final

from embomatrix.trainer.eai.inside.demo import Package, flat

REACHED: Final = frozenset(
    [
        "inside",
        "ontop",
        "nextto",
        "under",
        "onfloor",
        "touching",
        "open",
        "toggled_on",
        "cooked",
        "frozen",
        "burnt",
    ]
)
"""Predicates that the paper's thirteen skills can make true."""
FOOD_STATES: Final = frozenset({"Cooked", "Frozen"})
NO_FOOD: Final = frozenset(
    ["perfume.n.02", "shampoo.n.01", "cleansing_agent.n.01", "pool.n.01", "detergent.n.02", "toothpaste.n.01"]
)
DRY_FOOD: Final = frozenset(["tea_bag.n.01", "flour.n.01", "cereal.n.03"])


def category_of(package: Package, name: str) -> str:
    """Return kitchen_operation, compound, appliance_use or pick_and_place."""
    info = package.read(f"transition_modeling/resources/behavior_bddl_info/{name}.json")
    true_now = {fact for positive, fact in map(_literal, info["initial_condition"]) if positive}
    option = min(
        (list(map(_literal, option)) for option in info["goal_option"]),
        key=lambda literals: len(_out_of_reach(literals, true_now)),
    )
    unmet = [(positive, fact) for positive, fact in option if (fact in true_now) != positive]
    predicates = {fact[0] for _, fact in unmet}
    moved = {fact[1] for positive, fact in unmet if positive and len(fact) == 3}
    synset = info["name_category"]
    food = [name_ for name_ in moved if _is_food(synset[name_], package.states[name].get(name_, ()))]
    if predicates & {"cooked", "frozen", "sliced"}:
        return "kitchen_operation"
    if predicates & {"stained", "dusty", "soaked"}:
        return "compound"
    if 2 * len(food) > len(moved) and _in_kitchen(package, name):
        return "kitchen_operation"
    return "appliance_use" if predicates & {"open", "toggled_on"} else "pick_and_place"


def _literal(value: Any) -> tuple[bool, tuple[str, ...]]:
    tokens = flat(value)
    return (False, tuple(tokens[1:])) if tokens[0] == "not" else (True, tuple(tokens))


def _out_of_reach(literals: list[tuple[bool, tuple[str, ...]]], true_now: set[tuple[str, ...]]) -> set[str]:
    return {
        f"{positive} {fact[0]}"
        for positive, fact in literals
        if ((fact in true_now) != positive and fact[0] not in REACHED)
        or (fact[0] == "cooked" and not positive)
    }


def _is_food(synset: str, states: Any) -> bool:
    return synset in DRY_FOOD or (bool(FOOD_STATES & set(states)) and synset not in NO_FOOD)


def _in_kitchen(package: Package, name: str) -> bool:
    """True if a fixed object of the task stands in a kitchen."""
    return re.search(r"\(inroom\s+\S+\s+kitchen\)", package.problem(name)) is not None

"""Translation of other datasets' problems to the catalog's types and relations, with implied rooms made explicit.

Renamed types are replaced. A type for a whole group (a table, a book) is replaced by the first member with models
that the problem does not name yet. The domains of the quantifiers stay the same. Objects are *on* shelves and *in* bowls,
whichever of both relations the problem names.
"""

import dataclasses
import functools
import re
from collections.abc import Iterator, Mapping
from typing import Final

from embomatrix.factory.assets.library import build_asset
from embomatrix.factory.task_import.expressible import FLOORS
from embomatrix.factory.task_import.sources import EAI, SourceText
from embomatrix.sim.geometry.candidates import surfaces_for
from embomatrix.world.asset import Asset
from embomatrix.world.bddl import BddlProblem, InitLiteral, is_room_instance, parse_problem
from embomatrix.world.catalog import Catalog
from embomatrix.world.evaluate import atoms_of, map_atoms, subformulas
from embomatrix.world.goal import And, Atom, Formula, Quantified
from embomatrix.world.state import Relation
from embomatrix.world.substances import is_substance

RENAMED: Final[Mapping[str, tuple[str, ...]]] = {
    "cupboard.n.01": ("cabinet.n.01",),
    "burner.n.02": ("stove.n.01",),
    "bar.n.02": ("countertop.n.01",),
    "butternut_squash.n.01": ("butternut_squash.n.02",),
    "shelf_shelf.n.01": ("shelf.n.01",),
    "shelf_baseboard.n.01": ("shelf.n.01",),
    "basket.n.03": ("wicker_basket.n.01", "shopping_basket.n.01"),
    "duffel_bag.n.01": ("backpack.n.01", "shoulder_bag.n.01"),
}
"""Types of the paper's tasks that bddl 3.6 renamed or, like the duffel bag, removed.

The third sense of "basket" is a basketball hoop there, which no task means.
"""

GROUPS: Final[Mapping[str, tuple[str, ...]]] = {
    **RENAMED,
    "alarm.n.02": ("fire_alarm.n.02",),
    "apparel.n.01": ("tank_top.n.01", "sweatshirt.n.01"),
    "backpack.n.01": ("shoulder_bag.n.01", "briefcase.n.01"),
    "ball.n.01": ("tennis_ball.n.01", "baseball.n.02"),
    "basket.n.01": ("wicker_basket.n.01", "shopping_basket.n.01"),
    "beef.n.02": ("steak.n.01",),
    "beer.n.01": ("beer_bottle.n.01",),
    "beverage.n.01": ("bottle__of__water.n.01", "bottle__of__milk.n.01"),
    "bin.n.01": ("ashcan.n.01", "recycling_bin.n.01"),
    "book.n.02": ("hardback.n.01", "paperback_book.n.01"),
    "bottle.n.01": ("bottle__of__water.n.01", "bottle__of__milk.n.01"),
    "box.n.01": ("carton.n.02", "packing_box.n.02"),
    "bread.n.01": ("sour_bread.n.01", "baguet.n.01"),
    "brush.n.02": ("scrub_brush.n.01", "hairbrush.n.01"),
    "cake.n.03": ("chocolate_cake.n.01", "fruitcake.n.02"),
    "candle.n.01": ("pillar_candle.n.01", "dip.n.07"),
    "candy.n.01": ("hard_candy.n.01", "candy_cane.n.01"),
    "catsup.n.01": ("bottle__of__catsup.n.01",),
    "cereal.n.03": ("box__of__cereal.n.01",),
    "chair.n.01": ("straight_chair.n.01", "swivel_chair.n.01"),
    "cheese.n.01": ("cheesecake.n.01", "cheese_tart.n.01"),
    "cleansing_agent.n.01": ("bottle__of__cleaner.n.01", "bottle__of__detergent.n.01"),
    "cookie.n.01": ("butter_cookie.n.01", "chocolate_chip_cookie.n.01"),
    "cracker.n.01": ("box__of__crackers.n.01",),
    "cube.n.05": ("toy_dice.n.01",),
    "cup.n.01": ("coffee_cup.n.01", "mug.n.04"),
    "detergent.n.02": ("bottle__of__detergent.n.01",),
    "dish.n.01": ("plate.n.04", "bowl.n.01"),
    "document.n.01": ("legal_document.n.01",),
    "dryer.n.01": ("clothes_dryer.n.01",),
    "duffel_bag.n.01": ("bag.n.06", "shoulder_bag.n.01"),
    "earphone.n.01": ("headset.n.01",),
    "fish.n.02": ("trout.n.01", "salmon.n.03"),
    "flour.n.01": ("bag__of__flour.n.01",),
    "food.n.01": ("canned_food.n.01", "can__of__corn.n.01"),
    "food.n.02": ("canned_food.n.01", "can__of__corn.n.01"),
    "fork.n.01": ("tablefork.n.01",),
    "highlighter.n.02": ("marker.n.03",),
    "jar.n.01": ("hinged_jar.n.01",),
    "jewelry.n.01": ("necklace.n.01", "bracelet.n.02"),
    "juice.n.01": ("bottle__of__apple_juice.n.01", "bottle__of__lemon_juice.n.01"),
    "knife.n.01": ("table_knife.n.01", "carving_knife.n.01"),
    "lamp.n.02": ("table_lamp.n.01",),
    "makeup.n.01": ("lipstick.n.01",),
    "meat.n.01": ("virginia_ham.n.01", "steak.n.01"),
    "melon.n.01": ("watermelon.n.02",),
    "milk.n.01": ("carton__of__milk.n.01",),
    "oatmeal.n.01": ("box__of__oatmeal.n.01",),
    "package.n.02": ("carton.n.02",),
    "pad.n.01": ("notepad.n.01",),
    "pan.n.01": ("frying_pan.n.01",),
    "pasta.n.02": ("pasta__box.n.01",),
    "perfume.n.02": ("bottle__of__perfume.n.01",),
    "piece_of_cloth.n.01": ("rag.n.01", "dishtowel.n.01"),
    "plaything.n.01": ("toy_figure.n.01", "toy_car.n.01"),
    "pool.n.01": ("wading_pool.n.01",),
    "pop.n.02": ("bottle__of__pop.n.01",),
    "receptacle.n.01": ("storage_container.n.01",),
    "sandwich.n.01": ("club_sandwich.n.01",),
    "sauce.n.01": ("bottle__of__barbecue_sauce.n.01", "bottle__of__hot_sauce.n.01"),
    "saw.n.02": ("ripsaw.n.01",),
    "seat.n.03": ("straight_chair.n.01", "bench.n.01"),
    "shampoo.n.01": ("bottle__of__shampoo.n.01",),
    "sheet.n.03": ("blanket.n.01",),
    "shirt.n.01": ("tank_top.n.01", "dress_shirt.n.01"),
    "shower.n.01": ("shower_stall.n.01",),
    "shoe.n.01": ("gym_shoe.n.01", "baby_shoe.n.01"),
    "snack_food.n.01": ("bag__of__snacks.n.01",),
    "soap.n.01": ("bar_soap.n.01",),
    "soup.n.01": ("bottle__of__soup.n.01",),
    "spoon.n.01": ("tablespoon.n.02", "teaspoon.n.02"),
    "stocking.n.01": ("christmas_stocking.n.01", "sock.n.01"),
    "sugar.n.01": ("granulated_sugar__sack.n.01",),
    "sunglass.n.01": ("sunglasses.n.02",),
    "sweater.n.01": ("sweatshirt.n.01",),
    "table.n.02": ("breakfast_table.n.01", "coffee_table.n.01"),
    "tomato.n.01": ("beefsteak_tomato.n.01",),
    "toothpaste.n.01": ("tube__of__toothpaste.n.01",),
    "towel.n.01": ("hand_towel.n.01", "bath_towel.n.01"),
    "underwear.n.01": ("brassiere.n.01", "sock.n.01"),
    "vegetable_oil.n.01": ("bottle__of__cooking_oil.n.01",),
    "vehicle.n.01": ("car.n.01",),
    "vessel.n.03": ("bowl.n.01",),
    "water.n.06": ("bottle__of__water.n.01",),
    "window.n.01": ("openable_window.n.01",),
    "wrapping.n.01": ("wrapping_paper.n.01",),
    "yogurt.n.01": ("cup__of__yogurt.n.01",),
}
"""Types of BEHAVIOR-100, used by EAI's tasks: groups, and foods and liquids, which are packed objects here.

Types whose models can't do what the tasks need are replaced as well. The catalog's only backpack is too wide for the
gripper, its shirt is spread out, its package has no lid, and its alarm clock has no switch.
"""
LAMPS: Final[Mapping[str, tuple[str, ...]]] = {
    "room_light.n.01": ("floor_lamp.n.01",),
    "ceiling_fan.n.01": ("electric_fan.n.01",),
}
"""Replacements for what hangs at the ceiling and is switched.

Ceiling lights have no switch in the catalog, and both are out of reach.
"""
_TYPE: Final = re.compile(r"(?<![\w.\-])([a-z_\-]+\.n\.\d+)(?![\d_])", re.IGNORECASE)
_SWITCHED: Final = re.compile(r"\(\s*toggled_on\s+\??([a-z_\-]+\.n\.\d+)", re.IGNORECASE)


@functools.lru_cache(maxsize=16)
def read_problem(source: SourceText) -> tuple[BddlProblem, tuple[str, ...]]:
    """Parse a source, translate its types and relations, and add implied rooms. Return the problem and notes.

    Raise BddlError.
    """
    words = GROUPS if source.source == EAI else RENAMED
    text, replaced = translate_types(source.text, {**words, **_lamps_for(source.text)})
    problem, read = with_possible_relations(with_named_substances(parse_problem(text)))
    problem, left = without_places_left(problem)
    problem, added = with_implied_rooms(problem)
    return problem, (*replaced, *read, *left, *added)


def _lamps_for(text: str) -> dict[str, tuple[str, ...]]:
    """Return the replacements for lights that the start or the goal switches."""
    switched = {name.lower() for name in _SWITCHED.findall(text)}
    return {name: lamps for name, lamps in LAMPS.items() if name in switched}


def translate_types(text: str, words: Mapping[str, tuple[str, ...]]) -> tuple[str, tuple[str, ...]]:
    """Replace types in BDDL text, and return a sentence for each replacement. Object names stay."""
    found = dict.fromkeys(name.lower() for name in _TYPE.findall(text))
    chosen: dict[str, str] = {}
    for name in found:
        options = words.get(name, ())
        free = [other for other in options if other not in found and other not in chosen.values()]
        if free:
            chosen[name] = free[0]
    notes = tuple(f"{name} is read as {other}" for name, other in chosen.items())
    return _TYPE.sub(lambda match: chosen.get(match[1].lower(), match[1]), text), notes


_OTHER: Final = {Relation.ONTOP.value: Relation.INSIDE, Relation.INSIDE.value: Relation.ONTOP}


def with_possible_relations(problem: BddlProblem) -> tuple[BddlProblem, tuple[str, ...]]:
    """Replace ``ontop`` by ``inside`` for types that have cavities only, and ``inside`` by ``ontop`` for shelves.

    Return a sentence for each replaced pair of relation and type.
    """
    bound = {
        variable: type_name
        for part in subformulas(problem.goal)
        if isinstance(part, Quantified)
        for variable, type_name in part.binders
    }
    notes: dict[str, None] = {}

    def read(atom: Atom) -> Atom:
        other = _OTHER.get(atom.predicate)
        host = atom.args[-1]
        type_name = bound.get(host) or problem.objects.get(host, "")
        if other is None or _takes(type_name, Relation(atom.predicate)) or not _takes(type_name, other):
            return atom
        if other is Relation.ONTOP and not _has_boards(type_name):
            return atom
        notes[f"{atom.predicate} {type_name} is read as {other.value}"] = None
        return Atom(other.value, atom.args)

    init = tuple(InitLiteral(read(item.atom), item.positive) for item in problem.init)
    goal = map_atoms(problem.goal, read)
    return dataclasses.replace(problem, init=init, goal=goal), tuple(notes)


@functools.cache
def _takes(type_name: str, relation: Relation) -> bool:
    """True if any model of the type has a surface for objects with this relation to it."""
    return any(surfaces_for(asset, relation) for asset in _assets_of(type_name))


@functools.cache
def _has_boards(type_name: str) -> bool:
    """True if any model of the type has shelf boards."""
    return any(surface.framed for asset in _assets_of(type_name) for surface in asset.supports)


def _assets_of(type_name: str) -> Iterator[Asset]:
    """Yield all models of a type; none of an unknown one."""
    catalog = Catalog.load()
    for category in catalog.categories_of(type_name) if catalog.has_synset(type_name) else ():
        for model in catalog.models_of(category):
            yield build_asset(catalog, model.category, model.model_id)


def with_named_substances(problem: BddlProblem) -> BddlProblem:
    """Declare the substances that start or goal name by their synset, such as ``dust.n.01``."""
    atoms = (*atoms_of(problem.goal), *(item.atom for item in problem.init))
    named = {arg for atom in atoms for arg in atom.args if arg not in problem.objects and is_substance(arg)}
    if not named:
        return problem
    return dataclasses.replace(problem, objects={**problem.objects, **{arg: arg for arg in sorted(named)}})


def without_places_left(problem: BddlProblem) -> tuple[BddlProblem, tuple[str, ...]]:
    """Drop the start's place of an object that the goal also wants elsewhere, and return a sentence for each.

    Some of the paper's goals repeat the start: *on the floor and on the shelf*. No state meets them. A pair of hosts of
    which one is on or in the other is no contradiction.
    """
    parts = _conjuncts(problem.goal)
    wanted = [part for part in parts if isinstance(part, Atom) and part.predicate == Relation.ONTOP]
    started = {item.atom for item in problem.init if item.positive}
    rests = {frozenset(pair) for pair in problem.initial_pairs(Relation.ONTOP, Relation.INSIDE)}
    rests |= {frozenset(part.args) for part in parts if isinstance(part, Atom) and len(part.args) == 2}
    dropped = [
        part
        for part in wanted
        if part in started
        and any(
            other.args[0] == part.args[0]
            and other not in started
            and frozenset((other.args[1], part.args[1])) not in rests
            for other in wanted
        )
    ]
    if not dropped:
        return problem, ()
    goal = And(tuple(part for part in parts if part not in dropped))
    notes = tuple(
        f"({' '.join((part.predicate, *part.args))}) is left out of the goal: the object is to go elsewhere"
        for part in dropped
    )
    return dataclasses.replace(problem, goal=goal), notes


def _conjuncts(goal: Formula) -> list[Formula]:
    """Return the parts of a goal that must all hold."""
    if not isinstance(goal, And):
        return [goal]
    return [part for each in goal.parts for part in _conjuncts(each)]


def with_implied_rooms(problem: BddlProblem) -> tuple[BddlProblem, tuple[str, ...]]:
    """Add implied rooms, and return a sentence for each addition.

    A room used as a host becomes the room of the object. A floor without a room gets the room of the objects on it.
    """
    notes: list[str] = []
    problem = _rooms_as_rooms(problem, notes)
    return _placed(problem, notes), tuple(notes)


def _rooms_as_rooms(problem: BddlProblem, notes: list[str]) -> BddlProblem:
    def read(atom: Atom) -> Atom:
        host = atom.args[-1]
        names_room = host not in problem.objects and is_room_instance(host)
        if len(atom.args) == 2 and atom.predicate in (Relation.ONTOP, Relation.INSIDE) and names_room:
            notes.append(f"({atom.predicate} {atom.args[0]} {host}) is read as being in the room")
            return Atom(Relation.INROOM.value, atom.args)
        return atom

    init = tuple(InitLiteral(read(item.atom), item.positive) for item in problem.init)
    return dataclasses.replace(problem, init=init, goal=map_atoms(problem.goal, read))


def _placed(problem: BddlProblem, notes: list[str]) -> BddlProblem:
    known = dict(problem.initial_pairs(Relation.INROOM))
    rests = dict(problem.initial_pairs(*set(Relation) - {Relation.INROOM}))
    if not known:
        return problem
    added: list[InitLiteral] = []

    def put(name: str, room: str) -> None:
        known[name] = room
        added.append(InitLiteral(Atom(Relation.INROOM.value, (name, room))))
        notes.append(f"{name} has no room: {room} is assumed")

    first = next(iter(known.values()))
    for name, type_name in problem.objects.items():
        if type_name in FLOORS and name not in known:
            above = next(
                (
                    known[object_name]
                    for object_name, host in rests.items()
                    if host == name and object_name in known
                ),
                first,
            )
            put(name, above)
    return dataclasses.replace(problem, init=(*problem.init, *added)) if added else problem

"""Appliances that a goal needs and that neither its problem nor the scene has, such as a fridge in a school's corridor.

The paper's tasks freeze food in coolers, which only keep drinks cool.
"""

import dataclasses
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Final

from embomatrix.factory.assets.library import build_asset
from embomatrix.skills.appliances import cold_source, cooks, freezes, heat_source, heats
from embomatrix.world.asset import Asset
from embomatrix.world.bddl import BddlProblem, InitLiteral
from embomatrix.world.catalog import Catalog
from embomatrix.world.evaluate import atoms_of
from embomatrix.world.goal import Atom
from embomatrix.world.scene import Scene
from embomatrix.world.state import THERMAL, Relation, State


def _gives_cold(asset: Asset, _: Sequence[Asset]) -> bool:
    source = cold_source(asset)
    return source is not None and freezes(source)


def _gives_heat(asset: Asset, _: Sequence[Asset]) -> bool:
    source = heat_source(asset)
    return source is not None and heats(source)


def _cooks_all(asset: Asset, foods: Sequence[Asset]) -> bool:
    """True if the asset cooks each of the foods: a microwave warms a tortilla and doesn't bake it."""
    source = heat_source(asset)
    return (
        source is not None
        and heats(source)
        and all(cooks(source, food) for food in foods if food.can("cookable"))
    )


SOURCES: Final[Mapping[State, tuple[str, Callable[[Asset, Sequence[Asset]], bool]]]] = {
    State.FROZEN: ("electric_refrigerator.n.01", _gives_cold),
    State.HOT: ("oven.n.01", _gives_heat),
    State.COOKED: ("oven.n.01", _cooks_all),
}
"""Type of the appliance that is added for each state, and the test of a sufficient one for some objects."""


def with_missing_sources(problem: BddlProblem, base: Scene) -> BddlProblem:
    """Return the problem with one appliance more for each state that nothing can bring about.

    It stands in the first room that the start names. Goals that name their source, and starts without rooms, get none.
    """
    rooms = problem.initial_pairs(Relation.INROOM)
    wanted: defaultdict[State, set[str]] = defaultdict(set)
    for atom in atoms_of(problem.goal):
        if atom.predicate in THERMAL and len(atom.args) == 1:
            name = atom.args[0].lstrip("?")
            wanted[State(atom.predicate)].add(problem.objects.get(name, name))
    if not rooms or not wanted:
        return problem
    assets = [base.asset_of(item.name) for item in base.objects if item.fixed]
    assets += _assets_of(set(problem.objects.values()))
    lacking = {
        SOURCES[state][0]
        for state, types in wanted.items()
        if not _has_source(assets, SOURCES[state][1], _assets_of(types))
    }
    objects, init = dict(problem.objects), list(problem.init)
    for type_name in sorted(lacking):
        name = f"{type_name}_{len(problem.types.get(type_name, ())) + 1}"
        objects[name] = type_name
        init.append(InitLiteral(Atom(Relation.INROOM.value, (name, rooms[0][1]))))
    return dataclasses.replace(problem, objects=objects, init=tuple(init))


def _has_source(
    assets: Iterable[Asset], suffices: Callable[[Asset, Sequence[Asset]], bool], treated: Sequence[Asset]
) -> bool:
    return any(suffices(asset, treated) for asset in assets)


def _assets_of(types: Iterable[str]) -> list[Asset]:
    """Return a model of each category of the types, since abilities belong to categories."""
    catalog = Catalog.load()
    return [
        build_asset(catalog, model.category, model.model_id)
        for type_name in types
        if catalog.has_synset(type_name)
        for category in catalog.categories_of(type_name)
        for model in catalog.models_of(category)[:1]
    ]

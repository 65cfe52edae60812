"""Where people keep things: by category where furnishing knows it, else by the group of things that they belong to."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Final

from embomatrix.factory.furnish.hosts import NO_HOSTS, hosts_of
from embomatrix.factory.furnish.small_objects import HOST_GROUPS, MEMBERS, ItemKind, suits

if TYPE_CHECKING:
    from collections.abc import Mapping

_TABLES: Final = "breakfast_table dining_table pedestal_table"
_BY_GROUP: Final[Mapping[ItemKind, str]] = {
    ItemKind.FOOD: f"countertop fridge {_TABLES} commercial_kitchen_table bar bottom_cabinet plate",
    ItemKind.FRUIT: f"countertop {_TABLES} fridge bar bottom_cabinet coffee_table bowl",
    ItemKind.TABLEWARE: f"{_TABLES} countertop bar bottom_cabinet top_cabinet coffee_table booth",
    ItemKind.PACKAGES: f"countertop bottom_cabinet top_cabinet grocery_shelf shelf {_TABLES} bar",
    ItemKind.BOOKS: f"bookcase desk nightstand coffee_table shelf console_table {_TABLES}",
    ItemKind.TOYS: f"bed bookcase toy_box sofa coffee_table shelf {_TABLES}",
    ItemKind.DEVICES: f"coffee_table desk console_table nightstand bookcase sofa bottom_cabinet {_TABLES}",
    ItemKind.OFFICE: f"desk conference_table reception_desk bookcase shelf console_table {_TABLES} bottom_cabinet",
    ItemKind.TOILETRIES: "countertop furniture_sink pedestal_sink shelf bottom_cabinet multi_station_furniture_sink",
    ItemKind.DECORATION: f"console_table bookcase nightstand coffee_table bottom_cabinet shelf desk {_TABLES}",
}
_APPLIANCES: Final = frozenset(
    (
        "oven", "microwave", "toaster_oven", "fridge", "freezer", "wine_fridge", "display_fridge", "grocery_fridge",
        "dishwasher", "washer", "clothes_dryer", "coffee_maker", "toaster", "hot_tub", "range_hood",
    )
)  # fmt: skip
"""Nobody leaves things on top of them."""


@functools.cache
def likes(category: str) -> tuple[str, ...]:
    """Furniture that a thing is put on or in, best first; empty when nothing is known."""
    found = hosts_of(category)
    group = next((group for group, members in MEMBERS.items() if category in members), None)
    return tuple(dict.fromkeys((*found, *_BY_GROUP[group].split()))) if group else found


def may_hold(host: str, category: str) -> bool:
    """Whether people put such a thing on or in such furniture without a second thought."""
    nothing = HOST_GROUPS.get(host) == frozenset() or host in _APPLIANCES
    return not nothing and suits(category, host) and (host in likes(category) or host not in NO_HOSTS)


def on_appliance(host: str) -> bool:
    """Whether the top of such furniture is an appliance's."""
    return host in _APPLIANCES

"""Background of a scene: objects that real rooms hold beside the furniture, seen and collided with, but never named.

A room gets as many as real rooms of its type hold, as far as its walls and surfaces have room. Surfaces stay free for tasks.
"""

import math
import zlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from embomatrix.factory.clutter.models import ModelShelf
from embomatrix.factory.clutter.shares import (
    ANY_SHELF,
    RoomShares,
    host_weight,
    shares_for,
    wanted,
)
from embomatrix.factory.clutter.space import TakenSpace
from embomatrix.factory.clutter.supports import (
    SHELF_FILLED,
    FreeSurface,
    cover,
    free_surface,
    row_of_books,
    spot_on,
    surfaces_of,
)
from embomatrix.factory.clutter.tables import ON_WALL
from embomatrix.factory.clutter.walls import spot_on_wall
from embomatrix.world.asset import Asset
from embomatrix.world.catalog import Catalog
from embomatrix.world.geometry import Aabb, Pose
from embomatrix.world.scene import BackgroundObject, Room, Scene

HOMES: Final = frozenset(("living_room", "bedroom"))
"""A scene with one of these rooms is a home. Shops, schools and offices are furnished densely by their inventories."""
BOOKS: Final = frozenset(("hardback", "paperback_book"))
BOOKS_IN_A_CASE: Final = 3.0
"""Wish for books in a room with a bookcase."""
ROW: Final = (4, 9)
"""Numbers of books in a row."""
SHELF_HOLDS: Final = 6
"""Objects that a further shelf is worth."""
SHELF_TRIES: Final = 4
"""Models of a shelf that are tried: a short one fits where a long one does not."""
MOST_PICTURES: Final = 5
ROUNDS: Final = (1, 2, 3)
"""Multiples of the mean number of a category that a room holds at most; shelves are added between the rounds."""
REPEATED: Final = 0.35
"""Factor on the wish for a category with each object of it in the room."""
UPRIGHT_BY: Final = 0.05
"""Height range in which furniture stands on the floor."""
STANDS_M: Final = 0.002
"""Greatest gap between a background object and the one that it stands on."""


def with_background(scene: Scene) -> Scene:
    """Return the scene with background objects in the rooms of a home. Equal scenes give equal results."""
    if not any(room.type in HOMES for room in scene.rooms):
        return scene
    rng = np.random.default_rng(np.random.SeedSequence((scene.seed, zlib.crc32(scene.scene_id.encode()), 1)))
    models = ModelShelf(Catalog.load(), rng)
    taken = TakenSpace.of_scene(scene)
    found: list[BackgroundObject] = []
    assets = dict(scene.assets)
    for room in scene.rooms:
        shares = shares_for(room.type)
        if shares is not None:
            filling = RoomFilling(scene, room, shares, taken, models, rng)
            filling.fill()
            found += filling.placed
            assets = filling.assets | assets
    return replace(scene, background=tuple(found), assets=assets)


def without_covered(scene: Scene, needed: TakenSpace) -> tuple[BackgroundObject, ...]:
    """Return the background that neither reaches into a space nor stands on background that does."""
    things, boxes = scene.background, scene.background_boxes
    gone = {number for number, box in enumerate(boxes) if not needed.is_free(box)}
    waiting = list(gone)
    while waiting:
        below = boxes[waiting.pop()]
        standing = Aabb((*below.low_m[:2], below.high_m[2]), (*below.high_m[:2], below.high_m[2] + STANDS_M))
        above = {
            n
            for n, box in enumerate(boxes)
            if not things[n].host and n not in gone and standing.overlaps(box)
        }
        above = {n for n in above if boxes[n].low_m[2] >= below.high_m[2]}
        gone |= above
        waiting += sorted(above)
    return tuple(item for number, item in enumerate(things) if number not in gone)


class RoomFilling:
    """Background objects of one room, chosen one after the other."""

    def __init__(
        self,
        scene: Scene,
        room: Room,
        shares: RoomShares,
        taken: TakenSpace,
        models: ModelShelf,
        rng: np.random.Generator,
    ) -> None:
        self.placed: list[BackgroundObject] = []
        self.assets: dict[str, Asset] = {}
        self._room = room
        self._taken = taken.within(room)
        self._models = models
        self._rng = rng
        mine = [item for item in scene.objects if item.room == room.name and not item.absent]
        self._low = TakenSpace.of(
            scene.box_of(item.name)
            for item in mine
            if item.fixed
            and scene.box_of(item.name).low_m[2] < UPRIGHT_BY < scene.box_of(item.name).high_m[2]
        )
        self._surfaces = list(surfaces_of(scene, room.name, rng))
        self._counts = Counter(scene.assets[item.asset_id].category for item in mine)
        low, middle, high = shares.quartiles
        goal = np.interp(rng.uniform(0.25, 0.75), (0.25, 0.5, 0.75), (low, middle, high))
        self._missing = max(0, round(float(goal)) - len(mine))
        self._wishes = dict(wanted(room.type))
        if any(surface.category == "bookcase" for surface in self._surfaces):
            self._wishes["hardback"] = BOOKS_IN_A_CASE

    def fill(self) -> None:
        """Hang objects on the walls, then put objects on the furniture, then on shelves as far as some are missing."""
        self._hang_all()
        for most in ROUNDS:
            self._put_all(most)
            if self._missing >= SHELF_HOLDS and self._add_shelf():
                self._put_all(most)
        while self._missing > 0 and self._counts["painting"] + self._counts["picture"] < MOST_PICTURES:
            if not self._hang("picture") and not self._hang("painting"):
                break

    def _hang_all(self) -> None:
        """Hang as many objects of each category as real rooms have; a clock and some pictures belong everywhere."""
        for category in (*sorted(ON_WALL), "wall_clock"):
            mean = self._wishes.get(category, 0.6)
            if category in ("bath_towel", "hand_towel", "towel_rack") and category not in self._wishes:
                continue
            for _ in range(int(mean + self._rng.random()) - self._counts[category]):
                self._hang(category)

    def _hang(self, category: str) -> bool:
        asset = self._models.pick(category) if self._missing > 0 else None
        spot = (
            spot_on_wall(self._room, asset, self._taken, self._low, self._rng) if asset is not None else None
        )
        if asset is None or spot is None:
            return False
        self._add(asset, *spot, "")
        return True

    def _put_all(self, most: int) -> None:
        """Put objects on the surfaces until none is missing or nothing more fits.

        There are at most ``most`` times as many of a category as in real rooms, apart from books.
        """
        wishes = {c: mean for c, mean in self._wishes.items() if c not in ON_WALL}
        while self._missing > 0 and wishes:
            names = sorted(wishes)
            weights = np.array([wishes[n] * REPEATED ** min(self._counts[n], 8) for n in names])
            category = names[int(self._rng.choice(len(names), p=weights / weights.sum()))]
            many = category not in BOOKS and self._counts[category] >= most * math.ceil(
                self._wishes[category]
            )
            if many or not self._put(category):
                del wishes[category]

    def _put(self, category: str) -> bool:
        """Put an object, or a row of books, on the surface that suits it best. Return False if none has room."""
        for surface in self._ranked(category):
            if category in BOOKS and surface.category in ("bookcase", ANY_SHELF):
                if self._put_books(surface):
                    return True
                continue
            asset = self._models.pick(category)
            spot = spot_on(surface, asset, self._taken, self._rng) if asset is not None else None
            if asset is not None and spot is not None:
                cover(surface, asset)
                self._add(asset, *spot, surface.host)
                return True
        return False

    def _put_books(self, surface: FreeSurface) -> bool:
        if not BOOKS.isdisjoint(surface.kinds):
            return False
        count = min(self._missing, int(self._rng.integers(*ROW)))
        books = [self._models.pick("hardback") for _ in range(count)]
        row = row_of_books(surface, [book for book in books if book is not None], self._taken)
        for asset, pose, box in row:
            self._add(asset, pose, box, surface.host)
        surface.kinds += [row[0][0].category] if row else []
        return bool(row)

    def _ranked(self, category: str) -> Sequence[FreeSurface]:
        weights = [host_weight(category, each.category, self._room.type) for each in self._surfaces]
        noisy = [weight * (0.4 + self._rng.random()) for weight in weights]
        order = sorted(range(len(noisy)), key=lambda i: -noisy[i])
        return [self._surfaces[i] for i in order if weights[i] > 0 and not self._surfaces[i].is_full]

    def _add_shelf(self) -> bool:
        """Hang a shelf on a wall, with a row of books if books belong in the room. Its top becomes a surface."""
        asset = next((shelf for _ in range(SHELF_TRIES) if (shelf := self._hung_shelf())), None)
        if asset is None:
            return False
        # A background object collides as its bounding box, so only the top of a shelf holds others.
        top = max(asset.supports, key=lambda surface: surface.center_m[2])
        pose = self.placed[-1].pose_world_asset
        board = free_surface("", asset, pose, top, SHELF_FILLED, self._rng)
        self._surfaces.insert(0, board)
        if not BOOKS.isdisjoint(self._wishes):
            self._put_books(board)
        return True

    def _hung_shelf(self) -> Asset | None:
        asset = self._models.pick(ANY_SHELF)
        spot = (
            spot_on_wall(self._room, asset, self._taken, self._low, self._rng) if asset is not None else None
        )
        if asset is None or spot is None:
            return None
        self._add(asset, *spot, "")
        return asset

    def _add(self, asset: Asset, pose: Pose, box: Aabb, host: str) -> None:
        self.placed.append(BackgroundObject(asset.asset_id, self._room.name, pose, host))
        self.assets[asset.asset_id] = asset
        self._taken.take(box)
        self._counts[asset.category] += 1
        self._missing -= 1

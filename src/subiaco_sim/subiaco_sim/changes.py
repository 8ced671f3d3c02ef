"""Known changes of every label, and the things that look like change and are none."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from subiaco_geo.frames import Floats
from subiaco_sim.buildings import House
from subiaco_sim.ground import ROAD_HALF, Patch
from subiaco_sim.plants import Hedge, Tree
from subiaco_sim.primitives import Material
from subiaco_sim.scene import GroundItem, Item
from subiaco_sim.suburb import SETBACK, Layout, random_car, walk_lots

Edit = Callable[[Item, np.random.Generator], Item]


def _reshaped(item: Item, event: str, **change: object) -> Item:
    assert item.after is not None
    shape = replace(item.after.shape, **change)  # type: ignore[type-var]
    return replace(item, after=replace(item.after, shape=shape), event=event)


def added(item: Item, _: np.random.Generator) -> Item:
    """Let the item stand only in the later epoch."""
    return replace(item, before=None, event="added")


def removed(item: Item, _: np.random.Generator) -> Item:
    """Let the item stand only in the earlier epoch."""
    return replace(item, after=None, event="removed")


def _house(item: Item) -> House:
    assert item.before is not None
    assert isinstance(item.before.shape, House)
    return item.before.shape


def storey_added(item: Item, _: np.random.Generator) -> Item:
    """Put a storey on a house."""
    return _reshaped(item, "storey added", storeys=_house(item).storeys + 1)


def part_demolished(item: Item, _: np.random.Generator) -> Item:
    """Take a storey off, or where there is one only, the roof and a part of the width."""
    house = _house(item)
    if house.storeys > 1:
        return _reshaped(item, "storey removed", storeys=house.storeys - 1)
    return _reshaped(item, "partly demolished", roof="flat", width=0.7 * house.width, chimney=False)


def extended(item: Item, _: np.random.Generator) -> Item:
    """Build a lower wing on to the side."""
    return _reshaped(item, "extended", extension=3.0)


def reroofed(item: Item, _: np.random.Generator) -> Item:
    """Replace the cladding and take the chimney down: no change by the rules."""
    cover = Material.TILE if _house(item).cover is Material.SHEET_METAL else Material.SHEET_METAL
    return _reshaped(item, "re-roofed", chimney=False, cover=cover)


def _tree(item: Item) -> Tree:
    assert item.before is not None
    assert isinstance(item.before.shape, Tree)
    return item.before.shape


def _scaled(item: Item, event: str, factor: float, rng: np.random.Generator) -> Item:
    tree = _tree(item)
    bare = tree.height - tree.crown
    return _reshaped(
        item,
        event,
        height=bare + tree.crown * factor,
        crown=tree.crown * factor,
        radius=tree.radius * factor,
        leaves=int(rng.integers(2**31)),
    )


def grown(item: Item, rng: np.random.Generator) -> Item:
    """Let a crown grow by a third."""
    return _scaled(item, "grown", 1.35, rng)


def pruned(item: Item, rng: np.random.Generator) -> Item:
    """Cut a crown back by a third."""
    return _scaled(item, "pruned", 0.65, rng)


def new_leaves(item: Item, rng: np.random.Generator) -> Item:
    """Renew the leaves and let the crown grow by 1 %: no change by the rules."""
    if isinstance(item.before and item.before.shape, Tree):
        return _scaled(item, "", 1.01, rng)
    return _reshaped(item, "", leaves=int(rng.integers(2**31)))


#: kind of item -> edits in the order in which they are dealt out
STOCK: dict[str, tuple[Edit, ...]] = {
    "house": (added, storey_added, removed, part_demolished, extended, reroofed),
    "street tree": (added, removed, grown, pruned),
    "garden tree": (removed, added),
    "car": (added, removed, added, removed),
}


def apply_changes(layout: Layout, rounds: int) -> list[Item]:
    """Deal the stock of edits ``rounds`` times to items near the middle of the route.

    Everything else with leaves gets new ones.
    """
    edited = {item.object_id: item for item in layout.items}
    centre = layout.centreline[len(layout.centreline) // 2]
    for kind, edits in STOCK.items():
        chosen = _candidates(layout, kind, centre, len(edits) * rounds)
        for number, item in enumerate(chosen):
            edited[item.object_id] = edits[number % len(edits)](item, layout.rng)
    return [_natural(item, layout.rng) for item in edited.values()]


def _distance(item: Item, place: Floats) -> float:
    state = item.before or item.after
    assert state is not None
    return float(np.hypot(state.x - place[0], state.y - place[1]))


def _candidates(layout: Layout, kind: str, centre: Floats, count: int) -> list[Item]:
    """Return the items of a kind nearest to a place, every other one left alone where there are enough."""
    items = sorted((i for i in layout.items if i.kind == kind), key=lambda i: _distance(i, centre))
    spread = items[::2] if len(items) >= 2 * count else items
    chosen = spread[:count]
    order = layout.rng.permutation(len(chosen))
    return [chosen[k] for k in order]


def _natural(item: Item, rng: np.random.Generator) -> Item:
    shape = item.before.shape if item.before is not None else None
    leafy = isinstance(shape, Tree | Hedge)
    return new_leaves(item, rng) if leafy and not item.event and item.after is not None else item


def replaced_cars(items: list[Item], rng: np.random.Generator, share: float = 0.5) -> list[Item]:
    """Let other cars of the same size class stand in some occupied bays: matched, so Unchanged."""

    def swap(item: Item) -> Item:
        if item.kind != "car" or item.event or item.after is None or rng.random() > share:
            return item
        return replace(item, after=replace(item.after, shape=random_car(rng)), event="another car")

    return [swap(item) for item in items]


def ground_changes(layout: Layout, first_id: int, rounds: int) -> list[GroundItem]:
    """Resurface a strip, dig a patch, and two that stay under the thresholds."""
    kinds = [
        ("resurfaced", 16.0, 2.6, 0.25, ROAD_HALF - 1.6),
        ("excavated", 7.5, 4.6, -0.30, 8.2),
        ("thin overlay", 12.0, 2.6, 0.08, ROAD_HALF - 1.6),
        ("small pit", 3.2, 2.6, -0.30, 8.2),
    ]
    lots = list(walk_lots(layout.centreline, 14.0))
    lots.sort(
        key=lambda lot: float(np.hypot(*(layout.centreline[len(layout.centreline) // 2] - (lot.x, lot.y))))
    )
    found = []
    for number in range(rounds * len(kinds)):
        event, length, width, rise, offset = kinds[number % len(kinds)]
        lot = lots[2 * number + (1 if number % 2 else 0)]
        inward = offset - SETBACK
        x = float(lot.x - np.sin(lot.yaw) * inward)
        y = float(lot.y + np.cos(lot.yaw) * inward)
        found.append(GroundItem(first_id + number, Patch(x, y, length, width, lot.yaw, rise), event))
    return found

"""What happens to a crowded street between the epochs: changes by quota, and much that is none."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace

import numpy as np

from subiaco_geo.errors import InputError
from subiaco_sim.blocks import Apartments
from subiaco_sim.buildings import House, Shed
from subiaco_sim.changes import added, extended, part_demolished, removed, reroofed, storey_added
from subiaco_sim.ground import ROAD_HALF, Patch, Strip, strip_along
from subiaco_sim.neighbourhood import random_vehicle
from subiaco_sim.plants import Hedge, Palm, Tree
from subiaco_sim.scene import GroundItem, Item, Shape
from subiaco_sim.scene_config import Seasons
from subiaco_sim.suburb import SETBACK, Layout, from_lot

Edit = Callable[[Item, np.random.Generator], Item]
_GROWTH = 0.15  # of a crown upwards at most, half of what counts [m]


def _shape(item: Item) -> Shape:
    assert item.after is not None
    return item.after.shape


def _with_shape(item: Item, shape: Shape, event: str) -> Item:
    assert item.after is not None
    return replace(item, after=replace(item.after, shape=shape), event=event)


def _crown(item: Item, event: str, factor: float) -> Item:
    tree = _shape(item)
    assert isinstance(tree, Tree)
    crown = tree.crown * factor
    height = tree.height - tree.crown + crown
    return _with_shape(item, replace(tree, height=height, crown=crown, radius=tree.radius * factor), event)


def grown(item: Item, rng: np.random.Generator) -> Item:
    """Let a crown grow by 12 to 35 %."""
    return _crown(item, "grown", float(rng.uniform(1.12, 1.35)))


def pruned(item: Item, rng: np.random.Generator) -> Item:
    """Cut a crown back by 12 to 40 %."""
    return _crown(item, "pruned", float(rng.uniform(0.60, 0.88)))


def trimmed(item: Item, rng: np.random.Generator) -> Item:
    """Cut a hedge down by 0.35 to 0.6 m."""
    hedge = _shape(item)
    assert isinstance(hedge, Hedge)
    lower = max(0.4, hedge.height - float(rng.uniform(0.35, 0.6)))
    return _with_shape(item, replace(hedge, height=lower), "hedge trimmed")


def shot_up(item: Item, rng: np.random.Generator) -> Item:
    """Let a hedge or shrub grow by 0.35 to 0.7 m."""
    hedge = _shape(item)
    assert isinstance(hedge, Hedge)
    taller = hedge.height + float(rng.uniform(0.35, 0.7))
    return _with_shape(item, replace(hedge, height=taller), "hedge grown")


def raised(item: Item, _: np.random.Generator) -> Item:
    """Put a storey on an apartment block."""
    block = _shape(item)
    assert isinstance(block, Apartments)
    return _with_shape(item, replace(block, storeys=block.storeys + 1), "storey added")


def wing_built(item: Item, _: np.random.Generator) -> Item:
    """Build a wing towards the street, where there is none."""
    house = _shape(item)
    assert isinstance(house, House)
    if house.wing > 0:
        return _with_shape(item, replace(house, wing=0.0), "wing demolished")
    return _with_shape(item, replace(house, wing=3.0, veranda=0.0), "wing added")


def one_shed(item: Item, _: np.random.Generator) -> Item:
    """Replace two sheds by one that covers both."""
    return _with_shape(item, Shed(6.0, 2.6, 2.5), "two sheds became one")


def replaced(item: Item, rng: np.random.Generator) -> Item:
    """Let another vehicle stand in nearly the same place."""
    assert item.after is not None
    along, across = rng.uniform(-0.6, 0.6), rng.uniform(-0.15, 0.15)
    c, s = np.cos(item.after.yaw), np.sin(item.after.yaw)
    trucks = 0.6 if item.kind == "truck" else 0.0  # a car's bay is too short for one
    shape = random_vehicle(rng, trucks)
    x, y = item.after.x + c * along - s * across, item.after.y + s * along + c * across
    return replace(item, after=replace(item.after, shape=shape, x=x, y=y), event="another vehicle")


def moved(item: Item, rng: np.random.Generator) -> Item:
    """Let a bin stand a little aside: left out of the report by the rules, or unchanged."""
    assert item.after is not None
    return replace(
        item, after=replace(item.after, x=item.after.x + float(rng.uniform(0.1, 0.5))), event="moved"
    )


#: kind of item -> events, each with the share of the items of that kind that it happens to
QUOTAS: dict[str, tuple[tuple[Edit, float], ...]] = {
    "house": (
        (extended, 0.11),
        (wing_built, 0.09),
        (part_demolished, 0.10),
        (storey_added, 0.05),
        (added, 0.05),
        (removed, 0.05),
        (reroofed, 0.10),
    ),
    "terrace middle": ((removed, 0.35), (storey_added, 0.2)),
    "apartments": ((raised, 0.2),),
    "street tree": ((grown, 0.13), (pruned, 0.13), (added, 0.07), (removed, 0.07)),
    "garden tree": ((grown, 0.14), (pruned, 0.14), (added, 0.1), (removed, 0.1)),
    "back tree": ((grown, 0.1), (pruned, 0.1)),
    "palm": ((added, 0.12), (removed, 0.12)),
    "hedge": ((trimmed, 0.2), (shot_up, 0.16), (removed, 0.08), (added, 0.08)),
    "shrub": ((shot_up, 0.2), (trimmed, 0.12), (removed, 0.15), (added, 0.15)),
    "car": ((added, 0.2), (removed, 0.2), (replaced, 0.42)),
    "truck": ((added, 0.3), (removed, 0.3), (replaced, 0.4)),
    "shed": ((added, 0.25), (removed, 0.25)),
    "two sheds": ((one_shed, 0.7),),
    "fence": ((added, 0.03), (removed, 0.03)),
    "wall": ((added, 0.12), (removed, 0.12)),
    "bin": ((added, 0.15), (removed, 0.15), (moved, 0.5)),
    "sign": ((added, 0.1), (removed, 0.1)),
}


def quotas_with(shares: Mapping[str, Mapping[str, float]]) -> dict[str, tuple[tuple[Edit, float], ...]]:
    """Return the quotas with other shares of some events.

    Raises
    ------
    InputError
        A kind or an event of it is not known, or the shares of a kind exceed all there is.
    """
    quotas = dict(QUOTAS)
    for kind, asked in shares.items():
        known = {edit.__name__: share for edit, share in QUOTAS.get(kind, ())}
        if unknown := sorted(asked.keys() - known.keys()):
            raise InputError(f"scene.shares.{kind}: {unknown[0]} is not one of {', '.join(known) or 'any'}")
        known |= asked
        if min(known.values()) < 0 or sum(known.values()) > 1.0:
            raise InputError(f"scene.shares.{kind}: shares must be positive and at most 1 in all")
        quotas[kind] = tuple((edit, known[edit.__name__]) for edit, _ in QUOTAS[kind])
    return quotas


def let_time_pass(
    layout: Layout, seasons: Seasons, shares: Mapping[str, Mapping[str, float]] | None = None
) -> list[Item]:
    """Deal every kind's quotas to items at random; all other plants live through the seasons."""
    rng = layout.rng
    items = {item.object_id: item for item in layout.items}
    items |= {item.object_id: item for item in _crowns_meet_and_part(layout)}
    for kind, quotas in quotas_with(shares or {}).items():
        alike = [item for item in layout.items if item.kind == kind]
        order = rng.permutation(len(alike)).tolist()
        for edit, share in quotas:
            number = _count(share * len(alike), rng)
            chosen, order = order[:number], order[number:]
            for k in chosen:
                items[alike[k].object_id] = edit(alike[k], rng)
    return [_weathered(item, seasons, rng) for item in items.values()]


def _crowns_meet_and_part(layout: Layout) -> Iterator[Item]:
    """Let most twins grow into one another, and cut most joined crowns apart."""
    for kind, event, overlap in (("twin tree", "grown together", 0.6), ("joined tree", "cut apart", -0.5)):
        twins = [item for item in layout.items if item.kind == kind]
        for one, other in zip(twins[::2], twins[1::2], strict=True):
            if layout.rng.random() < 0.75:
                factor = (_gap(one, other) + overlap) / sum(_tree_of(item).radius for item in (one, other))
                yield from (_crown(item, event, factor) for item in (one, other))


def _tree_of(item: Item) -> Tree:
    tree = _shape(item)
    assert isinstance(tree, Tree)
    return tree


def _gap(one: Item, other: Item) -> float:
    assert one.after is not None
    assert other.after is not None
    return float(np.hypot(one.after.x - other.after.x, one.after.y - other.after.y))


def _count(expected: float, rng: np.random.Generator) -> int:
    """Round up or down at random, so that small stocks get their share over many seeds."""
    return int(expected + rng.random())


def _weathered(item: Item, seasons: Seasons, rng: np.random.Generator) -> Item:
    """Give a plant the leaves, the lean and the growth of a later season."""
    if item.after is None or not isinstance(item.after.shape, Tree | Hedge | Palm):
        return item
    shape = replace(item.after.shape, leaves=int(rng.integers(2**31)))
    if isinstance(shape, Tree):
        sheds = rng.random() < seasons.deciduous and not item.event
        density = seasons.bare if sheds else float(rng.uniform(0.7, 1.2))
        natural = min(float(rng.uniform(0.0, seasons.growth)), _GROWTH / shape.crown)
        factor = 1.0 if item.event else 1.0 + natural
        shape = replace(
            shape,
            density=density,
            sway=float(rng.uniform(0.0, seasons.sway)),
            crown=shape.crown * factor,
            height=shape.height + shape.crown * (factor - 1.0),
            radius=shape.radius * factor,
        )
    return replace(item, after=replace(item.after, shape=shape))


def work_the_ground(layout: Layout, first_id: int) -> list[GroundItem]:
    """Resurface strips along the kerb, dig and fill behind it, and settle less than counts."""
    found: list[GroundItem] = []
    worked: list[tuple[str, Strip | Patch]] = [*_strips(layout), *_plots(layout), *_yards(layout)]
    for event, patch in worked:
        if not any(patch.outline().intersects(other.patch.outline()) for other in found):
            found.append(GroundItem(first_id + len(found), patch, event))
    return found


def _strips(layout: Layout) -> list[tuple[str, Strip]]:
    """Return strips: kerb-side, 1 to 2 m wide with 0.20 to 0.50 m; settlement; a lane's camber made up."""
    rng, line = layout.rng, layout.centreline
    made = []
    count = max(3, len(line) // 200)  # one each 50 m
    starts = (np.arange(count) + rng.uniform(0.0, 0.3, count)) * len(line) / count
    for number, start in enumerate(starts.astype(int).tolist()):
        side = float(rng.choice(layout.sides))
        width = float(rng.uniform(1.0, 1.8))
        length = 28.0 / width + float(rng.uniform(2.0, 8.0))
        rise = float(rng.uniform(0.20, 0.50))
        event = ("resurfaced", "milled", "settled", "resurfaced", "cambered")[number % 5]
        little = float(rng.uniform(0.05, 0.12))
        rise = {"resurfaced": rise, "milled": -rise, "settled": -little, "cambered": little}[event]
        stop = min(start + int(4 * length), len(line) - 1)
        if stop - start > 40:
            kerb = ROAD_HALF + layout.setback - SETBACK
            offset = side * (1.7 if event == "cambered" else kerb - 0.1 - width / 2)
            made.append((event, strip_along(line, start, stop, offset, width, rise)))
    return made


def _plots(layout: Layout) -> list[tuple[str, Patch]]:
    """Return places in gardens that are dug, filled, or too small or shallow to count."""
    rng = layout.rng
    lots = list(layout.lots(14.0))
    kinds = (
        ("excavated", 7.5, 4.4, -0.35),
        ("filled", 7.0, 4.6, 0.35),
        ("small pit", 3.4, 2.6, -0.3),
        ("filled", 8.5, 4.2, 0.25),
        ("shallow fill", 7.5, 4.4, 0.1),
        ("excavated", 8.0, 4.0, -0.25),
    )
    made = []
    for number, k in enumerate(rng.permutation(len(lots))[: len(lots) // 3].tolist()):
        event, length, width, rise = kinds[number % len(kinds)]
        x, y = from_lot(lots[k], 0.0, 9.8 - SETBACK)
        made.append((event, Patch(x, y, length, width, lots[k].yaw, rise)))
    return made


def _yards(layout: Layout) -> list[tuple[str, Patch]]:
    """Return strips behind some gates, beside the house, that are dug or filled out of sight."""
    rng, made = layout.rng, []
    for gate in (item.after for item in layout.items if item.kind == "gate" and item.after is not None):
        if rng.random() < 0.25:
            event, rise = ("yard excavated", -0.4) if rng.random() < 0.5 else ("yard filled", 0.4)
            inward = np.array([-np.sin(gate.yaw), np.cos(gate.yaw)])
            x, y = (gate.x, gate.y) + 5.4 * inward
            made.append((event, Patch(float(x), float(y), 10.2, 2.6, gate.yaw + np.pi / 2, rise)))
    return made

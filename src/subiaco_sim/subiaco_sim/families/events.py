"""What happens to a street of either family between the epochs, with magnitudes that no gate divides.

Every magnitude is drawn evenly from a range that passes through the gates of the published evaluation: rises
of 0.05 to 0.50 m of ground and hedges, 0.05 to 0.90 m of eaves and crowns, 2 to 40 % of a volume.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from subiaco_sim.changes import added, removed
from subiaco_sim.families.buildings import Annexe, Building, CourtBlock
from subiaco_sim.families.foliage import Crown, Plant, Season, dressed
from subiaco_sim.families.roofs import Roof
from subiaco_sim.families.vehicles import random_vehicle
from subiaco_sim.plants import Hedge, Palm, Tree
from subiaco_sim.primitives import Material
from subiaco_sim.scene import Item, Shape
from subiaco_sim.suburb import Layout

Edit = Callable[[Item, np.random.Generator], Item]

RISE = (0.05, 0.50)  # of the ground and of hedges, up or down [m]
TALL_RISE = (0.05, 0.90)  # of eaves and of crowns, up or down [m]
SHARE = (0.02, 0.40)  # of a volume, more or less
_GROWTH = 0.03  # of a crown in the years between, at most; less than any gate
_SIDE_ROOM = 3.2  # beside a detached house at most [m]


def signed(span: tuple[float, float], rng: np.random.Generator) -> float:
    """Draw a magnitude evenly from a span, of either sign."""
    return float(rng.uniform(*span)) * (1.0 if rng.random() < 0.5 else -1.0)


def _building(item: Item) -> Building:
    assert item.after is not None
    assert isinstance(item.after.shape, Building)
    return item.after.shape


def _changed(item: Item, shape: Shape, event: str) -> Item:
    assert item.after is not None
    return replace(item, after=replace(item.after, shape=shape), event=event)


def lifted(item: Item, rng: np.random.Generator) -> Item:
    """Raise or lower the eaves by a little: insulation, a new ring beam, a lower roof."""
    assert item.after is not None
    shape, rise = item.after.shape, signed(TALL_RISE, rng)
    assert isinstance(shape, Building | CourtBlock)
    return _changed(
        item, replace(shape, eaves=shape.eaves + rise), "roof raised" if rise > 0 else "roof lowered"
    )


def storey_added(item: Item, rng: np.random.Generator) -> Item:
    """Put a storey of 2.5 to 3.3 m on a building."""
    assert item.after is not None
    shape = item.after.shape
    assert isinstance(shape, Building | CourtBlock)
    return _changed(item, replace(shape, eaves=shape.eaves + float(rng.uniform(2.5, 3.3))), "storey added")


def extended(item: Item, rng: np.random.Generator) -> Item:
    """Build on to the side of a detached house, by a share of its volume that the room beside it allows."""
    house = _building(item)
    share, depth = float(rng.uniform(*SHARE)), house.depth * float(rng.uniform(0.5, 0.95))
    height = float(rng.uniform(2.3, house.eaves))
    length = min(share * house.volume / (depth * height), _SIDE_ROOM)
    side = Annexe(-(house.width + length) / 2, 0.0, length, depth, 0.0, height)
    return _changed(item, replace(house, annexes=(*house.annexes, side)), "extended")


def built_upon(item: Item, rng: np.random.Generator) -> Item:
    """Put a set-back storey of a share of the volume on the roof."""
    house = _building(item)
    height = float(rng.uniform(2.3, 3.2))
    area = float(rng.uniform(*SHARE)) * house.volume / height
    width = min(house.width - 0.4, area / (0.7 * house.depth))
    depth = min(house.depth - 0.4, area / width)
    shift = float(rng.uniform(-1.0, 1.0)) * (house.width - width) / 2
    top = Annexe(shift, 0.0, width, depth, house.eaves - 0.1, house.eaves + height)
    return _changed(item, replace(house, annexes=(*house.annexes, top)), "built upon")


def bay_added(item: Item, rng: np.random.Generator) -> Item:
    """Hang a bay on the facade, above the footway."""
    house = _building(item)
    out, width = float(rng.uniform(0.4, 1.3)), float(rng.uniform(0.2, 0.9)) * house.width
    foot = 3.3
    bay = Annexe(0.0, -(house.depth + out) / 2, width, out, foot, max(foot + 2.4, house.eaves - 1.0))
    return _changed(item, replace(house, annexes=(*house.annexes, bay)), "bay added")


def part_demolished(item: Item, rng: np.random.Generator) -> Item:
    """Take a share of the volume away: a part of the width, or of the height."""
    house, share = _building(item), float(rng.uniform(*SHARE))
    if rng.random() < 0.5:
        cut = share * house.width
        return _changed(item, replace(house, cut=cut, chimney=False), "partly demolished")
    eaves = max(2.2, (1.0 - share) * house.eaves)
    return _changed(item, replace(house, eaves=eaves), "lowered")


def rebuilt(item: Item, rng: np.random.Generator) -> Item:
    """Put another building of nearly the same plan in its place."""
    house = _building(item)
    eaves = max(2.4, house.eaves * float(rng.uniform(0.7, 1.4)))
    roof = (Roof.FLAT, Roof.HIP, Roof.GABLE)[int(rng.integers(3))]
    rise = 0.5 if roof is Roof.FLAT else house.depth / 2 * float(rng.uniform(0.35, 0.7))
    width = house.width * float(rng.uniform(0.85, 1.0))
    shape = replace(house, eaves=eaves, roof=roof, rise=rise, width=width, chimney=False, veranda=0.0)
    return _changed(item, shape, "rebuilt")


def reclad(item: Item, rng: np.random.Generator) -> Item:
    """Give the roof another cover and the walls another face: no change by the rules."""
    house = _building(item)
    cover = Material.TILE if house.cover is Material.SHEET_METAL else Material.SHEET_METAL
    panels = bool(rng.random() < 0.5) and house.roof in (Roof.GABLE, Roof.HIP, Roof.FLAT)
    return _changed(item, replace(house, cover=cover, wall=Material.RENDER, panels=panels), "re-clad")


def crown_changed(item: Item, rng: np.random.Generator) -> Item:
    """Let a crown grow or prune it: all around by a share of its volume, or its top by a rise."""
    assert item.after is not None
    plant = item.after.shape
    assert isinstance(plant, Tree | Crown)
    if rng.random() < 0.3:
        rise = max(signed(TALL_RISE, rng), 0.4 - plant.crown)
        shape: Tree | Crown = replace(plant, height=plant.height + rise, crown=plant.crown + rise)
        return _changed(item, shape, "shot up" if rise > 0 else "topped")
    share = signed(SHARE, rng)
    factor = (1.0 + share) ** (
        1.0 / 2.4
    )  # a column volume goes with the radius squared and part of the height
    return _changed(item, _grown(plant, factor), "grown" if share > 0 else "pruned")


def _grown(plant: Tree | Crown, factor: float) -> Tree | Crown:
    crown = plant.crown * factor
    return replace(
        plant, crown=crown, height=plant.height - plant.crown + crown, radius=plant.radius * factor
    )


def hedge_changed(item: Item, rng: np.random.Generator) -> Item:
    """Let a hedge or shrub grow or trim it: its top by a rise, or its length by a share."""
    assert item.after is not None
    plant = item.after.shape
    if isinstance(plant, Crown):
        return crown_changed(item, rng)
    assert isinstance(plant, Hedge)
    if rng.random() < 0.7:
        rise = signed(RISE, rng)
        return _changed(
            item, replace(plant, height=max(0.3, plant.height + rise)), "trimmed" if rise < 0 else "grown"
        )
    share = signed(SHARE, rng)
    return _changed(item, replace(plant, length=plant.length * (1.0 + share)), "hedge changed in length")


def exchanged(item: Item, rng: np.random.Generator) -> Item:
    """Let another vehicle stand there, up to 0.9 m farther along."""
    assert item.after is not None
    place = item.after
    along = float(rng.uniform(-0.9, 0.9))
    x, y = place.x + np.cos(place.yaw) * along, place.y + np.sin(place.yaw) * along
    longest = 5.3 if item.kind == "car" else 6.6
    return replace(
        item,
        after=replace(place, shape=random_vehicle(rng, longest), x=float(x), y=float(y)),
        event="another vehicle",
    )


def moved(item: Item, rng: np.random.Generator) -> Item:
    """Let a thing stand 0.1 to 3 m aside, and turned."""
    assert item.after is not None
    way, reach = float(rng.uniform(0, 2 * np.pi)), float(rng.uniform(0.1, 3.0))
    place = item.after
    x, y = place.x + reach * np.cos(way), place.y + 0.4 * reach * np.sin(way)
    turned = place.yaw + float(rng.normal(0.0, 0.3))
    return replace(item, after=replace(place, x=float(x), y=float(y), yaw=turned), event="moved")


Quotas = Mapping[str, tuple[tuple[Edit, float], ...]]

_COMES_AND_GOES = ((added, 0.16), (removed, 0.16), (moved, 0.16))
_FOR_A_WHILE = ((added, 0.46), (removed, 0.46))

#: kind of item -> events, each with the share of the items of that kind that it happens to
QUOTAS: Quotas = {
    "house": (
        (extended, 0.15),
        (built_upon, 0.06),
        (part_demolished, 0.09),
        (lifted, 0.08),
        (storey_added, 0.04),
        (rebuilt, 0.04),
        (added, 0.05),
        (removed, 0.05),
        (reclad, 0.12),
    ),
    "unit": ((built_upon, 0.10), (lifted, 0.12), (storey_added, 0.05), (removed, 0.05), (reclad, 0.15)),
    "flats": ((built_upon, 0.15), (lifted, 0.15), (storey_added, 0.08), (bay_added, 0.1), (reclad, 0.15)),
    "shop": ((built_upon, 0.15), (lifted, 0.15), (storey_added, 0.1), (removed, 0.08), (reclad, 0.15)),
    "town house": (
        (built_upon, 0.10),
        (lifted, 0.12),
        (storey_added, 0.05),
        (bay_added, 0.10),
        (part_demolished, 0.07),
        (removed, 0.03),
        (added, 0.03),
        (reclad, 0.12),
    ),
    "court block": ((lifted, 0.3), (storey_added, 0.2)),
    "workshop": ((built_upon, 0.2), (added, 0.2), (removed, 0.2), (lifted, 0.1)),
    "shed": ((added, 0.2), (removed, 0.2)),
    "street tree": ((crown_changed, 0.36), (added, 0.06), (removed, 0.07)),
    "garden tree": ((crown_changed, 0.34), (added, 0.09), (removed, 0.09)),
    "back tree": ((crown_changed, 0.3), (removed, 0.05)),
    "palm": ((added, 0.15), (removed, 0.15)),
    "hedge": ((hedge_changed, 0.45), (added, 0.08), (removed, 0.08)),
    "shrub": ((hedge_changed, 0.35), (added, 0.15), (removed, 0.15)),
    "car": ((added, 0.24), (removed, 0.24), (exchanged, 0.4)),
    "long vehicle": ((added, 0.3), (removed, 0.3), (exchanged, 0.25)),
    "motorcycle": ((added, 0.3), (removed, 0.3), (moved, 0.25)),
    "bus": _FOR_A_WHILE,
    "container": _FOR_A_WHILE,
    "skip": _FOR_A_WHILE,
    "scaffolding": _FOR_A_WHILE,
    "stall": ((added, 0.3), (removed, 0.3), (moved, 0.2)),
    "terrace": ((added, 0.25), (removed, 0.25), (moved, 0.25)),
    "parklet": ((added, 0.35), (removed, 0.35)),
    "bicycles": ((added, 0.25), (removed, 0.25), (moved, 0.2)),
    "bin": ((added, 0.18), (removed, 0.18), (moved, 0.45)),
    "oddment": _COMES_AND_GOES,
    "planter": _COMES_AND_GOES,
    "kiosk": ((added, 0.12), (removed, 0.12)),
    "cabinet": ((added, 0.15), (removed, 0.15)),
    "pillar": ((added, 0.15), (removed, 0.15)),
    "sign": ((added, 0.12), (removed, 0.12)),
    "bollard": ((added, 0.08), (removed, 0.08)),
    "wall": ((added, 0.10), (removed, 0.10)),
    "fence": ((added, 0.03), (removed, 0.03)),
    "bus shelter": ((added, 0.1), (removed, 0.1)),
}


def pass_time(layout: Layout, seasons: tuple[Season, Season], activity: float) -> list[Item]:
    """Deal every kind's quotas, times ``activity``, to items at random; dress all plants for both epochs."""
    rng = layout.rng
    items = {item.object_id: item for item in layout.items}
    for kind, quotas in QUOTAS.items():
        alike = [item for item in layout.items if item.kind == kind]
        order = rng.permutation(len(alike)).tolist()
        for edit, share in quotas:
            number = int(activity * share * len(alike) + rng.random())
            chosen, order = order[:number], order[number:]
            for k in chosen:
                items[alike[k].object_id] = edit(alike[k], rng)
    return [dressed(_aged(item, rng), seasons, rng) for item in items.values()]


def _aged(item: Item, rng: np.random.Generator) -> Item:
    """Let a plant to which nothing else happened grow by up to 3 %."""
    if item.event or item.after is None or not isinstance(item.after.shape, Plant):
        return item
    factor = 1.0 + float(rng.uniform(0.0, _GROWTH))
    shape = item.after.shape
    if isinstance(shape, Hedge | Palm):
        aged: Shape = replace(shape, height=shape.height * factor)
    else:
        aged = _grown(shape, factor)
    return replace(item, after=replace(item.after, shape=aged))

"""Lays out a street as crowded as real ones: terraces, shops, crowns over roofs and cars, wires, clutter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from shapely.geometry import LineString

from subiaco_geo.frames import Floats
from subiaco_sim.blocks import Apartments, Group, Shop
from subiaco_sim.buildings import House, Shed
from subiaco_sim.furniture import Bin, BusShelter, Car, Fence, Pole, Sign, Truck, Wires
from subiaco_sim.ground import ROAD_HALF, Line
from subiaco_sim.plants import Hedge, Palm
from subiaco_sim.primitives import Material
from subiaco_sim.scene import BUILDING, MOBILE, OTHER, VEGETATION, Placed, Shape
from subiaco_sim.scene_config import LANE_WIDTH, Character
from subiaco_sim.suburb import (
    SETBACK,
    Layout,
    Lot,
    from_lot,
    random_car,
    random_house,
    random_tree,
    rectangle,
)

KERB_TREE = ROAD_HALF + 0.95 - SETBACK
PARKED = ROAD_HALF - 1.05 - SETBACK
BAY = (6.5, 2.1)  # length along the kerb and depth of a parking bay [m]


def lay_out_crowded(
    centreline: Floats,
    frontage: float,
    rng: np.random.Generator,
    character: Character,
    sides: tuple[int, ...] = (1, -1),
) -> Layout:
    """Lay out a street: buildings, then gardens, then the street itself."""
    layout = Layout(centreline, rng, SETBACK + character.widen, sides)
    layout.taken.append(LineString(centreline).buffer(8.5 + character.widen))
    for lot in layout.lots(frontage):
        plot = rectangle(*from_lot(lot, 0.0, 8.0), lot.yaw, frontage - 0.8, 20.0)
        if layout.free(plot):
            layout.taken.append(plot)
            _build(layout, lot, frontage, character)
    _plant_street(layout, character)
    _park(layout, character)
    _furnish(layout, character)
    _paint_lanes(layout, character)
    return layout


def _put(
    layout: Layout, lot: Lot, kind: str, semantic: int, shape: Shape, place: tuple[float, float, float]
) -> None:
    """Place a shape ``along`` the street, ``inward`` of the front wall, turned [m, rad]."""
    x, y = from_lot(lot, place[0], place[1])
    layout.add(kind, semantic, Placed(shape, x, y, lot.yaw + place[2]))


def _build(layout: Layout, lot: Lot, frontage: float, character: Character) -> None:
    drawn = layout.rng.random()
    if drawn < character.terraces:
        _add_terrace(layout, lot, frontage)
    elif drawn < character.terraces + character.shops:
        shop = Shop(frontage - 2.0, 12.0, upper=int(layout.rng.integers(0, 2)))
        _put(layout, lot, "shop", BUILDING, shop, (0.0, 3.5, 0.0))
    elif drawn < character.terraces + character.shops + character.apartments:
        block = Apartments(frontage - 2.5, 13.0, int(layout.rng.integers(3, 5)))
        _put(layout, lot, "apartments", BUILDING, block, (0.0, 6.5, 0.0))
    else:
        front = _add_dwelling(layout, lot)
        gated = layout.rng.random() < character.gates
        if gated:
            _add_gate(layout, lot, frontage, front)
        _add_yard(layout, lot, frontage, gated)


def _add_terrace(layout: Layout, lot: Lot, frontage: float) -> None:
    """Three narrow houses wall to wall."""
    width = (frontage - 1.5) / 3
    for k in (-1, 0, 1):
        roof = "gable" if layout.rng.random() < 0.5 else "skillion"
        house = House(width, 11.0, roof, int(layout.rng.integers(1, 3)), overhang=0.0, veranda=1.6)
        kind = "terrace middle" if k == 0 else "terrace end"
        _put(layout, lot, kind, BUILDING, house, (k * width, 5.5, 0.0))


def _add_dwelling(layout: Layout, lot: Lot) -> tuple[float, float]:
    """Build a house; returns its width and how far inward its front wall stands [m]."""
    rng = layout.rng
    house = replace(random_house(rng), width=float(rng.uniform(8.0, 9.5)))
    if rng.random() < 0.2:
        house = replace(house, roof="skillion", pitch=0.35, chimney=False)
    if rng.random() < 0.25:
        house = replace(house, wing=2.5, veranda=0.0)
    if rng.random() < 0.35:
        house = replace(house, carport=2.8)
    back = float(rng.uniform(0.0, 1.5)) + max(house.wing, house.veranda)
    _put(layout, lot, "house", BUILDING, house, (0.0, back + house.depth / 2 - 1.5, 0.0))
    if house.carport and rng.random() < 0.6:
        along = (house.width + house.carport) / 2
        _put(layout, lot, "car", MOBILE, random_car(rng), (along, back - 0.3, np.pi / 2))
    return house.width, back - 1.5


def _add_gate(layout: Layout, lot: Lot, frontage: float, house: tuple[float, float]) -> None:
    """Shut the gap between the house and the left neighbour's fence: the yard is out of sight."""
    width, front = house
    along = -(frontage + width) / 4
    gate = Fence((frontage - width) / 2 - 0.1, 2.1)
    _put(layout, lot, "gate", OTHER, gate, (along, front + 0.1, 0.0))


def _add_yard(layout: Layout, lot: Lot, frontage: float, gated: bool) -> None:
    rng = layout.rng
    for part in range(4):  # panels step down with the slope
        _put(layout, lot, "fence", OTHER, Fence(4.75, 1.75), (frontage / 2, 1.9 + 4.75 * part, np.pi / 2))
    drawn = rng.random()
    if drawn < 0.4:
        for along in (-4.6, 0.4):
            hedge = Hedge(4.8, 1.0, float(rng.uniform(1.1, 2.1)), int(rng.integers(2**31)))
            _put(layout, lot, "hedge", VEGETATION, hedge, (along, -5.2, 0.0))
    elif drawn < 0.65:
        wall = Fence(frontage - 5.0, float(rng.uniform(0.8, 1.9)), 0.22, Material.BRICK)
        _put(layout, lot, "wall", OTHER, wall, (-1.5, -5.4, 0.0))
    if rng.random() < 0.6:
        shrub = Hedge(1.4, 1.3, float(rng.uniform(0.9, 1.6)), int(rng.integers(2**31)))
        _put(layout, lot, "shrub", VEGETATION, shrub, (float(rng.uniform(-5, 3)), -1.8, 0.4))
    _add_yard_trees(layout, lot)
    if rng.random() < 0.4:
        # a carport's drive is kept free: cars stand in front of the house otherwise
        _put(layout, lot, "car", MOBILE, random_car(rng), (5.6, -3.6, np.pi / 2))
    if rng.random() < 0.35:
        _add_sheds(layout, lot, gated)


def _add_yard_trees(layout: Layout, lot: Lot) -> None:
    rng = layout.rng
    drawn = rng.random()
    if drawn < 0.45:  # close enough for the crown to lie over the roof
        tree = random_tree(rng, (6.0, 9.5))
        _put(layout, lot, "garden tree", VEGETATION, tree, (float(rng.uniform(-5, 1)), -2.4, 0.0))
    elif drawn < 0.6:
        palm = Palm(float(rng.uniform(4.0, 9.0)), int(rng.integers(2**31)))
        _put(layout, lot, "palm", VEGETATION, palm, (float(rng.uniform(-4.5, 2.0)), -3.3, 0.0))
    if rng.random() < 0.5:
        tree = random_tree(rng, (7.0, 12.0))
        _put(layout, lot, "back tree", VEGETATION, tree, (float(rng.uniform(-5, 5)), 16.0, 0.0))


def _add_sheds(layout: Layout, lot: Lot, gated: bool) -> None:
    rng = layout.rng
    if rng.random() < 0.35:
        pair = (Placed(Shed(2.4, 2.2), -1.7, 0.0), Placed(Shed(2.4, 2.2, 2.1), 1.7, 0.0))
        _put(layout, lot, "two sheds", BUILDING, Group(pair), (0.0, 15.0, 0.0))
    else:
        side = -5.6 if gated or rng.random() < 0.5 else 5.8  # behind the gate, or where the street looks in
        _put(layout, lot, "shed", BUILDING, Shed(2.6, 2.4), (side, 8.0, 0.0))


def _plant_street(layout: Layout, character: Character) -> None:
    """Plant large trees at the kerb, whose crowns hang over the parked cars and the road."""
    rng = layout.rng
    for lot in layout.lots(8.5):
        if rng.random() >= character.street_trees:
            continue
        if rng.random() < character.twins:
            _plant_twins(layout, lot)
        else:
            tree = random_tree(rng, (6.5, 10.5))
            tree = replace(tree, crown=min(tree.crown, tree.height - 2.6))
            _put(
                layout, lot, "street tree", VEGETATION, tree, (float(rng.uniform(-1.2, 1.2)), KERB_TREE, 0.0)
            )


def _plant_twins(layout: Layout, lot: Lot) -> None:
    """Plant two trees whose crowns stay just apart, or have long grown into one another."""
    rng = layout.rng
    pair = [random_tree(rng, (5.6, 7.4)) for _ in range(2)]
    pair = [replace(tree, crown=min(tree.crown, tree.height - 2.2)) for tree in pair]
    kind, closeness = ("twin tree", (1.08, 1.2)) if rng.random() < 0.5 else ("joined tree", (0.75, 0.85))
    gap = float(rng.uniform(*closeness)) * sum(tree.radius for tree in pair)
    for tree, sign in zip(pair, (-0.5, 0.5), strict=True):
        _put(layout, lot, kind, VEGETATION, tree, (sign * gap, KERB_TREE, 0.0))


def random_vehicle(rng: np.random.Generator, trucks: float) -> Car | Truck:
    """Draw what stands at a kerb."""
    if rng.random() < trucks:
        return Truck(float(rng.uniform(5.6, 7.6)), 2.2, float(rng.uniform(2.7, 3.4)))
    return random_car(rng)


def _park(layout: Layout, character: Character) -> None:
    """Mark bays along the kerb and park in some of them; a truck takes half of the next one too."""
    rng = layout.rng
    full: dict[int, float] = {}  # side of the street -> where its kerb is free again
    for lot in layout.lots(BAY[0]):
        if lot.bend > 1.0 / 150.0 or rng.random() >= character.bays:
            continue  # bays would overlap on the inside of a bend
        _mark_bay(layout, lot)
        if rng.random() >= character.parked or lot.s < full.get(lot.side, 0.0):
            continue
        vehicle = random_vehicle(rng, character.trucks)
        kind = "truck" if isinstance(vehicle, Truck) else "car"
        along = BAY[0] / 2 if kind == "truck" else 0.0
        full[lot.side] = lot.s + along + BAY[0]
        turn = 0.0 if rng.random() < 0.5 else np.pi
        _put(layout, lot, kind, MOBILE, vehicle, (along, PARKED, turn))


def _mark_bay(layout: Layout, lot: Lot) -> None:
    for along, inward, turn, length in (
        (-BAY[0] / 2, PARKED, np.pi / 2, BAY[1]),
        (BAY[0] / 2, PARKED, np.pi / 2, BAY[1]),
        (0.0, PARKED - BAY[1] / 2, 0.0, BAY[0]),
    ):
        x, y = from_lot(lot, along, inward)
        layout.lines.append(Line(x, y, lot.yaw + turn, length))


def _paint_lanes(layout: Layout, character: Character) -> None:
    """Paint dashes along the crown, where there is no median, and between lanes of one way."""
    offsets = [ROAD_HALF - 0.35 + LANE_WIDTH * k for k in range(character.lanes - 1)]
    for lot in layout.lots(9.0):
        middle = [0.0] if character.median == 0.0 and lot.side == layout.sides[0] else []
        for offset in [*middle, *offsets]:
            x, y = from_lot(lot, 0.0, offset - layout.setback)
            layout.lines.append(Line(x, y, lot.yaw, 3.0))


def _furnish(layout: Layout, character: Character) -> None:
    rng = layout.rng
    for lot in layout.lots(11.0):
        drawn = rng.random()
        if drawn < 0.3:
            _put(layout, lot, "bin", OTHER, Bin(), (3.4, ROAD_HALF + 0.6 - SETBACK, 0.1))
        elif drawn < 0.4:
            _put(layout, lot, "sign", OTHER, Sign(), (-3.0, ROAD_HALF + 0.5 - SETBACK, np.pi / 2))
        elif drawn < 0.44:
            _put(layout, lot, "bus shelter", OTHER, BusShelter(), (0.0, 7.6 - SETBACK, np.pi))
    poles = [lot for lot in layout.lots(26.0) if lot.side > 0]
    places = [from_lot(lot, 0.0, ROAD_HALF + 0.6 - SETBACK) for lot in poles]
    for k, (lot, (x, y)) in enumerate(zip(poles, places, strict=True)):
        layout.add("pole", OTHER, Placed(Pole(8.4), x, y, lot.yaw - np.pi / 2))
        if character.wires and k + 1 < len(places):
            step = np.subtract(places[k + 1], (x, y))
            wires = Wires(float(np.hypot(*step)))
            layout.add("wires", OTHER, Placed(wires, x, y, float(np.arctan2(step[1], step[0]))))

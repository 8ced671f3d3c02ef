"""Lays out an Australian suburban street: houses, units, flats, shops, raised lots, gardens, verges."""

from __future__ import annotations

import numpy as np
from shapely.geometry import LineString

from subiaco_geo.frames import Floats
from subiaco_sim.buildings import Shed
from subiaco_sim.families.buildings import Building
from subiaco_sim.families.foliage import Crown, Profile, random_plant
from subiaco_sim.families.kerbside import fill_kerbs
from subiaco_sim.families.placing import Frontage, beside, frontages, put, put_free
from subiaco_sim.families.plan import StreetPlan
from subiaco_sim.families.roofs import Roof
from subiaco_sim.families.street_objects import Column, Kiosk, Oddment, Scaffolding, Wall
from subiaco_sim.families.vehicles import random_vehicle
from subiaco_sim.furniture import Bin, BusShelter, Pole, Sign, Wires
from subiaco_sim.ground import ROAD_HALF, Patch
from subiaco_sim.plants import Hedge, Palm
from subiaco_sim.primitives import Material
from subiaco_sim.scene import BUILDING, MOBILE, OTHER, VEGETATION, Placed
from subiaco_sim.suburb import Layout, Lot, from_lot, rectangle

_DEPTH = 24.0  # of a lot [m]
#: Shares of what a place at the kerb holds.
_AT_THE_KERB = {"vehicle": 0.36, "motorcycles": 0.03, "bus": 0.015, "container": 0.02, "skip": 0.03}
_ROOFS = [Roof.HIP, Roof.GABLE, Roof.FLAT, Roof.PENT, Roof.MANSARD]


def lay_out_suburb(route: Floats, plan: StreetPlan, rng: np.random.Generator) -> tuple[Layout, list[Patch]]:
    """Lay out the street; returns it and the lots that lie higher than the street."""
    kerb = ROAD_HALF + plan.widen
    layout = Layout(route, rng, kerb + plan.footway)
    layout.taken.append(LineString(route).buffer(kerb))
    raised: list[Patch] = []
    for frontage in frontages(layout, (11.0, 18.0), layout.setback):
        plot = rectangle(*from_lot(frontage.lot, 0.0, 10.0), frontage.lot.yaw, frontage.width - 0.6, 19.0)
        if layout.free(plot):
            layout.taken.append(plot)
            if rng.random() < 0.22:
                raised.append(_raise(layout, frontage))
            _build(layout, frontage)
    _line_street(layout, kerb)
    fill_kerbs(layout, kerb, _AT_THE_KERB)
    _equip(layout, kerb)
    return layout, raised


def random_detached(rng: np.random.Generator, width: float) -> Building:
    """Draw a house of one or two storeys with any roof."""
    roof = _ROOFS[int(rng.choice(5, p=[0.4, 0.28, 0.13, 0.12, 0.07]))]
    two = bool(rng.random() < 0.28)
    depth = float(rng.uniform(9.0, 14.0))
    rise = {Roof.FLAT: rng.uniform(0.2, 0.9), Roof.PENT: rng.uniform(0.6, 1.6)}.get(
        roof, depth / 2 * rng.uniform(0.3, 0.65)
    )
    walls = [Material.BRICK, Material.RENDER, Material.TIMBER]
    return Building(
        width=width,
        depth=depth,
        eaves=float(rng.uniform(5.1, 6.3) if two else rng.uniform(2.5, 3.3)),
        roof=roof,
        rise=float(rise),
        wall=walls[int(rng.integers(3))],
        cover=Material.SHEET_METAL if rng.random() < 0.4 else Material.TILE,
        overhang=float(rng.uniform(0.1, 0.7)),
        veranda=float(rng.uniform(1.4, 2.6)) if rng.random() < 0.35 else 0.0,
        chimney=bool(rng.random() < 0.3) and roof in (Roof.GABLE, Roof.HIP),
    )


def _raise(layout: Layout, frontage: Frontage) -> Patch:
    """Raise a lot and hold it with a wall at its front."""
    rise, width = float(layout.rng.uniform(0.3, 1.5)), frontage.width - 0.4
    x, y = from_lot(frontage.lot, 0.0, 0.3 + _DEPTH / 2)
    wall = Wall(width, rise + float(layout.rng.uniform(0.0, 0.4)), 0.3, Material.CONCRETE)
    put(layout, frontage.lot, "retaining wall", OTHER, wall, (0.0, 0.05, 0.0))
    return Patch(x, y, width, _DEPTH, frontage.lot.yaw, rise)


def _build(layout: Layout, frontage: Frontage) -> None:
    """Build what stands on a lot: nothing, a shop, flats, a row of units, or a house."""
    drawn = layout.rng.random()
    if drawn < 0.06:
        _grow_garden(layout, frontage, 14.0)
    elif drawn < 0.13:
        _add_shop(layout, frontage)
    elif drawn < 0.22:
        _add_flats(layout, frontage)
    elif drawn < 0.34:
        _add_units(layout, frontage)
    else:
        _add_house(layout, frontage)


def _add_shop(layout: Layout, frontage: Frontage) -> None:
    """Build a shop at the building line, some with an arcade over the footway's edge."""
    rng = layout.rng
    arcade = float(rng.uniform(1.8, 2.8)) if rng.random() < 0.5 else 0.0
    eaves = float(rng.uniform(4.6, 5.4)) + (3.1 if rng.random() < 0.3 else 0.0)
    shop = Building(
        frontage.width - 0.8,
        12.0,
        eaves,
        Roof.FLAT,
        float(rng.uniform(0.3, 1.2)),
        Material.RENDER,
        arcade=arcade,
    )
    put(layout, frontage.lot, "shop", BUILDING, shop, (0.0, 6.2, 0.0))


def _add_flats(layout: Layout, frontage: Frontage) -> None:
    rng = layout.rng
    storeys = int(rng.integers(2, 5))
    roof = Roof.FLAT if rng.random() < 0.6 else Roof.HIP
    block = Building(
        width=frontage.width - 2.6,
        depth=13.0,
        eaves=3.0 * storeys + 0.3,
        roof=roof,
        rise=0.8 if roof is Roof.FLAT else 2.2,
        wall=Material.RENDER if rng.random() < 0.5 else Material.BRICK,
        balconies=float(rng.uniform(1.0, 1.6)),
    )
    setback = float(rng.uniform(1.7, 5.0))
    put(layout, frontage.lot, "flats", BUILDING, block, (0.0, setback + 6.5, 0.0))


def _add_units(layout: Layout, frontage: Frontage) -> None:
    """Two or three houses wall to wall."""
    rng = layout.rng
    number = 3 if frontage.width > 14.5 else 2
    width = (frontage.width - 1.0) / number
    setback = float(rng.uniform(0.3, 4.5))
    roof = Roof.GABLE if rng.random() < 0.6 else Roof.PENT
    for k in range(number):
        unit = Building(
            width,
            11.0,
            float(rng.uniform(5.0, 6.0)),
            roof,
            float(rng.uniform(1.0, 2.6)),
            overhang=0.0,
            pane=2.4,
        )
        along = (k - (number - 1) / 2) * width
        put(layout, frontage.lot, "unit", BUILDING, unit, (along, setback + 5.5, 0.0))


def _add_house(layout: Layout, frontage: Frontage) -> None:
    """Build a detached house; one in six stands at the building line, without a front garden."""
    rng = layout.rng
    house = random_detached(rng, frontage.width - float(rng.uniform(2.6, 5.2)))
    setback = 0.4 if rng.random() < 0.17 else float(rng.uniform(3.0, 8.0))
    front = setback + house.veranda
    along = -(frontage.width - house.width) / 2 + float(rng.uniform(0.8, 1.6))
    put(layout, frontage.lot, "house", BUILDING, house, (along, front + house.depth / 2, 0.0))
    _fence(layout, frontage)
    _grow_garden(layout, frontage, setback)
    if rng.random() < 0.5 and setback > 3.0:  # in the drive
        place = (frontage.width / 2 - 1.7, max(2.9, setback - 1.0), np.pi / 2)
        put(layout, frontage.lot, "car", MOBILE, random_vehicle(rng, 5.4), place)
    if rng.random() < 0.35:
        shed = Shed(float(rng.uniform(2.0, 4.2)), float(rng.uniform(1.8, 3.2)), float(rng.uniform(2.0, 2.7)))
        side = float(rng.choice([-1.0, 1.0])) * (frontage.width / 2 - 1.8)
        put(layout, frontage.lot, "shed", BUILDING, shed, (side, float(rng.uniform(9.0, 18.0)), 0.0))
    if rng.random() < 0.2:  # trampolines, barbecues, swings
        odd = Oddment(int(rng.integers(2**31)), float(rng.uniform(1.0, 2.4)))
        put(layout, frontage.lot, "oddment", OTHER, odd, (float(rng.uniform(-4, 3)), 1.6, 0.0))


def _fence(layout: Layout, frontage: Frontage) -> None:
    """Panels along one side of the lot, and a hedge, a wall or nothing at its front, open for the drive."""
    rng, lot = layout.rng, frontage.lot
    if rng.random() < 0.65:
        height = float(rng.uniform(1.0, 1.9))
        for part in range(4):
            panel = Wall(4.75, height, 0.06, Material.TIMBER)
            put(layout, lot, "fence", OTHER, panel, (frontage.width / 2 - 0.1, 2.7 + 4.75 * part, np.pi / 2))
    drawn, open_ = rng.random(), frontage.width - 3.6
    if drawn < 0.35:
        for k in range(2):
            hedge = Hedge(
                open_ / 2 - 0.1,
                float(rng.uniform(0.6, 1.2)),
                float(rng.uniform(0.7, 2.2)),
                int(rng.integers(2**31)),
            )
            put(layout, lot, "hedge", VEGETATION, hedge, (-1.8 + (k - 0.5) * open_ / 2, 0.8, 0.0))
    elif drawn < 0.6:
        wall = Wall(open_, float(rng.uniform(0.4, 1.9)), 0.22)
        put(layout, lot, "wall", OTHER, wall, (-1.8, 0.45, 0.0))


def _grow_garden(layout: Layout, frontage: Frontage, setback: float) -> None:
    rng, lot = layout.rng, frontage.lot
    half = frontage.width / 2
    if setback > 2.5:
        if rng.random() < 0.55:
            plant = random_plant(rng, (3.0, 10.0))
            put(layout, lot, "garden tree", VEGETATION, plant, (float(rng.uniform(-half + 2, 1.5)), 2.4, 0.0))
        elif rng.random() < 0.3:
            palm = Palm(float(rng.uniform(3.5, 9.0)), int(rng.integers(2**31)))
            put(layout, lot, "palm", VEGETATION, palm, (float(rng.uniform(-half + 2, 1.5)), 2.2, 0.0))
        for _ in range(int(rng.integers(0, 4))):
            along = float(rng.uniform(-half + 1, half - 3.5))
            put(layout, lot, "shrub", VEGETATION, _random_shrub(rng), (along, setback - 0.8, 0.0))
    if rng.random() < 0.45:
        plant = random_plant(rng, (6.0, 13.0))
        put(layout, lot, "back tree", VEGETATION, plant, (float(rng.uniform(-half + 1, half - 1)), 21.0, 0.0))


def _random_shrub(rng: np.random.Generator) -> Hedge | Crown:
    seed = int(rng.integers(2**31))
    if rng.random() < 0.5:
        return Hedge(
            float(rng.uniform(0.8, 2.2)), float(rng.uniform(0.8, 1.5)), float(rng.uniform(0.6, 1.8)), seed
        )
    height = float(rng.uniform(0.8, 2.4))
    return Crown(Profile.BALL, height, float(rng.uniform(0.4, 0.9)), 0.9 * height, 0.04, seed, seed)


def _line_street(layout: Layout, kerb: float) -> None:
    """Trees on the verge, poles with wires on one side."""
    rng = layout.rng
    for lot in beside(layout, 9.5, kerb + 0.9):
        if rng.random() < 0.6:
            plant = random_plant(rng, (4.0, 12.0))
            place = (float(rng.uniform(-2.0, 2.0)), float(rng.uniform(0.0, 0.5)), 0.0)
            put_free(layout, lot, "street tree", VEGETATION, plant, place, (0.8, 0.8))
    poles = [lot for lot in beside(layout, 27.0, kerb + 0.55) if lot.side > 0]
    for k, lot in enumerate(poles):
        put(layout, lot, "pole", OTHER, Pole(8.4), (0.0, 0.0, -np.pi / 2))
        if k + 1 < len(poles):
            step = np.subtract((poles[k + 1].x, poles[k + 1].y), (lot.x, lot.y))
            wires = Placed(Wires(float(np.hypot(*step))), lot.x, lot.y, float(np.arctan2(step[1], step[0])))
            layout.add("wires", OTHER, wires)


def _equip(layout: Layout, kerb: float) -> None:
    """Bins, signs, letter boxes, transformers, skips, containers, scaffolding and odd things."""
    rng = layout.rng
    for lot in beside(layout, 8.0, kerb + 0.6):
        drawn = rng.random()
        if drawn < 0.22:
            put_free(
                layout, lot, "bin", OTHER, Bin(float(rng.uniform(0.9, 1.2))), (2.6, 0.0, 0.1), (0.7, 0.7)
            )
        elif drawn < 0.30:
            put_free(layout, lot, "sign", OTHER, Sign(), (-2.2, 0.0, np.pi / 2), (0.3, 0.3))
        elif drawn < 0.36:
            box = Kiosk(*(float(v) for v in rng.uniform((0.6, 0.4, 0.9), (2.0, 1.2, 1.8))))
            put_free(layout, lot, "cabinet", OTHER, box, (0.0, 1.0, 0.0), (2.2, 1.6))
        elif drawn < 0.44:
            odd = Oddment(int(rng.integers(2**31)), float(rng.uniform(0.8, 2.2)))
            put_free(layout, lot, "oddment", OTHER, odd, (1.0, 0.9, float(rng.uniform(0, 3))), (1.8, 1.8))
        elif drawn < 0.58:
            put(layout, lot, "letter box", OTHER, Column(0.14, float(rng.uniform(0.9, 1.3))), (0.0, 2.8, 0.0))
    for lot in list(beside(layout, 60.0, kerb))[1:4]:
        put_free(layout, lot, "bus shelter", OTHER, BusShelter(), (0.0, 1.6, np.pi), (4.4, 2.2))
    add_scaffolding(layout, ("house", "flats", "unit"), 0.1)


def add_scaffolding(layout: Layout, kinds: tuple[str, ...], share: float) -> None:
    """Put scaffolding before the fronts of a share of the buildings of some kinds."""
    rng = layout.rng
    for placed in [item.before for item in layout.items if item.kind in kinds and item.before]:
        building = placed.shape
        if not isinstance(building, Building) or rng.random() >= share or building.veranda > 0:
            continue
        front = Lot(0.0, 1, placed.x, placed.y, placed.yaw)
        height = building.eaves + float(rng.uniform(0.3, 1.4))
        frame = Scaffolding(building.width, height, netted=bool(rng.random() < 0.4))
        clear = building.depth / 2 + building.balconies + 0.9
        put(layout, front, "scaffolding", OTHER, frame, (0.0, -clear, 0.0))

"""Lays out a dense European street: facades wall to wall, arcades, courts, a square with a market."""

from __future__ import annotations

import numpy as np
from shapely.geometry import LineString

from subiaco_geo.frames import Floats
from subiaco_sim.families.buildings import Building, CourtBlock
from subiaco_sim.families.foliage import Crown, Profile, random_plant
from subiaco_sim.families.kerbside import fill_kerbs
from subiaco_sim.families.placing import Frontage, beside, frontages, lot_at, put, put_free
from subiaco_sim.families.plan import StreetPlan
from subiaco_sim.families.roofs import Roof
from subiaco_sim.families.street_objects import (
    BikeRack,
    Column,
    Container,
    Kiosk,
    MarketStall,
    Oddment,
    StreetLamp,
    Terrace,
)
from subiaco_sim.families.suburb import add_scaffolding
from subiaco_sim.furniture import Bin, BusShelter, Sign
from subiaco_sim.ground import ROAD_HALF
from subiaco_sim.plants import Hedge, Tree
from subiaco_sim.primitives import Material
from subiaco_sim.scene import BUILDING, OTHER, VEGETATION, Shape
from subiaco_sim.suburb import Layout, Lot

#: Shares of what a place at the kerb holds.
_AT_THE_KERB = {
    "vehicle": 0.56,
    "motorcycles": 0.10,
    "parklet": 0.05,
    "bicycles": 0.06,
    "container": 0.03,
    "skip": 0.02,
    "bus": 0.02,
}
_SQUARE = 30.0  # length and depth of the square [m]
_STOREY = (2.9, 3.5)


def lay_out_dense(route: Floats, plan: StreetPlan, rng: np.random.Generator) -> Layout:
    """Lay out the street: facades, the square, then what stands on footways and at kerbs."""
    kerb = ROAD_HALF + plan.widen
    layout = Layout(route, rng, kerb + plan.footway)
    layout.taken.append(LineString(route).buffer(kerb))
    length = 0.25 * len(route)
    middle = length * float(rng.uniform(0.35, 0.65))
    square = int(rng.choice([-1, 1]))  # side of the street
    for frontage in frontages(layout, (8.0, 20.0), layout.setback):
        lot = frontage.lot
        if lot.side == square and abs(lot.s - middle) < (_SQUARE + frontage.width) / 2:
            continue
        _build(layout, frontage)
    _fill_square(layout, lot_at(layout, middle, square, layout.setback))
    fill_kerbs(layout, kerb, _AT_THE_KERB)
    _plant(layout, kerb, plan.footway)
    _equip(layout, kerb, plan.footway)
    add_scaffolding(layout, ("town house",), 0.09)
    return layout


def random_town_house(rng: np.random.Generator, width: float) -> Building:
    """Draw a house of three to six storeys that stands wall to wall with its neighbours."""
    roof = (Roof.MANSARD, Roof.GABLE, Roof.FLAT, Roof.HIP)[int(rng.choice(4, p=[0.36, 0.34, 0.22, 0.08]))]
    depth = float(rng.uniform(10.5, 13.5))
    rise = {Roof.MANSARD: rng.uniform(2.6, 4.0), Roof.FLAT: rng.uniform(0.3, 1.1)}.get(
        roof, depth / 2 * rng.uniform(0.5, 0.9)
    )
    walls = [Material.RENDER, Material.RENDER, Material.BRICK, Material.CONCRETE]
    return Building(
        width=width,
        depth=depth,
        eaves=float(rng.uniform(0.6, 1.4)) + int(rng.integers(3, 7)) * float(rng.uniform(*_STOREY)),
        roof=roof,
        rise=float(rise),
        wall=walls[int(rng.integers(4))],
        cover=Material.SHEET_METAL if roof is Roof.MANSARD else Material.TILE,
        overhang=float(rng.uniform(0.0, 0.35)),
        arcade=float(rng.uniform(2.0, 3.0)) if rng.random() < 0.2 else 0.0,
        balconies=float(rng.uniform(0.5, 1.2)) if rng.random() < 0.3 else 0.0,
        chimney=bool(rng.random() < 0.4) and roof is Roof.GABLE,
        pane=float(rng.uniform(2.3, 3.2)),
    )


def _build(layout: Layout, frontage: Frontage) -> None:
    """Build a town house, a block about a court, a low workshop, or leave an alley open."""
    rng = layout.rng
    drawn = rng.random()
    width = frontage.width
    if drawn < 0.08 and width > 13.0:
        roof = Roof.FLAT if rng.random() < 0.4 else Roof.GABLE
        rise = 0.7 if roof is Roof.FLAT else 3.2
        block = CourtBlock(
            width, float(rng.uniform(26.0, 34.0)), 1.0 + 3.1 * int(rng.integers(3, 6)), roof, rise
        )
        put(layout, frontage.lot, "court block", BUILDING, block, (0.0, block.depth / 2, 0.0))
        return
    if drawn < 0.13:  # set back behind a paved forecourt
        low = Building(width - 2.6, 10.0, float(rng.uniform(3.4, 6.5)), Roof.FLAT, 0.5, Material.RENDER)
        put(layout, frontage.lot, "workshop", BUILDING, low, (0.0, 5.0 + float(rng.uniform(2.0, 9.0)), 0.0))
        return
    alley = float(rng.uniform(2.0, 3.5)) if drawn > 0.92 else 0.0
    house = random_town_house(rng, width - alley)
    put(layout, frontage.lot, "town house", BUILDING, house, (alley / 2, house.depth / 2, 0.0))


def _fill_square(layout: Layout, corner: Lot) -> None:
    """Stalls in rows, a kiosk, trees and a container on the square; a church-high block at its back."""
    rng = layout.rng
    hall = Building(
        _SQUARE - 6.0, 12.0, float(rng.uniform(9.0, 14.0)), Roof.HIP, 4.5, Material.CONCRETE, pane=4.0
    )
    put(layout, corner, "town house", BUILDING, hall, (0.0, _SQUARE + 6.0, 0.0))
    for row in range(3):
        for place in range(5):
            if rng.random() < 0.7:
                size = (
                    float(rng.uniform(2.2, 3.8)),
                    float(rng.uniform(1.8, 2.4)),
                    float(rng.uniform(2.2, 2.9)),
                )
                where = (5.2 * (place - 2), 4.5 + 6.5 * row, float(rng.normal(0.0, 0.06)))
                put(layout, corner, "stall", OTHER, MarketStall(*size), where)
    for along in (-11.0, 0.0, 11.0):
        plant = random_plant(rng, (5.0, 11.0))
        put(layout, corner, "street tree", VEGETATION, plant, (along, 23.5, 0.0))
    put(layout, corner, "kiosk", OTHER, Kiosk(2.8, 2.4, 2.9), (-12.5, 19.5, 0.0))
    put(layout, corner, "container", OTHER, Container(), (9.5, 27.0, 0.2))
    put(layout, corner, "monument", OTHER, Column(1.1, 4.2), (4.0, 27.5, 0.0))


def _plant(layout: Layout, kerb: float, footway: float) -> None:
    """Trees in grilles along one kerb or both, pruned to balls or left to grow; tubs and a few hedges."""
    rng = layout.rng
    sides = {1, -1} if footway > 3.0 else {int(rng.choice([-1, 1]))}
    pruned = rng.random() < 0.5
    spacing = float(rng.uniform(7.5, 11.0))
    for lot in beside(layout, spacing, kerb + 0.7):
        if lot.side not in sides or rng.random() < 0.2:
            continue
        put_free(
            layout, lot, "street tree", VEGETATION, _avenue_tree(rng, pruned), (0.0, 0.0, 0.0), (0.8, 0.8)
        )
    for lot in beside(layout, 13.0, kerb + footway - 0.5):
        if rng.random() < 0.2:
            tub = Hedge(
                float(rng.uniform(0.9, 2.6)), 0.6, float(rng.uniform(0.9, 1.7)), int(rng.integers(2**31))
            )
            put_free(layout, lot, "hedge", VEGETATION, tub, (0.0, 0.0, 0.0), (2.6, 0.7))


def _avenue_tree(rng: np.random.Generator, pruned: bool) -> Tree | Crown:
    """Draw a tree whose crown begins above the heads of people."""
    form, leaves = (int(v) for v in rng.integers(0, 2**31, 2))
    height = float(rng.uniform(5.0, 7.0) if pruned else rng.uniform(6.0, 12.5))
    crown = height - float(rng.uniform(2.5, 3.2))
    if pruned:
        return Crown(Profile.BALL, height, float(rng.uniform(1.2, 2.0)), crown, 0.12, form, leaves)
    return Tree(height, crown * float(rng.uniform(0.28, 0.42)), crown, 0.05 + 0.014 * height, form, leaves)


def _equip(layout: Layout, kerb: float, footway: float) -> None:
    """Lamps, bollards, signs, bins at the kerb; tables, racks, kiosks and odd things before the facades."""
    rng = layout.rng
    for lot in beside(layout, 22.0, kerb + 0.5):
        lamp = StreetLamp(float(rng.uniform(4.5, 7.5)))
        put_free(layout, lot, "lamp", OTHER, lamp, (0.0, 0.0, 0.0), (0.3, 0.3))
    for lot in beside(layout, 4.2, kerb + 0.45):
        drawn = rng.random()
        if drawn < 0.25:
            put_free(layout, lot, "bollard", OTHER, Column(0.08, 0.95), (0.4, 0.0, 0.0), (0.2, 0.2))
        elif drawn < 0.33:
            put_free(layout, lot, "sign", OTHER, Sign(), (0.0, 0.0, np.pi / 2), (0.3, 0.3))
        elif drawn < 0.40:
            bin_ = Bin(float(rng.uniform(0.8, 1.2)))
            put_free(layout, lot, "bin", OTHER, bin_, (0.0, 0.0, 0.0), (0.7, 0.7))
    for lot in beside(layout, 7.5, kerb + footway - 1.0):
        kind, shape, size = _before_a_facade(rng)
        if shape is not None and size[1] < footway - 0.8:
            place = (float(rng.uniform(-1.0, 1.0)), 0.0, np.pi if kind == "bus shelter" else 0.0)
            put_free(layout, lot, kind, OTHER, shape, place, size)


def _before_a_facade(rng: np.random.Generator) -> tuple[str, Shape | None, tuple[float, float]]:
    """Draw what stands before a facade: its kind, shape and size along and across the street [m]."""
    tables = int(rng.integers(2, 4))
    odd = float(rng.uniform(0.8, 2.0))
    stock: tuple[tuple[float, str, Shape, tuple[float, float]], ...] = (
        (0.18, "terrace", Terrace(tables, bool(rng.random() < 0.6)), (2.2 * tables, 1.3)),
        (0.10, "oddment", Oddment(int(rng.integers(2**31)), odd), (odd, odd)),
        (0.06, "kiosk", Kiosk(1.1, 1.1, 2.4), (1.4, 1.4)),
        (0.05, "pillar", Column(0.65, 3.0), (1.5, 1.5)),
        (0.07, "bicycles", BikeRack(4), (2.6, 1.8)),
        (0.07, "planter", Column(0.45, float(rng.uniform(0.5, 1.0))), (1.0, 1.0)),
        (0.03, "bus shelter", BusShelter(), (4.4, 2.0)),
    )
    drawn = float(rng.random())
    for share, kind, shape, size in stock:
        if drawn < share:
            return kind, shape, size
        drawn -= share
    return "", None, (0.0, 0.0)

"""What stands along the kerbs, one after another: vehicles, motorcycles in rows, containers, skips, parklets."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from subiaco_sim.families.placing import lot_at, put
from subiaco_sim.families.street_objects import BikeRack, Container, Oddment, Skip, Terrace
from subiaco_sim.families.vehicles import Bus, Motorcycle, random_vehicle
from subiaco_sim.scene import MOBILE, OTHER
from subiaco_sim.suburb import Layout, Lot

_BAY = 6.6  # along the kerb of a bay that stays empty [m]
_INWARD = -1.1  # from the kerb to the middle of what is parked [m]


def fill_kerbs(layout: Layout, kerb: float, shares: Mapping[str, float]) -> None:
    """Fill both kerbs from end to end, ``kerb`` from the crown [m].

    ``shares`` of what a place at the kerb holds: vehicle, motorcycles, container, skip, bus, bicycles, parklet;
    the rest stays empty.
    """
    rng = layout.rng
    names, weights = list(shares), np.array(list(shares.values()))
    for side in layout.sides:
        station = float(rng.uniform(4.0, 8.0))
        while station < 0.25 * len(layout.centreline) - 8.0:
            drawn = float(rng.random())
            slot = int(np.searchsorted(np.cumsum(weights), drawn))
            what = names[slot] if slot < len(names) else ""
            lot = lot_at(layout, station, side, kerb)
            length = _fill(layout, lot, what)
            station += length + float(rng.uniform(0.7, 1.6))


def _fill(layout: Layout, lot: Lot, what: str) -> float:
    """Put one thing at the kerb, ahead of a place; returns the length that it takes [m]."""
    rng = layout.rng
    turn = 0.0 if rng.random() < 0.5 else np.pi
    if what == "vehicle":
        vehicle = random_vehicle(rng)
        kind = "car" if vehicle.length < 5.3 else "long vehicle"
        inward = _INWARD + (0.9 if rng.random() < 0.1 else float(rng.uniform(-0.1, 0.1)))
        put(layout, lot, kind, MOBILE, vehicle, (vehicle.length / 2, inward, turn))
        return vehicle.length
    if what == "motorcycles":
        number = int(rng.integers(1, 6))
        for k in range(number):
            yaw = np.pi / 2 + float(rng.uniform(-0.35, 0.35))
            cycle = Motorcycle(float(rng.uniform(1.8, 2.3)), float(rng.uniform(1.05, 1.45)))
            put(layout, lot, "motorcycle", MOBILE, cycle, (0.5 + 1.0 * k, _INWARD + 0.1, yaw))
        return 1.0 * number
    if what == "bus":
        put(layout, lot, "bus", MOBILE, Bus(float(rng.uniform(10.5, 12.5))), (6.5, _INWARD - 0.3, turn))
        return 13.0
    if what in ("container", "skip"):
        shape = Container() if what == "container" else Skip(float(rng.uniform(3.0, 4.2)))
        put(layout, lot, what, OTHER, shape, (shape.length / 2, _INWARD - 0.15, 0.0))
        return shape.length
    if what == "bicycles":
        put(layout, lot, "bicycles", OTHER, BikeRack(int(rng.integers(3, 8))), (2.4, _INWARD + 0.2, 0.0))
        return 4.8
    if what == "parklet":
        odd = rng.random() < 0.3
        shape = Oddment(int(rng.integers(2**31)), 2.2) if odd else Terrace(2, bool(rng.random() < 0.6))
        put(layout, lot, "parklet", OTHER, shape, (2.4, _INWARD, 0.0))
        return 4.8
    return _BAY

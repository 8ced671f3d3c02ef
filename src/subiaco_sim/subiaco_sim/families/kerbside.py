"""What stands along the kerbs, one after another: vehicles, motorcycles, containers, skips, parklets."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from subiaco_sim.families.placing import lot_at, put
from subiaco_sim.families.street_objects import BikeRack, Container, Oddment, Skip, Terrace
from subiaco_sim.families.vehicles import Bus, Motorcycle, random_vehicle
from subiaco_sim.scene import MOBILE, OTHER, Shape
from subiaco_sim.suburb import Layout, Lot

_BAY = 6.6  # along the kerb of a bay that stays empty [m]
_LONG = 5.3  # from this length on a vehicle is of the kind "long vehicle" [m]
_INWARD = -1.1  # from the kerb to the middle of what is parked [m]


def fill_kerbs(layout: Layout, kerb: float, shares: Mapping[str, float]) -> None:
    """Fill both kerbs from end to end, ``kerb`` from the crown [m].

    ``shares`` of what a place at the kerb holds: vehicle, motorcycles, container, skip, bus, bicycles,
    parklet; the rest stays empty.
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
    if what == "vehicle":
        return _park(layout, lot)
    if what == "motorcycles":
        return _park_motorcycles(layout, lot)
    if what == "bus":
        turn = 0.0 if rng.random() < 0.5 else np.pi
        bus = Bus(float(rng.uniform(10.5, 12.5)))
        put(layout, lot, "bus", MOBILE, bus, (bus.length / 2, _INWARD - 0.3, turn))
        return bus.length
    made = _things(rng).get(what)
    if made is None:
        return _BAY
    shape, length = made
    put(layout, lot, what, OTHER, shape, (length / 2, _INWARD, 0.0))
    return length


def _park(layout: Layout, lot: Lot) -> float:
    """Park a vehicle, one in ten with two wheels on the footway; returns its length [m]."""
    rng = layout.rng
    vehicle = random_vehicle(rng)
    kind = "car" if vehicle.length < _LONG else "long vehicle"
    inward = _INWARD + (0.9 if rng.random() < 0.1 else float(rng.uniform(-0.1, 0.1)))
    turn = 0.0 if rng.random() < 0.5 else np.pi
    put(layout, lot, kind, MOBILE, vehicle, (vehicle.length / 2, inward, turn))
    return vehicle.length


def _park_motorcycles(layout: Layout, lot: Lot) -> float:
    """Park up to five motorcycles side by side; returns the length of the row [m]."""
    rng = layout.rng
    number = int(rng.integers(1, 6))
    for k in range(number):
        yaw = np.pi / 2 + float(rng.uniform(-0.35, 0.35))
        cycle = Motorcycle(float(rng.uniform(1.8, 2.3)), float(rng.uniform(1.05, 1.45)))
        put(layout, lot, "motorcycle", MOBILE, cycle, (0.5 + k, _INWARD + 0.1, yaw))
    return float(number)


def _things(rng: np.random.Generator) -> dict[str, tuple[Shape, float]]:
    """Draw one of each thing that is no vehicle, and its length along the kerb [m]."""
    odd = Oddment(int(rng.integers(2**31)), 2.2)
    skip, rack = Skip(float(rng.uniform(3.0, 4.2))), BikeRack(int(rng.integers(3, 8)))
    return {
        "container": (Container(), Container().length),
        "skip": (skip, skip.length),
        "bicycles": (rack, 0.6 * rack.bicycles),
        "parklet": (odd if rng.random() < 0.3 else Terrace(2, bool(rng.random() < 0.6)), 4.8),
    }

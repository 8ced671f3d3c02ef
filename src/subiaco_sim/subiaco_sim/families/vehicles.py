"""Vans, buses, motorcycles and caravans, and a draw of all that parks at a kerb."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from subiaco_sim.furniture import Car, Truck
from subiaco_sim.primitives import Material, Mesh, box, cylinder, extrude_across, join


def _wheels(radius: float, spots: tuple[tuple[float, float], ...]) -> list[Mesh]:
    profile = [
        (radius * np.cos(a), radius * (1 + np.sin(a))) for a in np.linspace(0, 2 * np.pi, 8, endpoint=False)
    ]
    wheel = extrude_across([(float(x), float(z)) for x, z in profile], 0.22, Material.ASPHALT)
    return [wheel.placed(x, y, 0) for x, y in spots]


def _four(length: float, width: float) -> tuple[tuple[float, float], ...]:
    return tuple((a * 0.32 * length, b * (width / 2 - 0.12)) for a in (-1, 1) for b in (-1, 1))


@dataclass(frozen=True)
class Van:
    """A panel van, x forward; 2.4 to 2.8 m high [m]."""

    length: float = 5.6
    width: float = 2.0
    height: float = 2.6

    def mesh(self) -> Mesh:
        """Return the van on z = 0."""
        n, h = self.length / 2, self.height
        side = [(-n, 0.35), (n, 0.35), (n, 0.42 * h), (0.72 * n, 0.5 * h), (0.5 * n, h), (-0.98 * n, h)]
        body = extrude_across(side, self.width, Material.PAINT)
        pane = box(0.1, 0.8 * self.width, 0.3 * h, Material.GLASS).placed(0.66 * n, 0, 0.58 * h)
        return join([body, pane, *_wheels(0.34, _four(self.length, self.width))])


@dataclass(frozen=True)
class Bus:
    """A city bus, x forward [m]."""

    length: float = 12.0
    width: float = 2.55
    height: float = 3.1

    def mesh(self) -> Mesh:
        """Return the bus on z = 0."""
        body = box(self.length, self.width, self.height - 0.35, Material.PAINT).placed(0, 0, 0.35)
        panes = [
            box(0.9 * self.length, 0.04, 1.1, Material.GLASS).placed(0, s * self.width / 2, 1.3)
            for s in (-1, 1)
        ]
        front = box(0.04, 0.9 * self.width, 1.6, Material.GLASS).placed(self.length / 2, 0, 1.0)
        return join([body, *panes, front, *_wheels(0.48, _four(self.length, self.width))])


@dataclass(frozen=True)
class Motorcycle:
    """A motorcycle or scooter on its stand, x forward [m]."""

    length: float = 2.1
    height: float = 1.2

    def mesh(self) -> Mesh:
        """Return the motorcycle on z = 0."""
        x = self.length / 2
        body = extrude_across(
            [(-0.8 * x, 0.55), (-0.3 * x, 0.4), (0.4 * x, 0.4), (0.5 * x, 0.8), (-0.75 * x, 0.85)],
            0.35,
            Material.PAINT,
        )
        bar = box(0.12, 0.75, 0.12, Material.SHEET_METAL).placed(0.5 * x, 0, self.height - 0.24)
        fork = box(0.1, 0.12, self.height - 0.3, Material.SHEET_METAL).placed(0.6 * x, 0, 0.3)
        glass = box(0.05, 0.35, 0.2, Material.GLASS).placed(0.55 * x, 0, self.height - 0.2)
        return join([body, bar, fork, glass, *_wheels(0.3, ((-0.7 * x, 0.0), (0.7 * x, 0.0)))])


@dataclass(frozen=True)
class Caravan:
    """A caravan or box trailer on two wheels, drawbar towards +x [m]."""

    length: float = 4.6
    width: float = 2.2
    height: float = 2.5

    def mesh(self) -> Mesh:
        """Return the caravan on z = 0."""
        body = box(self.length, self.width, self.height - 0.45, Material.PAINT).placed(0, 0, 0.45)
        bar = box(1.2, 0.12, 0.1, Material.SHEET_METAL).placed(self.length / 2 + 0.6, 0, 0.42)
        jockey = cylinder(0.05, 0.5, Material.SHEET_METAL, 6).placed(self.length / 2 + 1.0, 0, 0)
        wheels = _wheels(0.33, tuple((0.0, s * (self.width / 2 - 0.12)) for s in (-1, 1)))
        return join([body, bar, jockey, *wheels])


Vehicle = Car | Van | Truck | Motorcycle | Caravan | Bus


def random_vehicle(rng: np.random.Generator, longest: float = 6.2) -> Vehicle:
    """Draw what parks at a kerb: mostly cars of any length and height, vans, a few trucks and caravans."""
    drawn = rng.random()
    if drawn < 0.64:
        tall = bool(rng.random() < 0.4)
        height = rng.uniform(1.6, 2.05) if tall else rng.uniform(1.35, 1.6)
        length, width = rng.uniform(3.4, 5.2), rng.uniform(1.62, 1.98)
        return Car(float(length), float(width), float(height), tall=tall)
    if drawn < 0.86:
        length = float(rng.uniform(4.7, min(6.0, longest)))
        return Van(length, float(rng.uniform(1.9, 2.1)), float(rng.uniform(2.4, 2.8)))
    if drawn < 0.94:
        return Caravan(float(rng.uniform(2.4, min(5.0, longest - 1.0))), 2.1, float(rng.uniform(1.5, 2.7)))
    return Truck(float(rng.uniform(5.4, max(5.5, longest))), 2.2, float(rng.uniform(2.7, 3.6)))

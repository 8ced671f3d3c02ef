"""What stands on streets for a day, a month or for good: containers, scaffolding, stalls, and odd things."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from subiaco_sim.primitives import Material, Mesh, box, cylinder, extrude_across, join, polygons

_BURIED = 0.6  # how far posts and walls go below the ground, for slopes [m]


@dataclass(frozen=True)
class Container:
    """A shipping container of 20 feet [m]."""

    length: float = 6.06
    width: float = 2.44
    height: float = 2.59

    def mesh(self) -> Mesh:
        """Return the container on z = 0."""
        return box(self.length, self.width, self.height, Material.SHEET_METAL)


@dataclass(frozen=True)
class Skip:
    """An open skip for rubble, wider above than below [m]."""

    length: float = 3.6
    width: float = 1.8
    height: float = 1.5

    def mesh(self) -> Mesh:
        """Return the skip on z = 0."""
        n = self.length / 2
        side = [(-0.65 * n, 0.0), (0.65 * n, 0.0), (n, self.height), (-n, self.height)]
        tub = extrude_across(side, self.width, Material.SHEET_METAL)
        load = box(1.2 * n, 0.7 * self.width, 0.3, Material.CONCRETE)
        return join([tub, load.placed(0, 0, self.height - 0.1)])


@dataclass(frozen=True)
class Scaffolding:
    """Poles, decks and rails before a facade, along x [m]; ``netted`` hides the facade."""

    length: float
    height: float
    depth: float = 1.1
    netted: bool = False

    def mesh(self) -> Mesh:
        """Return the scaffolding on z = 0."""
        pole = cylinder(0.035, self.height + _BURIED, Material.SHEET_METAL, 6)
        spots = np.linspace(-self.length / 2, self.length / 2, max(2, round(self.length / 2.5) + 1))
        rows = (-self.depth / 2, self.depth / 2)
        parts = [pole.placed(float(x), y, -_BURIED) for x in spots for y in rows]
        deck = box(self.length, self.depth, 0.06, Material.TIMBER)
        rail = box(self.length, 0.05, 0.05, Material.SHEET_METAL)
        for floor in np.arange(2.0, self.height - 0.4, 2.0):
            parts.append(deck.placed(0, 0, float(floor)))
            if floor + 1.05 < self.height:
                parts.append(rail.placed(0, -self.depth / 2, float(floor) + 1.0))
        if self.netted:
            net = box(self.length, 0.03, self.height - 2.2, Material.PAINT)
            parts.append(net.placed(0, -self.depth / 2 - 0.05, 2.2))
        return join(parts)


@dataclass(frozen=True)
class MarketStall:
    """A stall with a counter and a tilted awning on four posts [m]."""

    length: float = 3.0
    depth: float = 2.2
    height: float = 2.5

    def mesh(self) -> Mesh:
        """Return the stall on z = 0; the counter faces -y."""
        x, y, h = self.length / 2, self.depth / 2, self.height
        corners = [(-x, -y, h - 0.4), (x, -y, h - 0.4), (x, y, h), (-x, y, h)]
        awning = polygons(corners, [(0, 1, 2, 3)], Material.PAINT)
        counter = box(0.9 * self.length, 0.8, 0.9, Material.TIMBER).placed(0, -y + 0.5, 0)
        crates = box(0.6 * self.length, 0.6, 0.7, Material.TIMBER).placed(0, y - 0.4, 0)
        post = box(0.05, 0.05, h - 0.35 + _BURIED, Material.SHEET_METAL)
        posts = [post.placed(a * (x - 0.05), b * (y - 0.05), -_BURIED) for a in (-1, 1) for b in (-1, 1)]
        return join([awning, counter, crates, *posts])


@dataclass(frozen=True)
class Column:
    """A round thing such as an advertising column, a bollard or a planter tub [m]."""

    radius: float
    height: float

    def mesh(self) -> Mesh:
        """Return the column on z = 0."""
        body = cylinder(self.radius, self.height, Material.CONCRETE, 12)
        return join(
            [body, cylinder(1.1 * self.radius, 0.08, Material.SHEET_METAL, 12).placed(0, 0, self.height)]
        )


@dataclass(frozen=True)
class Kiosk:
    """A kiosk, telephone box or transformer: a box under a wider lid [m]."""

    length: float
    width: float
    height: float

    def mesh(self) -> Mesh:
        """Return the box on z = 0."""
        body = box(self.length, self.width, self.height - 0.15, Material.RENDER)
        lid = box(self.length + 0.3, self.width + 0.3, 0.15, Material.SHEET_METAL).placed(
            0, 0, self.height - 0.15
        )
        return join([body, lid])


@dataclass(frozen=True)
class Terrace:
    """Tables before a cafe, each with a parasol, in a row along x."""

    tables: int = 3
    parasols: bool = True

    def mesh(self) -> Mesh:
        """Return the tables on z = 0."""
        parts = []
        for k in range(self.tables):
            x = 2.2 * (k - (self.tables - 1) / 2)
            parts.append(cylinder(0.35, 0.75, Material.TIMBER, 8).placed(x, 0, 0))
            parts += [box(0.45, 0.45, 0.85, Material.TIMBER).placed(x + s * 0.75, 0, 0) for s in (-1, 1)]
            if self.parasols:
                parts.append(cylinder(0.03, 2.4, Material.SHEET_METAL, 6).placed(x, 0.5, 0))
                parts.append(cylinder(1.0, 0.12, Material.PAINT, 8).placed(x, 0.5, 2.3))
        return join(parts)


@dataclass(frozen=True)
class BikeRack:
    """A row of bicycles side by side, each along y."""

    bicycles: int = 5

    def mesh(self) -> Mesh:
        """Return the bicycles on z = 0."""
        parts = []
        for k in range(self.bicycles):
            x = 0.6 * (k - (self.bicycles - 1) / 2)
            parts += [box(0.05, 0.64, 0.66, Material.SHEET_METAL).placed(x, s * 0.5, 0) for s in (-1, 1)]
            parts.append(box(0.05, 1.0, 0.08, Material.PAINT).placed(x, 0, 0.6))
            parts.append(box(0.5, 0.05, 0.05, Material.SHEET_METAL).placed(x, 0.45, 1.0))
        return join(parts)


@dataclass(frozen=True)
class Wall:
    """A wall or panel along x that stands on sloping ground [m]."""

    length: float
    height: float
    thickness: float = 0.25
    material: Material = Material.BRICK

    def mesh(self) -> Mesh:
        """Return the wall, ground at z = 0."""
        return box(self.length, self.thickness, self.height + _BURIED, self.material).placed(0, 0, -_BURIED)


@dataclass(frozen=True)
class StreetLamp:
    """A lamp on a straight post, without an arm [m]."""

    height: float = 5.5

    def mesh(self) -> Mesh:
        """Return the lamp, ground at z = 0."""
        post = cylinder(0.07, self.height + _BURIED, Material.SHEET_METAL, 8).placed(0, 0, -_BURIED)
        return join([post, cylinder(0.28, 0.5, Material.GLASS, 8).placed(0, 0, self.height - 0.5)])


@dataclass(frozen=True)
class Oddment:
    """A thing of no kind: two to five boxes and cylinders put together from a seed, up to ``size`` [m]."""

    form: int
    size: float = 1.6

    def mesh(self) -> Mesh:
        """Return the thing on z = 0."""
        rng = np.random.default_rng([self.form, 6])
        parts = []
        for _ in range(int(rng.integers(2, 6))):
            length, width, height = (float(v) for v in self.size * rng.uniform(0.2, 0.8, 3))
            material = Material(int(rng.choice([Material.PAINT, Material.SHEET_METAL, Material.TIMBER])))
            x, y = (float(v) for v in self.size * rng.uniform(-0.25, 0.25, 2))
            lift = float(rng.choice([0.0, 0.0, 0.3])) * self.size
            one = box(length, width, height, material)
            if rng.random() < 0.4:
                one = cylinder(length / 2, height, material, 9)
            parts.append(one.placed(x, y, lift, float(rng.uniform(0, np.pi))))
        parts.append(cylinder(0.06 * self.size, 0.8 * self.size, Material.SHEET_METAL, 6))
        return join(parts)

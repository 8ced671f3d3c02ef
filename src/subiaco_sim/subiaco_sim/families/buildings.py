"""Buildings of both families: any eaves height, any roof, annexes, arcades, balconies, courts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from subiaco_sim.families.roofs import Roof, roof_mesh
from subiaco_sim.primitives import Material, Mesh, box, cylinder, join

SUNK = 3.0  # how far walls go below the ground at the middle of a building, for slopes up to 12 % [m]
ARCADE_HEIGHT = 3.8  # clear height of an arcade [m]
PASSAGE = (3.0, 3.8)  # width and height of the way into a court [m]
_STOREY = 3.0


@dataclass(frozen=True)
class Annexe:
    """A flat-roofed box on a building: its middle, size and the heights of its foot and top [m]."""

    x: float
    y: float
    length: float
    width: float
    foot: float
    top: float

    @property
    def volume(self) -> float:
        """Return its volume [m3]."""
        return self.length * self.width * (self.top - max(self.foot, 0.0))

    def mesh(self) -> Mesh:
        """Return the box; one that stands on the ground goes on below it."""
        foot = -SUNK if self.foot <= 0.0 else self.foot
        return box(self.length, self.width, self.top - foot, Material.RENDER).placed(self.x, self.y, foot)


@dataclass(frozen=True)
class Building:
    """A building about its own middle; x runs along the street, -y faces it.

    ``eaves`` is where the walls end, ``rise`` what the roof adds [m]; ``arcade`` is how far the ground floor
    stands back behind columns; ``cut`` is the width that was taken off on the right side.
    """

    width: float
    depth: float
    eaves: float
    roof: Roof
    rise: float
    wall: Material = Material.BRICK
    cover: Material = Material.TILE
    overhang: float = 0.35
    arcade: float = 0.0
    balconies: float = 0.0  # depth of balconies towards the street [m]
    veranda: float = 0.0
    chimney: bool = False
    panels: bool = False  # solar panels on the front of the roof
    annexes: tuple[Annexe, ...] = ()
    cut: float = 0.0
    pane: float = 3.2  # distance from window to window [m]

    @property
    def volume(self) -> float:
        """Return the volume below the eaves and of the annexes [m3]."""
        return self.width * self.depth * self.eaves + sum(a.volume for a in self.annexes)

    @property
    def top(self) -> float:
        """Return the height of ridge or parapet [m]."""
        return self.eaves + self.rise

    def mesh(self) -> Mesh:
        """Return the building, ground at z = 0."""
        width = self.width - self.cut
        roof = roof_mesh(self.roof, (width, self.depth), self.rise, self.cover, self.wall, self.overhang)
        parts = [*self._walls(width), roof.placed(0, 0, self.eaves), *self._windows(width)]
        if self.balconies > 0:
            parts += self._balconies(width)
        if self.veranda > 0:
            parts += self._veranda(width)
        if self.chimney:
            parts.append(
                box(0.7, 0.6, self.rise + 1.3, Material.BRICK).placed(width / 4, 0.8, self.eaves - 0.5)
            )
        if self.panels:
            parts.append(self._panels(width))
        whole = join(parts).placed(-self.cut / 2, 0, 0)
        return join([whole, *(annexe.mesh() for annexe in self.annexes)])

    def _walls(self, width: float) -> list[Mesh]:
        if self.arcade <= 0:
            return [box(width, self.depth, self.eaves + SUNK, self.wall).placed(0, 0, -SUNK)]
        foot = ARCADE_HEIGHT
        below = box(width, self.depth - self.arcade, foot + SUNK, self.wall).placed(0, self.arcade / 2, -SUNK)
        above = box(width, self.depth, self.eaves - foot, self.wall).placed(0, 0, foot)
        column = cylinder(0.22, foot + SUNK, Material.CONCRETE, 8)
        count = max(2, round(width / 3.4) + 1)
        spots = np.linspace(-width / 2 + 0.3, width / 2 - 0.3, count)
        front = -self.depth / 2 + 0.3
        return [below, above, *(column.placed(float(x), front, -SUNK) for x in spots)]

    def _windows(self, width: float) -> list[Mesh]:
        """Panes 4 cm proud of the front, and of the back, a row each storey."""
        count = max(1, int((width - 1.0) / self.pane))
        spots = (np.arange(count) - (count - 1) / 2) * self.pane
        pane = box(1.3, 0.08, 1.5, Material.GLASS)
        found = []
        for sill in np.arange(0.9, self.eaves - 1.7, _STOREY):
            setback = self.arcade if sill < ARCADE_HEIGHT - 1.5 else 0.0
            faces = (-self.depth / 2 + setback, self.depth / 2)
            found += [pane.placed(float(x), y, float(sill)) for x in spots for y in faces]
        door = box(1.1, 0.1, 2.1, Material.TIMBER).placed(0.3 * width, -self.depth / 2 + self.arcade, 0)
        return [*found, door]

    def _balconies(self, width: float) -> list[Mesh]:
        front = -self.depth / 2
        slab = box(0.5 * width, self.balconies, 0.18, Material.CONCRETE)
        rail = box(0.5 * width, 0.05, 1.0, Material.SHEET_METAL)
        found = []
        for floor in np.arange(_STOREY + 0.8, self.eaves - 2.0, _STOREY):
            found.append(slab.placed(0, front - self.balconies / 2, float(floor)))
            found.append(rail.placed(0, front - self.balconies, float(floor) + 0.18))
        return found

    def _veranda(self, width: float) -> list[Mesh]:
        front = -self.depth / 2 - self.veranda
        lid = box(width, self.veranda, 0.1, Material.SHEET_METAL).placed(0, front + self.veranda / 2, 2.5)
        post = box(0.12, 0.12, 2.5 + SUNK, Material.TIMBER)
        return [
            lid,
            *(post.placed(s * (width / 2 - 0.1), front + 0.1, -SUNK) for s in (-1.0, -0.33, 0.33, 1.0)),
        ]

    def _panels(self, width: float) -> Mesh:
        """Return a tilted array, 12 cm above a third of the front slope."""
        slope = self.rise / (self.depth / 2) if self.roof in (Roof.GABLE, Roof.HIP) else 0.0
        y, size = -self.depth / 4, (0.4 * width, 0.28 * self.depth)
        flat = box(size[0], size[1], 0.06, Material.GLASS)
        corners = flat.vertices.copy()
        corners[:, 2] += slope * corners[:, 1]
        lift = self.eaves + (self.rise / 2 if slope else 0.05) + 0.12
        return Mesh(corners, flat.triangles, flat.material).placed(0.1 * width, y, lift)


@dataclass(frozen=True)
class CourtBlock:
    """Four wings about a court; a passage leads in from the street (-y) [m]."""

    width: float
    depth: float
    eaves: float
    roof: Roof
    rise: float
    wing: float = 9.0  # depth of the wings towards street and back
    side: float = 5.0  # depth of the wings at the sides

    def mesh(self) -> Mesh:
        """Return the block, ground at z = 0."""
        front = -(self.depth - self.wing) / 2
        passage, clear = PASSAGE
        half = (self.width - passage) / 2
        wall, tile = Material.RENDER, Material.TILE
        jamb = box(half, self.wing, self.eaves + SUNK, wall)
        parts = [jamb.placed(s * (half + passage) / 2, front, -SUNK) for s in (-1, 1)]
        parts.append(box(passage, self.wing, self.eaves - clear, wall).placed(0, front, clear))
        roof = roof_mesh(self.roof, (self.width, self.wing), self.rise, tile, wall, 0.2)
        parts += [roof.placed(0, front, self.eaves), roof.placed(0, -front, self.eaves, np.pi)]
        parts.append(box(self.width, self.wing, self.eaves + SUNK, wall).placed(0, -front, -SUNK))
        inner = self.depth - 2 * self.wing
        flank = box(self.side, inner, 0.7 * self.eaves + SUNK, wall)
        parts += [flank.placed(s * (self.width - self.side) / 2, 0, -SUNK) for s in (-1, 1)]
        return join([*parts, *self._windows(front - self.wing / 2, half, passage)])

    def _windows(self, y: float, half: float, passage: float) -> list[Mesh]:
        pane = box(1.3, 0.08, 1.6, Material.GLASS)
        spots = np.arange(1.6, half - 0.8, 3.0) + passage / 2
        return [
            pane.placed(float(s * x), y, float(sill))
            for sill in np.arange(1.0, self.eaves - 1.8, _STOREY)
            for x in spots
            for s in (-1, 1)
        ]

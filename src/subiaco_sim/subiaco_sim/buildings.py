"""Houses of a suburb: gable, hip and flat roofs, verandas, storeys, extensions, part removals."""

from __future__ import annotations

from dataclasses import dataclass

from subiaco_sim.primitives import Material, Mesh, box, join, polygons

STOREY = 2.9  # floor to floor [m]
SUNK = 0.5  # how far walls go below the ground they stand on [m]


@dataclass(frozen=True)
class House:
    """A house: its x axis runs along the street, its -y side faces it.

    ``wing`` and ``extension`` are lengths [m] added to the right and the left
    side, each with a lower flat or skillion roof; 0 for none.
    """

    width: float
    depth: float
    roof: str  # gable, hip, flat
    storeys: int = 1
    pitch: float = 0.45  # rise per run
    overhang: float = 0.45
    veranda: float = 0.0  # depth of a veranda at the front [m]
    extension: float = 0.0
    chimney: bool = False
    wall: Material = Material.BRICK
    cover: Material = Material.TILE
    wing: float = 0.0  # depth of a wing towards the street, left half: an L [m]
    carport: float = 0.0  # width of a roof on posts at the right side [m]

    @property
    def eaves(self) -> float:
        """Height of the eaves above ground [m]."""
        return STOREY * self.storeys

    def mesh(self) -> Mesh:
        """Return the house about its own centre, ground at z = 0."""
        parts = [self._walls(), self._roof(), *self._openings()]
        if self.veranda > 0:
            parts += self._veranda()
        if self.extension > 0:
            parts.append(self._extension())
        if self.wing > 0:
            parts.append(self._wing())
        if self.carport > 0:
            parts += self._carport()
        if self.chimney:
            stack = box(0.7, 0.7, 1.6, Material.BRICK)
            parts.append(stack.placed(self.width / 4, 0.6, self.eaves + 0.5 * self.pitch * self.depth - 0.8))
        return join(parts)

    def _walls(self) -> Mesh:
        return box(self.width, self.depth, self.eaves + SUNK, self.wall).placed(0, 0, -SUNK)

    def _roof(self) -> Mesh:
        if self.roof == "flat":
            return box(self.width + 0.3, self.depth + 0.3, 0.35, self.cover).placed(0, 0, self.eaves)
        x, y = self.width / 2 + self.overhang, self.depth / 2 + self.overhang
        if self.roof == "skillion":
            return self._skillion(x, y)
        rise = self.pitch * y
        ridge = x if self.roof == "gable" else max(x - y, 0.3)
        base = self.eaves - self.pitch * self.overhang
        vertices = [(-x, -y, base), (x, -y, base), (x, y, base), (-x, y, base)]
        vertices += [(-ridge, 0.0, base + rise), (ridge, 0.0, base + rise)]
        roof = polygons(vertices, [(0, 1, 5, 4), (2, 3, 4, 5), (0, 1, 2, 3)], self.cover)
        ends = polygons(vertices, [(1, 2, 5), (3, 0, 4)], self.wall if self.roof == "gable" else self.cover)
        return join([roof, ends])

    def _skillion(self, x: float, y: float) -> Mesh:
        """One plane that falls to the back."""
        low, high = self.eaves, self.eaves + 0.3 * self.pitch * 2 * y
        slab = [(-x, -y, high), (x, -y, high), (x, y, low), (-x, y, low)]
        under = [(-x, -y, self.eaves - 0.2), (x, -y, self.eaves - 0.2), (x, y, low - 0.2), (-x, y, low - 0.2)]
        faces = [(0, 1, 2, 3), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]
        return polygons([*slab, *under], faces, self.cover)

    def _wing(self) -> Mesh:
        shape = House(self.width / 2, self.wing + 1.0, "hip", self.storeys, self.pitch, wall=self.wall)
        return shape.mesh().placed(-self.width / 4, -(self.depth + self.wing - 1.0) / 2, 0)

    def _carport(self) -> list[Mesh]:
        x, length = (self.width + self.carport) / 2, 5.6
        roof = box(self.carport, length, 0.12, Material.SHEET_METAL).placed(x, -self.depth / 2 + 1.0, 2.35)
        post = box(0.1, 0.1, 2.35 + SUNK, Material.SHEET_METAL)
        edge, front = x + self.carport / 2 - 0.1, -self.depth / 2 + 1.0
        return [roof, *(post.placed(edge, front + s * (length / 2 - 0.1), -SUNK) for s in (-1, 1))]

    def _openings(self) -> list[Mesh]:
        """Windows and a door, 4 cm proud of the front and side walls."""
        found = []
        for storey in range(self.storeys):
            sill = STOREY * storey + 0.9
            for share in (-0.3, 0.3):
                pane = box(1.6, 0.08, 1.3, Material.GLASS)
                found.append(pane.placed(share * self.width, -self.depth / 2, sill))
            side = box(0.08, 1.4, 1.2, Material.GLASS)
            found += [side.placed(sign * self.width / 2, 0.1 * self.depth, sill) for sign in (-1, 1)]
        return [*found, box(0.95, 0.1, 2.1, Material.TIMBER).placed(0, -self.depth / 2, 0)]

    def _veranda(self) -> list[Mesh]:
        x, front, back = self.width / 2, -self.depth / 2 - self.veranda, -self.depth / 2
        vertices = [(-x, front, 2.3), (x, front, 2.3), (x, back, 2.6), (-x, back, 2.6)]
        roof = polygons(vertices, [(0, 1, 2, 3)], Material.SHEET_METAL)
        posts = [
            box(0.12, 0.12, 2.3 + SUNK, Material.TIMBER).placed(s * (x - 0.1), front + 0.1, -SUNK)
            for s in (-1, -0.33, 0.33, 1)
        ]
        return [roof, *posts]

    def _extension(self) -> Mesh:
        height = self.eaves - 0.2
        body = box(self.extension, 0.8 * self.depth, height + SUNK, Material.RENDER)
        lid = box(self.extension + 0.2, 0.8 * self.depth + 0.3, 0.2, Material.SHEET_METAL)
        x = -(self.width + self.extension) / 2
        return join([body.placed(x, 0, -SUNK), lid.placed(x, 0, height)])


@dataclass(frozen=True)
class Shed:
    """A plain shed with a flat roof [m]."""

    length: float
    width: float
    height: float = 2.3

    def mesh(self) -> Mesh:
        """Return the shed about its own centre, ground at z = 0."""
        body = box(self.length, self.width, self.height + SUNK, Material.SHEET_METAL)
        return body.placed(0, 0, -SUNK)

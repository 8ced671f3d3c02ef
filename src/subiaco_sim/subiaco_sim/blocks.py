"""Larger buildings: shops with awnings, apartment blocks; and several shapes taken as one object."""

from __future__ import annotations

from dataclasses import dataclass

from subiaco_sim.buildings import STOREY, SUNK
from subiaco_sim.primitives import Material, Mesh, box, join
from subiaco_sim.scene import Placed


@dataclass(frozen=True)
class Shop:
    """A shop with a parapet and an awning over the footpath; -y faces the street [m]."""

    width: float
    depth: float
    height: float = 4.2
    awning: float = 2.4
    upper: int = 0  # storeys above the shop

    def mesh(self) -> Mesh:
        """Return the shop about its own centre, ground at z = 0."""
        total = self.height + STOREY * self.upper
        body = box(self.width, self.depth, total + SUNK, Material.RENDER).placed(0, 0, -SUNK)
        parapet = box(self.width, 0.25, 0.9, Material.BRICK).placed(0, -self.depth / 2 + 0.13, total)
        front = -self.depth / 2
        window = box(0.8 * self.width, 0.08, 2.2, Material.GLASS).placed(0, front, 0.4)
        parts = [body, parapet, window]
        if self.awning > 0:
            lid = box(self.width, self.awning, 0.15, Material.SHEET_METAL)
            parts.append(lid.placed(0, front - self.awning / 2, 3.0))
        return join(parts)


@dataclass(frozen=True)
class Apartments:
    """A flat-roofed block with balconies towards the street (-y) [m]."""

    width: float
    depth: float
    storeys: int = 3

    def mesh(self) -> Mesh:
        """Return the block about its own centre, ground at z = 0."""
        height = STOREY * self.storeys
        parts = [box(self.width, self.depth, height + 0.6 + SUNK, Material.RENDER).placed(0, 0, -SUNK)]
        front = -self.depth / 2
        for storey in range(self.storeys):
            sill = STOREY * storey
            for share in (-0.3, 0.0, 0.3):
                pane = box(2.0, 0.08, 1.9, Material.GLASS)
                parts.append(pane.placed(share * self.width, front, sill + 0.3))
            if storey:
                slab = box(0.85 * self.width, 1.5, 0.2, Material.CONCRETE).placed(0, front - 0.75, sill)
                rail = box(0.85 * self.width, 0.06, 1.0, Material.SHEET_METAL)
                parts += [slab, rail.placed(0, front - 1.45, sill + 0.2)]
        return join(parts)


@dataclass(frozen=True)
class Group:
    """Several placed shapes that are one object, such as two sheds where one stands later."""

    parts: tuple[Placed, ...]

    def mesh(self) -> Mesh:
        """Return all parts about the common foot."""
        return join([p.shape.mesh().placed(p.x, p.y, 0.0, p.yaw) for p in self.parts])

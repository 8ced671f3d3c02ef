"""What stands on the street: cars, light poles, fences, walls, bins."""

from __future__ import annotations

from dataclasses import dataclass

from subiaco_sim.primitives import Material, Mesh, box, cylinder, extrude_across, join


@dataclass(frozen=True)
class Car:
    """A parked car, x forward [m]."""

    length: float = 4.4
    width: float = 1.8
    height: float = 1.5
    tall: bool = False  # van or off-roader

    def mesh(self) -> Mesh:
        """Return the car on z = 0."""
        n, h = self.length / 2, self.height
        nose, tail = (0.55, -0.95) if self.tall else (0.35, -0.7)
        lower = [(-n, 0.25), (n, 0.25), (n, 0.5 * h), (0.85 * n, 0.6 * h)]
        side = [*lower, (nose * n, 0.64 * h), (-0.92 * n, 0.66 * h), (-n, 0.55 * h)]
        cabin = [(tail * n, 0.6 * h), (nose * n, 0.6 * h), (0.55 * nose * n, h), (0.8 * tail * n, h)]
        body = extrude_across(side, self.width, Material.PAINT)
        top = extrude_across(cabin, 0.86 * self.width, Material.GLASS)
        lid = box((0.5 * nose - 0.8 * tail) * n, 0.8 * self.width, 0.03, Material.PAINT)
        lid = lid.placed((0.5 * nose + 0.8 * tail) * n / 2, 0, h - 0.02)
        return join([body, top, lid, *self._wheels()])

    def _wheels(self) -> list[Mesh]:
        wheel = extrude_across(
            [(0.3, 0.0), (0.3, 0.5), (0.15, 0.62), (-0.15, 0.62), (-0.3, 0.5), (-0.3, 0.0)],
            0.2,
            Material.ASPHALT,
        )
        x, y = 0.31 * self.length, self.width / 2 - 0.1
        return [wheel.placed(a * x, b * y, 0) for a in (-1, 1) for b in (-1, 1)]


@dataclass(frozen=True)
class Pole:
    """A street light: height and arm towards +x [m]."""

    height: float = 7.5
    arm: float = 1.8

    def mesh(self) -> Mesh:
        """Return the pole on z = 0."""
        mast = cylinder(0.09, self.height + 0.3, Material.SHEET_METAL).placed(0, 0, -0.3)
        arm = box(self.arm, 0.08, 0.08, Material.SHEET_METAL).placed(self.arm / 2, 0, self.height - 0.15)
        lamp = box(0.6, 0.25, 0.12, Material.SHEET_METAL).placed(self.arm, 0, self.height - 0.2)
        return join([mast, arm, lamp])


@dataclass(frozen=True)
class Fence:
    """A fence or low wall: length and height [m]."""

    length: float
    height: float = 1.6
    thickness: float = 0.06
    material: Material = Material.TIMBER

    def mesh(self) -> Mesh:
        """Return the fence on z = 0, along x."""
        panel = box(self.length, self.thickness, self.height + 0.4, self.material)
        return panel.placed(0, 0, -0.4)


@dataclass(frozen=True)
class Bin:
    """A wheeled bin."""

    height: float = 1.05

    def mesh(self) -> Mesh:
        """Return the bin on z = 0."""
        return box(0.6, 0.6, self.height, Material.PAINT)

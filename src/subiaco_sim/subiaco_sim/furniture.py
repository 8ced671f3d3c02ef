"""What stands on the street: cars, light poles, fences, walls, bins."""

from __future__ import annotations

from dataclasses import dataclass

from subiaco_sim.primitives import Material, Mesh, box, cylinder, extrude_across, join, polygons


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


@dataclass(frozen=True)
class Truck:
    """A truck with a box body, x forward [m]."""

    length: float = 7.2
    width: float = 2.3
    height: float = 3.2

    def mesh(self) -> Mesh:
        """Return the truck on z = 0."""
        cab = box(1.9, self.width, 2.1, Material.PAINT).placed(self.length / 2 - 0.95, 0, 0.45)
        pane = box(0.08, 0.85 * self.width, 0.7, Material.GLASS).placed(self.length / 2, 0, 1.6)
        body = box(self.length - 2.1, self.width, self.height - 0.9, Material.PAINT)
        frame = box(self.length - 0.4, 0.9 * self.width, 0.5, Material.SHEET_METAL).placed(0, 0, 0.4)
        wheel = cylinder(0.45, 0.9, Material.ASPHALT, 8)
        wheels = [
            wheel.placed(a * self.length, b * 0.42 * self.width, 0) for a in (-0.3, 0.32) for b in (-1, 1)
        ]
        return join([cab, pane, body.placed(-1.05, 0, 0.9), frame, *wheels])


@dataclass(frozen=True)
class Sign:
    """A traffic sign on a post [m]."""

    height: float = 2.6

    def mesh(self) -> Mesh:
        """Return the sign on z = 0."""
        post = cylinder(0.035, self.height + 0.3, Material.SHEET_METAL, 6).placed(0, 0, -0.3)
        return join([post, box(0.05, 0.65, 0.65, Material.PAINT).placed(0.06, 0, self.height - 0.7)])


@dataclass(frozen=True)
class BusShelter:
    """A bus shelter with a bench, open towards -y [m]."""

    length: float = 4.0

    def mesh(self) -> Mesh:
        """Return the shelter on z = 0."""
        back = box(self.length, 0.06, 2.0, Material.GLASS).placed(0, 0.7, 0.2)
        sides = [box(0.06, 1.2, 2.0, Material.GLASS).placed(s * self.length / 2, 0.1, 0.2) for s in (-1, 1)]
        roof = box(self.length + 0.4, 1.9, 0.12, Material.SHEET_METAL).placed(0, 0, 2.4)
        posts = [
            cylinder(0.05, 2.7, Material.SHEET_METAL, 6).placed(s * self.length / 2, 0.7, -0.3)
            for s in (-1, 1)
        ]
        bench = box(0.7 * self.length, 0.4, 0.45, Material.TIMBER).placed(0, 0.4, 0)
        return join([back, *sides, roof, *posts, bench])


@dataclass(frozen=True)
class Wires:
    """Power lines from one pole towards +x: span, height of the poles, sag, rise of the far end [m]."""

    span: float
    height: float = 8.2
    sag: float = 0.6
    rise: float = 0.0
    lines: int = 3

    def mesh(self) -> Mesh:
        """Return the wires, their poles not included."""
        parts, pieces = [], 8
        for line in range(self.lines):
            y = 0.45 * (line - (self.lines - 1) / 2)
            for k in range(pieces):
                a, b = k / pieces, (k + 1) / pieces
                ends = [self.height + self.rise * t - 4 * self.sag * t * (1 - t) for t in (a, b)]
                parts.append(self._piece(a * self.span, b * self.span, y, ends))
        return join(parts)

    @staticmethod
    def _piece(start: float, end: float, y: float, ends: list[float]) -> Mesh:
        corners = [(x, y + d, z) for x, z in ((start, ends[0]), (end, ends[1])) for d in (-0.015, 0.015)]
        above = [(x, y, z + 0.025) for x, _, z in corners[::2]]
        return polygons([*corners, *above], [(0, 1, 3, 2), (0, 2, 5, 4), (1, 3, 5, 4)], Material.WIRE)


@dataclass(frozen=True)
class Person:
    """Somebody on foot, or on a bicycle along x [m]."""

    height: float = 1.72
    cycling: bool = False

    def mesh(self) -> Mesh:
        """Return the person on z = 0."""
        lift = 0.35 if self.cycling else 0.0
        body = cylinder(0.21, self.height - 0.3, Material.PAINT, 7).placed(0, 0, lift)
        head = cylinder(0.11, 0.28, Material.PAINT, 6).placed(0, 0, self.height - 0.28 + lift)
        parts = [body, head]
        if self.cycling:
            parts += [box(0.66, 0.05, 0.66, Material.SHEET_METAL).placed(x, 0, 0) for x in (-0.5, 0.5)]
            parts.append(box(1.0, 0.05, 0.1, Material.SHEET_METAL).placed(0, 0, 0.6))
        return join(parts)

"""Roofs over a rectangle: flat with a parapet, pent, gable, hip and mansard."""

from __future__ import annotations

from enum import StrEnum

from subiaco_sim.primitives import Material, Mesh, box, join, polygons


class Roof(StrEnum):
    """Form of a roof."""

    FLAT = "flat"
    PENT = "pent"
    GABLE = "gable"
    HIP = "hip"
    MANSARD = "mansard"


_PARAPET = 0.2  # thickness of a parapet [m]


def roof_mesh(
    form: Roof, size: tuple[float, float], rise: float, cover: Material, wall: Material, overhang: float = 0.4
) -> Mesh:
    """Return a roof over ``size`` (along x, along y) with its eaves on z = 0 and its top on z = ``rise`` [m].

    The ridge runs along x. A flat roof is a slab with a parapet up to ``rise``.
    """
    if form is Roof.FLAT:
        return _flat(size, rise, cover, wall)
    x, y = size[0] / 2 + overhang, size[1] / 2 + overhang
    if form is Roof.PENT:
        return _pent(x, y, rise, cover, wall)
    if form is Roof.MANSARD:
        return _mansard(size[0] / 2, size[1] / 2, rise, cover)
    return _ridged(x, y, rise, cover, wall, hipped=form is Roof.HIP)


def _flat(size: tuple[float, float], rise: float, cover: Material, wall: Material) -> Mesh:
    length, width = size
    slab = box(length, width, 0.05, cover)
    along = box(length, _PARAPET, rise, wall)
    across = box(_PARAPET, width, rise, wall)
    rims = [along.placed(0, s * (width - _PARAPET) / 2, 0) for s in (-1, 1)]
    rims += [across.placed(s * (length - _PARAPET) / 2, 0, 0) for s in (-1, 1)]
    return join([slab, *rims])


def _pent(x: float, y: float, rise: float, cover: Material, wall: Material) -> Mesh:
    """One plane, high towards the street (-y)."""
    vertices = [(-x, -y, 0), (x, -y, 0), (x, y, 0), (-x, y, 0), (-x, -y, rise), (x, -y, rise)]
    plane = polygons(vertices, [(4, 5, 2, 3)], cover)
    return join([plane, polygons(vertices, [(0, 1, 5, 4), (1, 2, 5), (3, 0, 4)], wall)])


def _ridged(x: float, y: float, rise: float, cover: Material, wall: Material, *, hipped: bool) -> Mesh:
    ridge = max(x - y, 0.3) if hipped else x
    vertices = [(-x, -y, 0), (x, -y, 0), (x, y, 0), (-x, y, 0), (-ridge, 0.0, rise), (ridge, 0.0, rise)]
    planes = polygons(vertices, [(0, 1, 5, 4), (2, 3, 4, 5), (0, 1, 2, 3)], cover)
    ends = polygons(vertices, [(1, 2, 5), (3, 0, 4)], cover if hipped else wall)
    return join([planes, ends])


def _mansard(x: float, y: float, rise: float, cover: Material) -> Mesh:
    """Steep lower slopes up to seven tenths of the rise, then a shallow hip."""
    inset = min(0.9, 0.3 * x, 0.3 * y)
    break_ = 0.7 * rise
    lower = [(-x, -y, 0), (x, -y, 0), (x, y, 0), (-x, y, 0)]
    upper = [
        (-x + inset, -y + inset),
        (x - inset, -y + inset),
        (x - inset, y - inset),
        (-x + inset, y - inset),
    ]
    vertices = [*lower, *((a, b, break_) for a, b in upper)]
    sides = [(k, (k + 1) % 4, 4 + (k + 1) % 4, 4 + k) for k in range(4)]
    skirt = polygons(vertices, [*sides, (0, 1, 2, 3)], cover)
    cap = _ridged(x - inset, y - inset, rise - break_, cover, cover, hipped=True).placed(0, 0, break_)
    return join([skirt, cap])

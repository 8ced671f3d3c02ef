"""Land of a street: steep, with raised lots behind retaining walls, paved or green."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.frames import Floats
from subiaco_sim.ground import Patch, Terrain
from subiaco_sim.primitives import Material, Mesh


@dataclass(frozen=True)
class StreetLand(Terrain):
    """A terrain with lots that lie higher than the street in both epochs.

    Parameters
    ----------
    raised : lots and by how much they are raised [m]
    paved : everything beside the road is paved
    """

    raised: tuple[Patch, ...] = ()
    paved: bool = False

    def _shaped(self, x: Floats, y: Floats, distance: Floats) -> Floats:
        height = super()._shaped(x, y, distance)
        for lot in self.raised:
            height = height + np.where(lot.contains(x, y), lot.rise, 0.0)
        return np.asarray(height)

    def laid(self, mesh: Mesh, x: float, y: float) -> Mesh:
        """Return a mesh that follows the slope of the land: what is upright stays upright [m]."""
        rise = (mesh.vertices[:, :2] - (x, y)) @ np.array(self.slope)
        vertices = mesh.vertices + rise[:, None] * np.array([0.0, 0.0, 1.0])
        return Mesh(vertices, mesh.triangles, mesh.material)

    def material(self, distance: Floats) -> NDArray[np.uint8]:
        """Return the material of the ground by distance from the crown [m]."""
        kind = super().material(distance)
        if self.paved:
            kind[kind == Material.GRASS] = Material.CONCRETE
        return kind


def lie_of_the_land(
    slope: float | None, steepest: tuple[float, float], rng: np.random.Generator
) -> tuple[float, float]:
    """Draw the slope to the east and north: a steepness within a range, mostly along the street (x)."""
    steepness = float(rng.uniform(*steepest)) if slope is None else slope
    turn = float(rng.normal(0.0, 0.4)) + (np.pi if rng.random() < 0.5 else 0.0)
    return float(steepness * np.cos(turn)), float(steepness * np.sin(turn))

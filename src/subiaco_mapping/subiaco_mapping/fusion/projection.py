"""Projection from the local frame of the pose graph to the CRS of the map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from subiaco_geo.crs import EnuFrame
from subiaco_geo.crs_area import crs_at
from subiaco_geo.frames import Floats

_BASIS = 50.0


@dataclass(frozen=True)
class Projection:
    """Local ENU to a map CRS; without a frame the map is local and nothing changes."""

    frame: EnuFrame | None
    crs: str | None

    @classmethod
    def of_place(cls, frame: EnuFrame | None, crs: str) -> Projection:
        """Return the projection of a survey about ``frame`` to the configured CRS, which may be ``auto``."""
        if frame is None:
            return cls(None, None)
        return cls(frame, crs_at(frame.latitude_deg, frame.longitude_deg, crs))

    def points(self, xyz: Floats) -> Floats:
        """Return world coordinates (N, 3) [m]."""
        if self.frame is None or self.crs is None:
            return xyz.copy()
        return self.frame.points_to_map(xyz, self.crs)

    def poses(self, T_local_x: Floats) -> Floats:
        """Return world poses (N, 4, 4)."""
        if self.frame is None or self.crs is None:
            return T_local_x.copy()
        return self.frame.poses_to_map(T_local_x, self.crs)

    def axes(self, xyz: Floats) -> Floats:
        """Return rotations (N, 3, 3) from local to map axes."""
        if self.frame is None or self.crs is None:
            return np.tile(np.eye(3), (len(xyz), 1, 1))
        return self.frame.grid_axes(xyz, self.crs)

    def affine(self, positions: Floats) -> tuple[Floats, Floats]:
        """Linearise the projection (scale included) about positions (N, 3).

        Returns
        -------
        matrices : (N, 3, 3) float64
        offsets : (N, 3) float64
            ``world = matrix @ local + offset``, to a millimetre within 100 m.
        """
        corners = positions[:, None, :] + np.vstack([np.zeros(3), np.eye(3) * _BASIS])
        world = self.points(corners.reshape(-1, 3)).reshape(len(positions), 4, 3)
        matrices = np.swapaxes((world[:, 1:] - world[:, :1]) / _BASIS, 1, 2)
        return matrices, world[:, 0] - np.einsum("nij,nj->ni", matrices, positions)

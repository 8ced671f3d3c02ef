"""What is wrong with a fused map: where it lies, how it bends, facades that stand twice."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from subiaco_geo.crs import EnuFrame
from subiaco_geo.frames import Floats
from subiaco_sim.config import MapErrorConfig

_WAVES = np.array([[260.0, 40.0], [-70.0, 210.0], [150.0, -160.0]])  # of the drift [m]


@dataclass(frozen=True)
class MapWarp:
    """Moves true places (N, 3) in ENU to where an erroneous map has them.

    Parameters
    ----------
    config : MapErrorConfig
    centre : (3,) float64
        The map turns about it [m].
    seed : int
    """

    config: MapErrorConfig
    centre: Floats
    seed: int

    @property
    def is_identity(self) -> bool:
        """Tell whether the map is as it should be."""
        c = self.config
        return not (c.shift or c.rotation_deg or c.tilt_deg or c.drift or c.shear)

    def _rigid(self) -> tuple[Floats, Floats]:
        rng = np.random.default_rng([self.seed, 21])
        turn = rng.uniform(0, 2 * np.pi, 2)
        tilt = np.radians(self.config.tilt_deg) * np.array([np.cos(turn[1]), np.sin(turn[1]), 0.0])
        yaw = np.array([0.0, 0.0, np.radians(self.config.rotation_deg)])
        rotation = Rotation.from_rotvec(tilt + yaw).as_matrix()
        shift = self.config.shift * np.array([np.cos(turn[0]), np.sin(turn[0]), 0.3])
        return rotation, shift

    def apply(self, xyz: Floats) -> Floats:
        """Return where the map has places (N, 3)."""
        if self.is_identity:
            return xyz
        rotation, shift = self._rigid()
        bent = xyz + self._bend(xyz)
        return (bent - self.centre) @ rotation.T + self.centre + shift

    def pose(self, poses: Floats) -> Floats:
        """Return poses (N, 4, 4) as the map has them."""
        if self.is_identity:
            return poses
        moved = poses.copy()
        moved[:, :3, :3] = self._rigid()[0] @ poses[:, :3, :3]
        moved[:, :3, 3] = self.apply(poses[:, :3, 3])
        return moved

    def _bend(self, xyz: Floats) -> Floats:
        """Return what no rigid motion undoes: slow waves, and a disc that is sheared."""
        rng = np.random.default_rng([self.seed, 22])
        local = xyz - self.centre
        bend = np.zeros_like(xyz)
        for wave in _WAVES:
            phase = rng.uniform(0, 2 * np.pi, 3)
            way = 2 * np.pi * (local[:, :2] @ wave) / (wave @ wave)
            bend += self.config.drift / 3 * np.sin(way[:, None] + phase) * [1.0, 1.0, 0.5]
        heart = rng.uniform(-30, 30, 2)
        off = local[:, :2] - heart
        inside = np.exp(-((np.linalg.norm(off, axis=1) / 25.0) ** 2))
        bend[:, 0] += self.config.shear * np.sin(off[:, 1] / 12.0) * inside
        return bend

    def T_true_map(self, world: EnuFrame, crs: str) -> Floats:
        """Return the rigid (4, 4) that undoes where the map lies, in map coordinates of ``crs``."""
        if self.is_identity:
            return np.eye(4)
        rotation, shift = self._rigid()
        corners = self.centre + 50.0 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1.0]])
        true = world.points_to_map(corners, crs)
        wrong = world.points_to_map((corners - self.centre) @ rotation.T + self.centre + shift, crs)
        middle = true.mean(axis=0), wrong.mean(axis=0)
        turn, _ = Rotation.align_vectors(true - middle[0], wrong - middle[1])
        pose = np.eye(4)
        pose[:3, :3] = turn.as_matrix()
        pose[:3, 3] = middle[0] - pose[:3, :3] @ middle[1]
        return pose

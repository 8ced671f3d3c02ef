"""Where the sensors sit on the vehicle; nothing is aligned by chance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from subiaco_geo.frames import Floats, make_pose


@dataclass(frozen=True)
class Mounting:
    """Pose of a sensor frame in base_link (rear axle on the ground, x forward, y left, z up).

    ``yaw pitch roll`` in degrees, rotation Rz Ry Rx; ``x y z`` in metres.
    """

    x: float
    y: float
    z: float
    yaw: float = 0.0
    pitch: float = 0.0
    roll: float = 0.0

    @property
    def T_base_sensor(self) -> Floats:
        """4x4."""
        rotation = Rotation.from_euler("ZYX", [self.yaw, self.pitch, self.roll], degrees=True)
        return make_pose(rotation.as_matrix(), np.array([self.x, self.y, self.z]))


LIDAR = Mounting(0.92, 0.03, 1.98, yaw=1.5, pitch=0.8, roll=-0.4)
IMU = Mounting(0.55, -0.24, 1.72, yaw=-90.0, pitch=0.6, roll=0.9)
GNSS = Mounting(-0.38, 0.31, 2.11)

MOUNTINGS: dict[str, Mounting] = {"lidar_link": LIDAR, "imu_link": IMU, "gnss_link": GNSS}

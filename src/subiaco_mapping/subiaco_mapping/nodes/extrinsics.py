"""Static transforms as they arrive, turned into the extrinsics of the library."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from subiaco_geo.topics import FIX, IMU
from subiaco_mapping.measurements import Extrinsics
from subiaco_mapping.preprocessing.config import SensorsConfig
from subiaco_mapping.preprocessing.conversions import extrinsics_from_tf


def sensors_needed(topics: Collection[str]) -> list[str]:
    """Return which extrinsics the announced topics of a sequence ask for."""
    return [name for name, topic in (("imu", IMU), ("gnss", FIX)) if topic in topics]


class StaticTransforms:
    """What ``/tf_static`` has said about the vehicle.

    Parameters
    ----------
    config : SensorsConfig
    ignored : collection of str
        Child frames that are no sensors, such as our own ``map``.
    """

    def __init__(self, config: SensorsConfig, ignored: Collection[str] = ("map",)) -> None:
        self._config = config
        self._ignored = ignored
        self._transforms: list[Any] = []

    def add(self, message: Any) -> bool:
        """Take a TFMessage; return whether it was about the vehicle."""
        ours = [item for item in message.transforms if item.child_frame_id not in self._ignored]
        self._transforms.extend(ours)
        return bool(ours) or not message.transforms

    def extrinsics(self, needs: Collection[str] = ()) -> Extrinsics:
        """Return the extrinsics; InputError where a needed one is missing."""
        return extrinsics_from_tf(self._transforms, self._config, needs)

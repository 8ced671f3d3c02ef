"""Bags of Livox clouds (``CustomMsg``), written by rosbags from the definition of the type."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from mapping_scenes import SECOND, START_NS
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from subiaco_geo.bags import make_typestore

POINT = """
uint32 offset_time
float32 x
float32 y
float32 z
uint8 reflectivity
uint8 tag
uint8 line
"""
CLOUD = """
std_msgs/Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
CustomPoint[] points
"""
PACKAGES = ("livox_ros_driver2", "livox_ros_driver", "livox_interfaces")


def livox_typestore(package: str = PACKAGES[0]) -> object:
    """A typestore that knows the messages of one generation of the driver."""
    store = make_typestore()
    store.register(get_types_from_msg(POINT, f"{package}/msg/CustomPoint"))
    store.register(get_types_from_msg(CLOUD, f"{package}/msg/CustomMsg"))
    return store


def livox_message(
    store: object,
    xyz: np.ndarray,
    offsets_ns: np.ndarray,
    stamp_ns: int = START_NS,
    *,
    package: str = PACKAGES[0],
    frame: str = "livox_frame",
    timebase_ns: int | None = None,
) -> object:
    """A cloud of points (N, 3) with nanoseconds (N,) since its stamp; reflectivity counts modulo 256."""
    types = store.types
    point = types[f"{package}/msg/CustomPoint"]
    stamp = types["builtin_interfaces/msg/Time"](sec=stamp_ns // SECOND, nanosec=stamp_ns % SECOND)
    return types[f"{package}/msg/CustomMsg"](
        header=types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame),
        timebase=stamp_ns if timebase_ns is None else timebase_ns,
        point_num=len(xyz),
        lidar_id=192,
        rsvd=np.zeros(3, np.uint8),
        points=[
            point(int(t), *map(float, p), reflectivity=i % 256, tag=16, line=i % 4)
            for i, (p, t) in enumerate(zip(xyz, offsets_ns, strict=True))
        ],
    )


def write_livox(
    bag: Path,
    clouds: list[tuple[np.ndarray, np.ndarray]],
    *,
    package: str = PACKAGES[0],
    topic: str = "/livox/lidar",
    storage: StoragePlugin = StoragePlugin.MCAP,
) -> None:
    """A bag of clouds at 10 Hz, each its points (N, 3) and their nanoseconds (N,) since its stamp."""
    store = livox_typestore(package)
    name = f"{package}/msg/CustomMsg"
    with Writer(bag, version=Writer.VERSION_LATEST, storage_plugin=storage) as writer:
        connection = writer.add_connection(topic, name, typestore=store)
        for k, (xyz, offsets_ns) in enumerate(clouds):
            stamp = START_NS + k * SECOND // 10
            cloud = livox_message(store, xyz, offsets_ns, stamp, package=package)
            writer.write(connection, stamp, store.serialize_cdr(cloud, name))


def write_ros1_livox(bag: Path, clouds: list[tuple[np.ndarray, np.ndarray]]) -> None:
    """A ROS 1 bag of the same clouds."""
    store = get_typestore(Stores.ROS1_NOETIC)
    package = PACKAGES[1]
    name = f"{package}/msg/CustomMsg"
    store.register(get_types_from_msg(POINT, f"{package}/msg/CustomPoint"))
    store.register(get_types_from_msg(CLOUD, name))
    header, time = store.types["std_msgs/msg/Header"], store.types["builtin_interfaces/msg/Time"]
    point = store.types[f"{package}/msg/CustomPoint"]
    with Ros1Writer(bag) as writer:
        connection = writer.add_connection("/livox/lidar", name, typestore=store)
        for k, (xyz, offsets_ns) in enumerate(clouds):
            stamp = START_NS + k * SECOND // 10
            cloud = store.types[name](
                header=header(k, time(stamp // SECOND, stamp % SECOND), "livox_frame"),
                timebase=stamp,
                point_num=len(xyz),
                lidar_id=1,
                rsvd=np.zeros(3, np.uint8),
                points=[
                    point(int(t), *map(float, p), reflectivity=7, tag=0, line=0)
                    for p, t in zip(xyz, offsets_ns, strict=True)
                ],
            )
            writer.write(connection, stamp, store.serialize_ros1(cloud, name))
